"""Cells chosen so that the sheet at rest meets its target: what bending takes away is given beforehand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from design.cells.library import CellLibrary
from design.cells.select import Choice, SelectionCurve, on_curve
from design.deploy.compensate import compensate, misfit_mm
from design.deploy.equilibrium import solve_level
from design.deploy.levels import Layout
from design.deploy.shell import Reals
from design.deploy.standing import FREE, Standing, standing
from design.deploy.supports import Support
from design.errors import NotConverged, OutOfLibrary
from design.findings import Finding
from design.flatten import Flattening
from design.hinged import Widening
from design.pattern.tiling import Array, Tiling
from design.predicted import layout_of, lifted, welded

HELPS_RATIO = 0.9  # of the misfit before; a sheet that gains less than a tenth is left as it was


def compensated(
    flat: Flattening,
    tiling: Tiling,
    wanted_ratio: Array,
    choice: Choice,
    cut: NDArray[np.bool_],
    library: CellLibrary,
    curve: SelectionCurve | None,
    wide: Widening | None,
    found: list[Finding],
    watch: Callable[[str, float], None],
    support: Support = "free",
) -> tuple[Array, Choice]:
    """Return what each cell must expand by and the cells for it; those given where other ones do not help.

    The misfit told is that of the cells chosen anew, with their own stiffness, not that of the optimisation's model.
    Widening hinges run over the design's expansions, so new expansions are served from the curve over their own span.
    With a `support` the sheet bears its weight on it (see `deploy.standing`), otherwise it is free of both.
    Without a `curve` (the published rule) there is nothing to choose from, which is told.
    """
    if curve is None:
        text = "the published rule takes cells without scaling the flat: there is no size to compensate to"
        hint = "take another selection rule"
        found.append(Finding("COMPENSATE-NOT", f"the sheet was left as it was: {text}", "warning", hint=hint))
        return wanted_ratio, choice
    layout, goal = welded(layout_of(tiling, choice, cut, library), tiling, lifted(flat, tiling.vertices_mm))
    held = standing(layout, goal, library.sheet, support)
    try:
        before_mm = points_rms_mm(layout, goal, held)
        bounds = curve.range_ratio()
        answer = compensate(
            layout, goal, bounds, None, held, lambda done: watch("compensating", 0.2 + 0.2 * done), changeable=cut
        )
        asked = np.where(cut, answer.layout.expansion_ratio, wanted_ratio)
        span = float(asked.min()), float(asked.max())
        chosen = on_curve(curve if wide is None else wide.curve(span), asked)
        anew, goal = welded(layout_of(tiling, chosen, cut, library), tiling, lifted(flat, tiling.vertices_mm))
        after_mm = points_rms_mm(anew, goal, held)
    except (NotConverged, OutOfLibrary) as fault:
        found.append(Finding("COMPENSATE-NOT", f"the sheet was left as it was: {fault}", "warning"))
        return wanted_ratio, choice
    loaded = "" if support == "free" else f"under its weight, rim {support}: "
    told = f"{loaded}corresponding points {before_mm:.3f} mm from the target before, {after_mm:.3f} mm after (RMS)"
    if after_mm > HELPS_RATIO * before_mm:
        hint = "the library ends, or the target is met already"
        found.append(Finding("COMPENSATE-NOT", f"compensation does not help: {told}", "warning", hint=hint))
        return wanted_ratio, choice
    told += f"; expansions changed by up to {answer.change_ratio:.4f}, {answer.at_bound_count} at the library's end"
    found.append(Finding("COMPENSATED", told, "info"))
    return asked, chosen


def points_rms_mm(layout: Layout, goal_mm: Reals, held: Standing = FREE) -> float:
    """Return the RMS distance of the sheet's vertices from where they belong, aligned rigidly unless it is held."""
    return misfit_mm(solve_level(layout, goal_mm, held.loads, held.fixed).x_mm, goal_mm, held)
