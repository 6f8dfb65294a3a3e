"""From a specification file to a design folder: what the command line and the whole flow both do."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from design.bundle import Bundle, refuse_taken, write_bundle, write_coupon_bundle
from design.cells.contracting import load_contracting
from design.cells.library import CellLibrary, load_library
from design.cells.select import select
from design.cells.sheet import Sheet
from design.coupon import Coupon, coupon
from design.export.gcode import GcodeOptions
from design.findings import Finding
from design.flatten.cut import chain_through
from design.flatten.prescribed import rim_u_through
from design.job import JobOptions, compose_job
from design.meshfiles import read_given_flat, read_mesh
from design.pattern.paths import Layer, LayerPreset
from design.pattern.toolpath import ToolOptions
from design.pipeline import Design, build
from design.spec import DesignSpec, Kind, Rim
from design.surface import TriMesh
from design.targets import TARGETS
from design.watch import Watch
from fabctl.config.bench import names
from fabctl.config.coupon import CouponConfig
from fabctl.config.material import LayerConfig, MaterialConfig, load_material
from fabctl.config.spec import MadeTarget, SpecConfig, ToolConfig, load_spec
from fabctl.errors import RefusedError, UsageError
from fabctl.events import Emit, Event, silent

WRITING_FROM_FRAC = 0.99  # of a build: what is left is writing the folder
COUPON_SOLVED_FRAC = 0.9  # the rest is ordering the cut and writing
UNPREDICTED = Finding(
    "RESPONSE-NONE",
    "`response: null`: neither the deployed shape nor the indentation is predicted; `fabctl deploy` will refuse the "
    "design, simulated rigs and scanners have no shape of it, and nothing measured is held against a prediction",
    "info",
    hint="leave `response` out for the predicted shape and curve",
)


@dataclass(frozen=True, slots=True)
class Inputs:
    """Everything a design is made from, read and checked."""

    spec: DesignSpec
    text: str
    mesh: TriMesh
    library: CellLibrary
    presets: dict[Layer, LayerPreset]
    findings: tuple[Finding, ...]


def read_inputs(
    name: str, home: Path, target: Path | None = None, cell_mm: float | None = None, library: Path | None = None
) -> Inputs:
    """Return the inputs of the specification called `name`; what else is given takes the place of the file's.

    Raises `ConfigError`, `UsageError`, `MeshError` or `RefusedError`, each with all that is wrong.
    """
    config, path = load_spec(name, home, target)
    return _inputs_of(config, path.read_text(encoding="utf-8"), path.parent, home, target, cell_mm, library)


def _inputs_of(
    config: SpecConfig,
    text: str,
    beside: Path,
    home: Path,
    target: Path | None,
    cell_mm: float | None,
    library: Path | None,
) -> Inputs:
    material = load_material(config.material, home)
    edge_mm = cell_mm or config.cell_mm or material.edge_mm
    sheet = sheet_of(material, edge_mm)
    presets = presets_of(material)
    assert material.laser is not None  # presets_of has refused otherwise
    spec = config.to_design(edge_mm, sheet.hinge_mm, material.laser.kerf_mm)
    mesh, findings = read_target(config, beside, target)
    if config.flatten.source == "target":
        flat_mm = read_given_flat(target_file(config, beside, target), mesh)
        spec = changed(spec, flatten=changed(spec.flatten, given_mm=flat_mm))
    if config.flatten.cut_mm is not None:
        spec = changed(
            spec, flatten=changed(spec.flatten, cut_path=chain_through(mesh, np.array(config.flatten.cut_mm)))
        )
    if config.flatten.rim_u is not None:
        rows = np.array(config.flatten.rim_u)
        spec = changed(spec, flatten=changed(spec.flatten, boundary_u=rim_u_through(mesh, rows[:, :3], rows[:, 3])))
    file = library or library_file(config, beside)
    cells = library_of(config, file).scaled(sheet)
    findings += [] if config.response else [UNPREDICTED]
    return Inputs(spec, keeping("library", file, text), mesh, cells, presets, tuple(findings))


def library_file(config: SpecConfig, beside: Path) -> Path | None:
    """Return the library that a specification names, looked for beside it first; None for the shipped one."""
    if config.library is None:
        return None
    return beside / config.library if (beside / config.library).is_file() else Path(config.library)


def library_of(config: SpecConfig, file: Path | None) -> CellLibrary:
    """Return the library of a specification's kind of cells in `file`, the shipped one without."""
    return load_library(file) if config.cells == "expanding" else load_contracting(file)


