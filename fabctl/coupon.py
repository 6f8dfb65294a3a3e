"""A coupon's form, filled in at the table: measured expansions beside those that finite elements expect."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from design.bundle import Bundle, open_bundle
from design.coupon import FORM, PatchAsCut, patches_as_cut
from design.errors import NoBundle
from design.findings import Finding
from fabctl.errors import RefusedError, UnreadableInput
from fabctl.files import text_of
from fabctl.records.folder import RunFolder, start_run
from fabctl.workspace import Workspace

KIND = "coupon-read"  # of the run
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

    def off_ratio(self) -> float:
        """Return measured less expected, which is the flat's own length where the patch should spring back."""
        return self.expansion_ratio - (1.0 if self.expected_ratio is None else self.expected_ratio)

    def agrees(self) -> bool:
        """Say whether the map lies within the uncertainty."""
        return abs(self.off_ratio()) <= self.uncertainty_ratio


def open_coupon(folder: Path, form: Path) -> dict[str, PatchAsCut]:
    """Return what was cut, from the `cells.csv` of a coupon's folder; raise `RefusedError` where it is none.

    `form` is read first: one that cannot be read is told before the folder it lies in.
    """
    text_of(form, "a coupon's form")
    try:
        found = open_bundle(folder)
    except NoBundle as fault:
        hint = "leave it in the coupon's folder, or say whose it is with --specimen"
        told = Finding(
            "COUPON-ALONE", f"what was cut is not known: {folder} holds no coupon", where=str(form), hint=hint
        )
        raise UnreadableInput("the form cannot be read there", [told]) from fault
    if found.kind != "coupon":
        told = Finding("COUPON-SPECIMEN", "was cut from a design, not from a coupon", where=str(folder))
        raise RefusedError("a coupon's form cannot be read there", [told])
    return _as_cut(found)


def _as_cut(found: Bundle) -> dict[str, PatchAsCut]:
    try:
        return patches_as_cut(found.cells())
    except (KeyError, ValueError) as fault:
        told = Finding("COUPON-CELLS", "says of no cell which patch it is in", where=str(found.path / "cells.csv"))
        raise UnreadableInput("an older coupon; make it again", [told]) from fault


def read_form(path: Path, length_error_mm: float, cut: Mapping[str, PatchAsCut]) -> list[Measured]:
    """Return the patches of a filled form; raise `RefusedError` with everything that is missing or cannot be.

    Hinges and expected expansions are those of `cut`; a form that says others is another coupon's. Several readings of
    one length stand in its field parted by spaces or semicolons. `length_error_mm` is the standard error of one reading
    of the rule or calliper; it counts once for a patch, the scatter of readings beside it.
    """
    lines = text_of(path, "a coupon's form").splitlines()
    head = next((k for k, line in enumerate(lines) if not line.lstrip('"').startswith("#")), len(lines))
    rows = list(csv.DictReader(lines[head:]))
    names = rows[0].keys() if rows else ()
    missing = [name for name in FORM if name not in names]
    if missing:
        text = f"has no column {', '.join(missing)}" if rows else "has no rows"
        raise UnreadableInput("not a coupon's form", [Finding("COUPON-FORM", text, where=str(path))])
    found: list[Finding] = []
    patches = [_patch(row, f"{path}:{k}", length_error_mm, cut, found) for k, row in enumerate(rows, start=head + 2)]
    names_seen = [_word(row, "patch") for row in rows]
    for name in sorted({name for name in names_seen if names_seen.count(name) > 1}):
        found.append(Finding("COUPON-TWICE", f"patch {name} stands there twice", where=str(path)))
    if found:
        raise RefusedError("the form is not filled in as it should be", found)
    return [patch for patch in patches if patch is not None]


def _patch(
    row: dict[str, str], where: str, length_error_mm: float, cut: Mapping[str, PatchAsCut], found: list[Finding]
) -> Measured | None:
    before = len(found)
    name = _word(row, "patch")
    mine = cut.get(name)
    if mine is None:
        text = f"patch {name or '?'} was not cut; the coupon has {', '.join(cut)}"
        found.append(Finding("COUPON-OTHER", text, where=where))
    else:
        found += [Finding("COUPON-OTHER", text, where=where) for text in _unlike(name, row, mine)]

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

    flat = number("flat_length_mm", _word(row, "flat_length_mm"))
    words = _word(row, "measured_length_mm").replace(";", " ").split() or [""]
    lengths = [number("measured_length_mm", word) for word in words]
    cycles = _count("cycles_count", _word(row, "cycles_count"), where, found, needed=True)
    failed = _count("failed_at", _word(row, "failed_at"), where, found, needed=False)
    if failed is not None and cycles is not None and failed > cycles:
        text = f"failed at cycle {failed}, but only {cycles} were made"
        found.append(Finding("COUPON-CYCLES", text, where=where))
    for length in lengths:
        if math.isfinite(length) and math.isfinite(flat) and not LOW_RATIO < length / flat < HIGH_RATIO:
            text = f"{length:g} mm from {flat:g} mm flat is no expansion that a cell can have"
            found.append(Finding("COUPON-LENGTH", text, where=where))
    if len(found) > before or cycles is None or mine is None:
        return None
    ratios = [length / flat for length in lengths]
    scatter = stdev(ratios) / math.sqrt(len(ratios)) if len(ratios) > 1 else 0.0
    uncertainty = COVERAGE * math.hypot(length_error_mm / flat, scatter)
    expected = mine.expansion_ratio
    return Measured(name, mine.hinge_mm, expected, fmean(ratios), uncertainty, len(ratios), cycles, failed)


def _unlike(name: str, row: dict[str, str], mine: PatchAsCut) -> list[str]:
    """Return what the form says of a patch and the coupon as cut does not; what was left empty says nothing."""
    found = []
    pairs = (("hinge_mm", mine.hinge_mm, " mm"), ("expected_expansion_ratio", mine.expansion_ratio, ""))
    for column, value, unit in pairs:
        text = _word(row, column)
        known = "none" if value is None else f"{value:.4f}{unit}"
        try:
            same = not text or (value is not None and abs(float(text) - value) <= FORM_ROUNDING)
        except ValueError:
            same = False
        if not same:
            found.append(f"patch {name}: {column} is {text} in the form, {known} as cut: the form of another coupon?")
    return found


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
    lab: Workspace, specimen: str, form: Path, patches: list[Measured], length_error_mm: float, cut: Iterable[str]
) -> RunFolder:
    """Write a run of kind `coupon-read` with the form and what it says; `cut` are the letters of all patches."""
    run = start_run(lab.runs, KIND, specimen=specimen, inputs=[form], config={"length_error_mm": length_error_mm})
    shutil.copyfile(form, run.artefact("coupon.csv"))
    missing = sorted(set(cut) - {patch.patch for patch in patches})
    run.write_result({"patches": as_rows(patches), "missing": missing})
    run.finish("done", sentence(patches))
    return run


def sentence(patches: Sequence[Measured]) -> str:
    """Return in a line whether the map holds on the patches that were measured."""
    off = [patch.patch for patch in patches if not patch.agrees()]
    if off:
        return f"{len(off)} of {len(patches)} patches off the map by more than their uncertainty: {', '.join(off)}"
    return f"{len(patches)} patches measured, all within their uncertainty of the map"
