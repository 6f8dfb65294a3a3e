"""The design folder: written whole or not at all, and opened only as it was written.

`manifest.json` holds the sha256 of every other file, so that a sheet is never cut from files that were edited after
the check.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from design.coupon import CELLS, Coupon, coupon_facts, coupon_texts
from design.deploy.indentation import response_csv
from design.errors import BundleError, NoBundle
from design.export.dxf import dxf
from design.export.svg import svg
from design.findings import Finding
from design.job import Job
from design.meshfiles import write_ply
from design.pattern.drawing import Drawing, as_json, from_json
from design.pipeline import Design
from design.preview import coupon_png, preview_png
from design.surface import TriMesh

FORMAT = 1
ALWAYS = ("spec.yaml", "target.ply", "flat.ply", "cells.csv", "paths.json", "cut.dxf", "cut.svg", "cut.nc")
COUPON = ("coupon.yaml", "cells.csv", "paths.json", "cut.dxf", "cut.svg", "cut.nc", "preview.png")
NEEDED = {"design": ALWAYS, "coupon": COUPON}  # by the manifest's kind
TO_FILL_IN = ("coupon.csv",)  # written on after the build, so its hash is not kept
PREDICTED = ("deployed.ply", "response.csv")
LIBRARIES = ("fabctl", "numpy", "scipy", "shapely", "ezdxf")


@dataclass(frozen=True, slots=True)
class Bundle:
    """A design folder that was found whole and as it was written."""

    path: Path
    manifest: Mapping[str, Any]

    @property
    def kind(self) -> str:
        """Return "design", or "coupon" for a sheet of patches that has no target."""
        return str(self.manifest.get("kind", "design"))

    def file(self, name: str) -> Path:
        """Return one of the folder's files; raise `BundleError` where this design has none of that name."""
        if name not in self.manifest["files"]:
            raise BundleError(f"{self.path}: this {self.kind} has no {name}")
        return self.path / name

    def drawing(self, sheet: int | None = None) -> Drawing:
        """Return what is to be cut; of a design that is split over sheets, the whole or `sheet`, from 1."""
        name = "paths.json" if sheet is None else f"paths-{sheet}.json"
        if sheet is not None and name not in self.manifest["files"]:
            count = sum(file.startswith("paths-") for file in self.manifest["files"])
            have = f"is split over {count} sheets" if count else "is one sheet: leave the number of a sheet out"
            raise BundleError(f"{self.path}: there is no sheet {sheet}; this {self.kind} {have}")
        return from_json(json.loads(self.file(name).read_text(encoding="utf-8")))

    def cells(self) -> list[dict[str, str]]:
        """Return the rows of `cells.csv`."""
        with self.file("cells.csv").open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))


def open_bundle(path: Path) -> Bundle:
    """Return the design in a folder; raise `BundleError` with everything that is missing, edited or of another age."""
    manifest = _manifest(path)
    files: dict[str, Any] = manifest["files"]
    if manifest.get("format") != FORMAT:
        raise BundleError(f"{path}: a design of format {manifest.get('format')!r}; this program reads {FORMAT}")
    kind = str(manifest.get("kind", "design"))
    if kind not in NEEDED:
        raise BundleError(f"{path}: a folder of kind {kind!r}; this program reads {', '.join(NEEDED)}")
    found = [_fault(path / name, name, str(digest)) for name, digest in sorted(files.items())]
    missing = [name for name in NEEDED[kind] if name not in files]
    found += [Finding("BUNDLE-MISSING", "is not in the manifest", where=name) for name in missing]
    faults = [finding for finding in found if finding is not None]
    if faults:
        raise BundleError(f"{path}: not as it was built; build it again", faults)
    return Bundle(path, manifest)