def keeping(key: str, value: Path | None, text: str) -> str:
    """Return a specification's text with the whole path of a file, so that the design can be built from its folder."""
    if value is None or not text:
        return text
    return re.sub(rf"(?m)^{key}:.*\n?", "", text).rstrip("\n") + f"\n{key}: {json.dumps(str(value.resolve()))}\n"


def inputs_for(
    target: str,
    material: str | None,
    home: Path,
    cell_mm: float | None = None,
    cells: Kind | None = None,
    library: Path | None = None,
) -> Inputs:
    """Return the inputs for a specification, a mesh file, or the name of one of our own surfaces.

    A name that is both, such as `cap`, is the specification, as for `fabctl design build`; the surface where `material`
    or `cells` are given, which a specification says itself.
    """
    is_spec = Path(target).suffix in (".yaml", ".yml") or target in names("specs", home)
    if is_spec and material is None and cells is None:
        return read_inputs(target, home, None, cell_mm, library)
    if is_spec and target not in TARGETS:
        raise UsageError(f"{target}: a specification says its material and cells itself; change them there")
    if target not in TARGETS and not Path(target).is_file():
        wrong = "is a folder" if Path(target).is_dir() else "there is no such file"
        specs, surfaces = ", ".join(names("specs", home)) or "none", ", ".join(sorted(TARGETS))
        raise UsageError(f"{target}: {wrong}, no specification ({specs}) and no surface of our own ({surfaces})")
    source: str | MadeTarget = MadeTarget(make=target) if target in TARGETS else target
    config = SpecConfig(
        name=re.sub(r"\W", "-", Path(target).stem) or "target",
        target=source,
        material=material or SpecConfig.model_fields["material"].default,
        cells=cells or "expanding",
    )
    return _inputs_of(config, "", Path.cwd(), home, None, cell_mm, library)


def design_of(inputs: Inputs, emit: Emit = silent) -> Design:
    """Return the design of the inputs."""

    watch = progress_of(emit, WRITING_FROM_FRAC)
    return build(inputs.spec, inputs.mesh, inputs.library, inputs.presets, watch, inputs.findings)


def progress_of(emit: Emit, up_to_frac: float = 1.0) -> Watch:
    """Return what the design package tells its progress to; its whole is `up_to_frac` of the command's."""
    return lambda message, done_frac: emit(Event("progress", message, up_to_frac * done_frac))


def build_folder(
    name: str,
    folder: Path,
    home: Path,
    target: Path | None = None,
    cell_mm: float | None = None,
    replace: bool = False,
    emit: Emit = silent,
    compensate: bool = False,
    library: Path | None = None,
) -> tuple[Design, Bundle]:
    """Build the specification called `name` into `folder`; return the design and its folder."""
    refuse_taken(folder, replace)
    inputs = read_inputs(name, home, target, cell_mm, library)
    if compensate:
        inputs = changed(inputs, spec=changed(inputs.spec, compensate=True))
    design = design_of(inputs, emit)
    emit(Event("progress", "writing the design folder", WRITING_FROM_FRAC))
    bundle = write_bundle(design, inputs.text, folder, replace)
    emit(Event("progress", "written", 1.0))
    return design, bundle


def build_compensated(
    bundle: Bundle, folder: Path, home: Path, emit: Emit = silent, rim: Literal[True] | Rim = True
) -> tuple[Design, Finding]:
    """Build a design folder anew with compensated expansions; raise `RefusedError` where they do not help.

    `rim` says on what the sheet bears its weight; True: it is free of both.

    The specification kept in the new folder asks for the compensation itself, so that it can be built from there.
    """
    refuse_taken(folder)
    spec_path, target = bundle.file("spec.yaml"), bundle.file("target.ply")
    cell_mm = bundle.manifest["facts"].get("cell_mm")  # the command line may have asked for other cells than the file
    inputs = read_inputs(str(spec_path), home, target, cell_mm)
    design = design_of(changed(inputs, spec=changed(inputs.spec, compensate=rim)), emit)
    told = next((f for f in design.findings if f.code in ("COMPENSATED", "COMPENSATE-NOT")), None)
    if told is None or told.code == "COMPENSATE-NOT":
        raise RefusedError("the design was not compensated", [told] if told else [])
    text = re.sub(r"(?m)^compensate:.*\n", "", inputs.text).rstrip("\n") + f"\ncompensate: {str(rim).lower()}\n"
    write_bundle(design, text, folder)
    return design, told


