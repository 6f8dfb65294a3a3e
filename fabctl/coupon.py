"""A coupon's form, filled in at the table: measured expansions beside those that finite elements expect."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from design.bundle import open_bundle
from design.coupon import FORM
from design.findings import Finding
from fabctl.errors import RefusedError, UnreadableInput
from fabctl.files import text_of
from fabctl.records.folder import RunFolder, start_run
from fabctl.workspace import Workspace

FORM_ROUNDING = 6e-5  # the form is printed with four decimals
COVERAGE = 2.0  # the uncertainty given is about 95 %
LOW_RATIO, HIGH_RATIO = 0.9, 2.2  # a length outside that is a slip of the pen: no cell expands so


@dataclass(frozen=True, slots=True)
class Measured:
    """One patch as it was measured."""

    patch: str
    hinge_mm: float
    expected_ratio: float | None
    expansion_ratio: float
    uncertainty_ratio: float  # about 95 %
    readings_count: int
    cycles_count: int
    failed_at_count: int | None  # the cycle at which a hinge tore; None where none did

    def off_ratio(self) -> float | None:
        """Return measured less expected; None where the patch was expected to spring back."""
        return None if self.expected_ratio is None else self.expansion_ratio - self.expected_ratio

    def agrees(self) -> bool | None:
        """Say whether the map lies within the uncertainty."""
        off = self.off_ratio()
        return None if off is None else abs(off) <= self.uncertainty_ratio


def read_form(path: Path, length_error_mm: float) -> list[Measured]:
    """Return the patches of a filled form; raise `RefusedError` with everything that is missing or cannot be.

    Several readings of one length stand in its field parted by spaces or semicolons. `length_error_mm` is the standard
    error of one reading of the rule or calliper; it counts once for a patch, the scatter of readings beside it.
    """
    text = text_of(path, "a coupon's form")
    rows = list(csv.DictReader(text.splitlines()))
    names = rows[0].keys() if rows else ()
    missing = [name for name in FORM if name not in names]
    if missing:
        text = f"has no column {', '.join(missing)}" if rows else "has no rows"
        raise UnreadableInput("not a coupon's form", [Finding("COUPON-FORM", text, where=str(path))])
    found: list[Finding] = []
    patches = [_patch(row, f"{path}:{line}", length_error_mm, found) for line, row in enumerate(rows, start=2)]
    names_seen = [row["patch"] for row in rows]
    for name in sorted({name for name in names_seen if names_seen.count(name) > 1}):
        found.append(Finding("COUPON-TWICE", f"patch {name} stands there twice", where=str(path)))
    if found:
        raise RefusedError("the form is not filled in as it should be", found)
    return [patch for patch in patches if patch is not None]


def _patch(row: dict[str, str], where: str, length_error_mm: float, found: list[Finding]) -> Measured | None:
    before = len(found)

    def number(name: str, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            said = repr(text) if text else "nothing"
            found.append(Finding("COUPON-NUMBER", f"{name}: {said} where a number above zero belongs", where=where))
            return math.nan
        return value

    flat, hinge = number("flat_length_mm", _word(row, "flat_length_mm")), number("hinge_mm", _word(row, "hinge_mm"))
    words = _word(row, "measured_length_mm").replace(";", " ").split() or [""]
    lengths = [number("measured_length_mm", word) for word in words]
    cycles = _count("cycles_count", _word(row, "cycles_count"), where, found, needed=True)
    failed = _count("failed_at", _word(row, "failed_at"), where, found, needed=False)
    expected = number("expected_expansion_ratio", text) if (text := _word(row, "expected_expansion_ratio")) else None
    if failed is not None and cycles is not None and failed > cycles:
        text = f"failed at cycle {failed}, but only {cycles} were made"
        found.append(Finding("COUPON-CYCLES", text, where=where))
    for length in lengths:
        if math.isfinite(length) and math.isfinite(flat) and not LOW_RATIO < length / flat < HIGH_RATIO:
            text = f"{length:g} mm from {flat:g} mm flat is no expansion that a cell can have"
            found.append(Finding("COUPON-LENGTH", text, where=where))
    if len(found) > before or cycles is None:
        return None
    ratios = [length / flat for length in lengths]
    scatter = stdev(ratios) / math.sqrt(len(ratios)) if len(ratios) > 1 else 0.0
    uncertainty = COVERAGE * math.hypot(length_error_mm / flat, scatter)
    return Measured(_word(row, "patch"), hinge, expected, fmean(ratios), uncertainty, len(ratios), cycles, failed)


def _word(row: dict[str, str], name: str) -> str:
    return (row.get(name) or "").strip()


def _count(name: str, text: str, where: str, found: list[Finding], needed: bool) -> int | None:
    if not text and not needed:
        return None
    if text.isascii() and text.isdigit():
        return int(text)
    found.append(Finding("COUPON-NUMBER", f"{name}: {text or 'nothing'} where a whole number belongs", where=where))
    return None


def as_rows(patches: list[Measured]) -> list[dict[str, Any]]:
    """Return the patches as plain JSON."""
    return [asdict(patch) | {"off_ratio": patch.off_ratio(), "agrees": patch.agrees()} for patch in patches]


def write_measured(form: Path, patches: list[Measured], length_error_mm: float) -> Path:
    """Write `measured.json` beside the form and return where; an earlier one is replaced."""
    path = form.with_name("measured.json")
    body = {"format": 1, "form": form.name, "length_error_mm": length_error_mm, "patches": as_rows(patches)}
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(body, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    draft.replace(path)
    return path


def keep_result(
    lab: Workspace, specimen: str, form: Path, patches: list[Measured], length_error_mm: float
) -> RunFolder:
    """Write a run of kind `coupon` with the form and what it says; raise `RefusedError` where it is another's form."""
    design = open_bundle(lab.specimen(specimen).design)
    if design.kind != "coupon":
        told = Finding("COUPON-SPECIMEN", "was cut from a design, not from a coupon", where=specimen)
        raise RefusedError("the form cannot be this specimen's", [told])
    cut = {row["patch"]: row for row in design.manifest["facts"]["patches"]}
    found = [text for patch in patches if (text := _unlike(patch, cut.get(patch.patch)))]
    if found:
        raise RefusedError(
            f"the form is not that of {specimen}", [Finding("COUPON-OTHER", text, where=str(form)) for text in found]
        )
    run = start_run(lab.runs, "coupon", specimen=specimen, inputs=[form], config={"length_error_mm": length_error_mm})
    shutil.copyfile(form, run.artefact("coupon.csv"))
    missing = sorted(cut.keys() - {patch.patch for patch in patches})
    run.write_result({"patches": as_rows(patches), "missing": missing})
    run.finish("done", f"{len(patches)} patches read")
    return run


def _unlike(patch: Measured, cut: Mapping[str, Any] | None) -> str:
    """Return what a form's patch has that the coupon as cut has not; nothing where they are the same."""
    if cut is None:
        return f"patch {patch.patch} was not cut"
    if abs(patch.hinge_mm - cut["hinge_mm"]) > FORM_ROUNDING:
        return f"patch {patch.patch}: its hinge is {patch.hinge_mm:g} mm, cut with {cut['hinge_mm']:g} mm"
    expected = cut["expected_expansion_ratio"]
    if (expected is None) != (patch.expected_ratio is None) or (
        expected is not None and abs((patch.expected_ratio or 0.0) - expected) > FORM_ROUNDING
    ):
        return f"patch {patch.patch}: expected to expand by {patch.expected_ratio}, the coupon says {expected}"
    return ""