def _manifest(path: Path) -> dict[str, Any]:
    try:
        found = json.loads((path / "manifest.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise NoBundle(f"{path}: no design here (manifest.json is missing)") from None
    except OSError as fault:
        raise NoBundle(f"{path}: manifest.json cannot be read: {(fault.strerror or 'unknown').lower()}") from fault
    except (ValueError, RecursionError) as fault:
        raise NoBundle(f"{path}: manifest.json is not JSON; build the design again") from fault
    if not isinstance(found, dict) or not isinstance(found.get("files"), dict):
        raise NoBundle(f"{path}: manifest.json is not that of a design; build the design again")
    return found


def _fault(path: Path, name: str, digest: str) -> Finding | None:
    try:
        content = path.read_bytes()
    except OSError as fault:
        return Finding("BUNDLE-MISSING", f"cannot be read: {fault.strerror}", where=name)
    if hashlib.sha256(content).hexdigest() != digest:
        return Finding("BUNDLE-EDITED", "was changed after the build", where=name)
    return None


def write_bundle(design: Design, spec_text: str, path: Path, replace: bool = False) -> Bundle:
    """Write the design folder and return it; what was not finished leaves nothing behind.

    An existing folder is refused, unless it is empty, or `replace` is true and it holds a design.
    """
    about = {"name": design.spec.name, "library": design.library_hash, "facts": facts(design)}
    return _write_whole(path, replace, about, lambda draft: _write_files(design, spec_text, draft))


def write_coupon_bundle(
    made: Coupon, job: Job, spec_text: str, library_hash: str, edge_mm: float, path: Path, replace: bool = False
) -> Bundle:
    """Write a coupon's folder, which is cut as a design's is, and return it."""
    about = {"name": "coupon", "kind": "coupon", "library": library_hash, "facts": coupon_facts(made, job, edge_mm)}

    def fill(folder: Path) -> None:
        texts = {**coupon_texts(made, job), "coupon.yaml": spec_text, "paths.json": _paths_text(made.drawing)}
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        (folder / "preview.png").write_bytes(coupon_png(made))

    return _write_whole(path, replace, about, fill)


def _write_whole(path: Path, replace: bool, about: Mapping[str, Any], fill: Callable[[Path], None]) -> Bundle:
    refuse_taken(path, replace)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    draft.mkdir()
    try:
        fill(draft)
        _write_manifest(draft, about)
        if path.exists():
            shutil.rmtree(path)
        draft.rename(path)
    except BaseException:  # Ctrl-C too: no half-written folder stays
        shutil.rmtree(draft, ignore_errors=True)
        raise
    return open_bundle(path)


def refuse_taken(path: Path, replace: bool = False) -> None:
    """Raise `BundleError` where no design may be written into the folder; for asking before a long build."""
    if path.exists() and not _may_replace(path, replace):
        raise BundleError(
            f"{path}: exists already; choose another folder, or say that a design there may be replaced (--replace)"
        )


def _may_replace(path: Path, replace: bool) -> bool:
    if not path.is_dir():
        return False
    return not any(path.iterdir()) or (replace and (path / "manifest.json").is_file())


def _write_files(design: Design, spec_text: str, folder: Path) -> None:
    drawing = design.drawing
    texts = {
        "spec.yaml": spec_text,
        "cells.csv": cells_csv(design),
        **_cut_texts("", drawing, design.job, design.spec.name),
        "findings.json": json.dumps([finding.as_dict() for finding in design.findings], indent=1) + "\n",
    }
    for k, one in enumerate(design.sheets, start=1):
        texts |= _cut_texts(f"-{k}", one.drawing, one.job, f"{design.spec.name}, sheet {k}")
    if design.predicted is not None:
        texts["response.csv"] = response_csv(design.predicted.response)
        write_ply(folder / "deployed.ply", design.predicted.deployed.mesh)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    flat = design.flattening
    write_ply(folder / "target.ply", design.mesh)
    write_ply(folder / "flat.ply", TriMesh(np.column_stack([flat.flat_mm, np.zeros(len(flat.flat_mm))]), flat.faces))
    (folder / "preview.png").write_bytes(preview_png(design))


def _cut_texts(suffix: str, drawing: Drawing, job: Job, title: str) -> dict[str, str]:
    return {
        f"paths{suffix}.json": _paths_text(drawing),
        f"cut{suffix}.dxf": dxf(drawing.paths, drawing.size_mm),
        f"cut{suffix}.svg": svg(drawing.paths, drawing.size_mm, title),
        f"cut{suffix}.nc": "\n".join(job.lines) + "\n",
    }


def _paths_text(drawing: Drawing) -> str:
    return json.dumps(as_json(drawing), allow_nan=False) + "\n"


def cells_csv(design: Design) -> str:
    """Return one row a cell; lengths in mm on the sheet, the angle in degrees."""
    cells = design.cells
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(CELLS)
    for k, (x, y) in enumerate(cells.tiling.centres_mm().tolist()):
        numbers = (
            cells.choice.t_mm[k],
            math.degrees(cells.choice.theta_rad[k]),
            cells.choice.expansion_ratio[k],
            cells.hinge_mm[k],
        )
        place = (f"{x:.6f}", f"{y:.6f}", int(cells.tiling.inverted[k]))
        rows.writerow((k, *place, *(f"{number:.6f}" for number in numbers), cells.kind[k]))
    return text.getvalue()


def _write_manifest(folder: Path, about: Mapping[str, Any]) -> None:
    files = {}
    for path in sorted(folder.iterdir()):
        if path.name not in TO_FILL_IN:
            files[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        _sync(path)
    versions = {name: _version(name) for name in LIBRARIES}
    body = {"format": FORMAT, **about, "files": files, "versions": versions}
    path = folder / "manifest.json"
    path.write_text(json.dumps(body, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
    _sync(path)
    _sync(folder)


def facts(design: Design) -> dict[str, Any]:
    """Return the numbers that a summary shows, with their units."""
    expansion = design.cells.choice.expansion_ratio
    found: dict[str, Any] = {
        "cells_count": len(expansion),
        "cell_mm": design.spec.cell_mm,
        "expansion_low_ratio": float(expansion.min()),
        "expansion_high_ratio": float(expansion.max()),
        "sheet_mm": list(design.drawing.size_mm),
        "cut_mm": design.job.cut_mm,
        "travel_mm": design.job.travel_mm,
        "cut_time_s": design.job.time_s,
    }
    if design.sheets:
        found["sheets_mm"] = [list(one.drawing.size_mm) for one in design.sheets]
    if design.predicted is not None:
        deviation, rest = design.predicted.deployed.deviation, design.predicted.deployed.equilibrium
        found |= {
            "deviation_mean_mm": deviation.mean_mm,
            "deviation_max_mm": deviation.max_mm,
            "deviation_mean_frac": deviation.mean_frac,
            "residual_ratio": rest.residual_ratio,
            "iterations_count": rest.iterations_count,
            "smallest_eigenvalue_N_mm": design.predicted.smallest_eigenvalue_N_mm,
            "response_residual_ratio": design.predicted.response.residual_ratio,
            "response_unstable_count": design.predicted.response.unstable_count,
            "stiffness_2mm_N_mm": design.predicted.response.stiffness_N_mm(2.0),
        }
    return found


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