def read_target(config: SpecConfig, folder: Path, target: Path | None) -> tuple[TriMesh, list[Finding]]:
    """Return the surface that a specification names; a file is looked for in `folder` first."""
    if target is None and isinstance(config.target, MadeTarget):
        return made(config.target), []
    return read_mesh(target_file(config, folder, target))


def target_file(config: SpecConfig, folder: Path, target: Path | None) -> Path:
    """Return the file of the surface; raise `UsageError` where the surface is made, not read."""
    if target is not None:
        return target
    if isinstance(config.target, MadeTarget):
        raise UsageError("`flatten.source: target` takes the flat from the target's file, and this target has none")
    beside = folder / config.target
    return beside if beside.is_file() else Path(config.target)


def made(asked: MadeTarget) -> TriMesh:
    """Return one of the project's own surfaces; raise `UsageError` where it has no such measure."""
    try:
        return TARGETS[asked.make](**asked.arguments())
    except TypeError as fault:
        raise UsageError(f"the target {asked.make!r} has no such measure: {fault}") from fault


def sheet_of(material: MaterialConfig, edge_mm: float) -> Sheet:
    """Return the sheet with cells of `edge_mm`; slit and hinge grow and shrink with the cell, as the library needs."""
    ratio = edge_mm / material.edge_mm
    return Sheet(
        edge_mm=edge_mm,
        slit_mm=ratio * material.slit_mm,
        hinge_mm=ratio * material.hinge_mm,
        thickness_mm=material.thickness_mm,
        E_MPa=material.E_MPa,
        nu_ratio=material.nu_ratio,
        density_kg_m3=material.density_kg_m3,
    )


def presets_of(material: MaterialConfig) -> dict[Layer, LayerPreset]:
    """Return how each layer is cut; raise `RefusedError` for a material that must not, or cannot yet, be cut."""
    if material.danger:
        danger = Finding("MATERIAL-NEVER", material.danger, where=material.name)
        raise RefusedError(f"{material.name} must not be cut", [danger])
    if material.laser is None:
        missing = Finding("MATERIAL-LASER", "has no laser preset", where=material.name, hint="cut a power-speed grid")
        raise RefusedError(f"{material.name} cannot be cut yet", [missing])
    laser = material.laser
    layers: dict[Layer, LayerConfig] = {
        "engrave": laser.engrave,
        "mark": laser.mark,
        "hole": laser.outline,
        "slit": laser.slit,
        "outline": laser.outline,
    }
    return {layer: LayerPreset(c.power_frac, c.feed_mm_s, c.passes_count) for layer, c in layers.items()}


def write_coupon(
    folder: Path, asked: CouponConfig, home: Path, replace: bool = False, emit: Emit = silent
) -> tuple[Coupon, Bundle]:
    """Write a coupon's folder, which is cut as a design's is; return what is drawn, and the folder."""
    refuse_taken(folder, replace)
    material = load_material(asked.material, home)
    presets = presets_of(material)
    assert material.laser is not None
    sheet = sheet_of(material, material.edge_mm)
    emit(Event("progress", "choosing the cell", 0.0))
    library = load_library(Path(asked.library) if asked.library else None).scaled(sheet)
    cell = select(library, np.array([asked.expansion_ratio]))
    watch = progress_of(emit, COUPON_SOLVED_FRAC)
    made = coupon(float(cell.t_mm[0]), float(cell.theta_rad[0]), asked.hinges_mm, sheet, watch=watch)
    watch("writing the coupon's folder", 1.0)
    job = compose_job(made.drawing, presets, job_options(asked.tool, material.laser.kerf_mm), remarks=[asked.name])
    text = yaml.safe_dump(asked.model_dump(mode="json", exclude_defaults=True), sort_keys=False)
    return made, write_coupon_bundle(made, job, text, library.hash, sheet.edge_mm, folder, replace)


def job_options(tool: ToolConfig, kerf_mm: float, machine: GcodeOptions | None = None) -> JobOptions:
    """Return how a drawing is cut with a specification's tool; the material's kerf unless it names its own."""
    rest = tool.model_dump(exclude={"kerf_mm", "spread_mm"})
    return JobOptions(ToolOptions(kerf_mm=tool.kerf_mm or kerf_mm, **rest), machine or GcodeOptions(), tool.spread_mm)
