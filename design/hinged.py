"""Hinges of a design that are not the library's: cells are chosen, and predicted, with the hinge they are cut with.

A hinge that widens with the expansion (the published sheets' rule) makes one curve of cells out of the library at
several widths: each row of expansion takes its own width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design.cells.hinges import cells_as_cut, ladder, with_hinge
from design.cells.library import CellLibrary
from design.cells.select import (
    STEP_RATIO,
    Choice,
    SelectionCurve,
    SelectionOptions,
    Table,
    angles_of,
    curve_of,
    table_of,
)
from design.findings import Finding
from design.pattern.slits import HingeOptions
from design.pattern.tiling import Array

RUNGS_COUNT = 5  # library widths between the narrowest and the widest hinge: a field bends little from one to the next


def hinge_of(asked: HingeOptions | None, library: CellLibrary) -> HingeOptions:
    """Return the hinge that is asked for, or the library's own, which grows and shrinks with the cell."""
    return asked or HingeOptions("constant", library.sheet.hinge_mm)


def hinged(library: CellLibrary, options: HingeOptions) -> CellLibrary:
    """Return the library whose tangent stands for a design's hinges: its own width, or the middle of a widening one."""
    added = options.added_mm / 2 if options.rule == "widening" else 0.0
    return with_hinge(library, options.width_mm + added)


@dataclass(frozen=True, slots=True)
class Widening:
    """The library over (expansion, angle) at several hinge widths in even steps, and how a cell is chosen."""

    tables: tuple[Table, ...]
    span_ratio: tuple[float, float]  # from the narrowest hinge's low end to the widest hinge's high end
    options: SelectionOptions

    def curve(self, span_ratio: tuple[float, float] | None = None) -> SelectionCurve:
        """Return the curve of cells whose hinges widen over `span_ratio`, the design's expansions, or over all."""
        low, high = span_ratio or self.span_ratio
        rows = self.tables[0].expansion_ratio
        place = np.clip((rows - low) / max(high - low, 1e-9), 0, 1) * (RUNGS_COUNT - 1)
        table = _blended(self.tables, place)
        some = np.asarray(np.isfinite(table.t_mm).any(axis=1))
        kept = slice(int(np.argmax(some)), len(some) - int(np.argmax(some[::-1])))
        values = (table.t_mm[kept], table.stiffness_mJ[kept], table.barrier_mJ[kept])
        return curve_of(Table(rows[kept], table.theta_rad, *values), self.options)


def widening(library: CellLibrary, hinge: HingeOptions, options: SelectionOptions) -> Widening:
    """Return the tables from which the cells of a widening hinge are chosen."""
    libraries = ladder(library, hinge.width_mm, hinge.width_mm + hinge.added_mm, RUNGS_COUNT)
    span = libraries[0].range_ratio()[0], libraries[-1].range_ratio()[1]
    low = min(one.range_ratio()[0] for one in libraries)
    high = max(one.range_ratio()[1] for one in libraries)
    rows = np.linspace(low, high, round((high - low) / STEP_RATIO) + 1)
    angles = angles_of(library)
    tables = [table_of(one, options.barrier_floor_mJ, rows, angles) for one in libraries]
    return Widening(tuple(tables), span, options)


def _blended(tables: tuple[Table, ...], place: Array) -> Table:
    """Return one table whose row r lies `place[r]` along the tables; they must have the same angles."""
    thetas = tables[0].theta_rad
    for table in tables[1:]:
        thetas = np.intersect1d(np.round(thetas, 9), np.round(table.theta_rad, 9))
    pick = [np.isin(np.round(table.theta_rad, 9), np.round(thetas, 9)) for table in tables]
    k = np.minimum(place.astype(np.int64), len(tables) - 2)
    rows, share = np.arange(len(place)), (place - k)[:, None]

    def mixed(name: str) -> Array:
        stacked = np.array([getattr(table, name)[:, mine] for table, mine in zip(tables, pick, strict=True)])
        return np.asarray((1 - share) * stacked[k, rows] + share * stacked[k + 1, rows])

    return Table(tables[0].expansion_ratio, thetas, mixed("t_mm"), mixed("stiffness_mJ"), mixed("barrier_mJ"))


def as_cut(library: CellLibrary, choice: Choice, hinge_mm: Array) -> tuple[Choice, list[Finding]]:
    """Return cells that were chosen for the library's hinge as they are with their own, and what that changes."""
    found = cells_as_cut(library, choice.t_mm, choice.theta_rad, hinge_mm)
    known = np.isfinite(found["expansion_ratio"])
    expansion = np.where(known, found["expansion_ratio"], choice.expansion_ratio)
    stiffness = np.where(known, found["stiffness_mJ"], choice.stiffness_mJ)
    barrier = np.where(known, found["barrier_mJ"], choice.barrier_mJ)
    shift = expansion - choice.expansion_ratio
    text = f"hinges of {hinge_mm.min():.3f} to {hinge_mm.max():.3f} mm change expansions by {shift.min():+.4f} to "
    text += f"{shift.max():+.4f} against the library's {library.sheet.hinge_mm:g} mm; the prediction is for them as cut"
    findings = [Finding("HINGE-SHIFT", text, "warning")]
    if not known.all():
        text = f"{int((~known).sum())} cells are not known to stay open with their hinge; taken as with the library's"
        findings.append(Finding("HINGE-UNKNOWN", text, "warning", hint="take narrower hinges, or another rule"))
    return Choice(choice.t_mm, choice.theta_rad, expansion, stiffness, barrier), findings


def hinge_range(base: CellLibrary, library: CellLibrary) -> list[Finding]:
    """Return between which expansions cells are known to stay open with the design's hinges, if not the library's."""
    if library is base:
        return []
    (low, high), (own_low, own_high) = library.range_ratio(), base.range_ratio()
    text = (
        f"with hinges of about {library.sheet.hinge_mm:.3g} mm cells are known to stay open from {low:.3f} to "
        f"{high:.3f}, with the library's {base.sheet.hinge_mm:.3g} mm from {own_low:.3f} to {own_high:.3f}"
    )
    return [Finding("HINGE-RANGE", text, "info")]
