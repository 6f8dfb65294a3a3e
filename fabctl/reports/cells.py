"""Pictures of the cell library: maps over (t, θ), one cell's energy, and one cell's states."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from design.cells.library import CellLibrary
    from design.cells.periodic import Curve
    from design.cells.states import CellStates

Array = NDArray[np.float64]
MAP_COUNT = 240  # points of a drawn map each way: a quarter of a degree


def _figure(width_in: float, height_in: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write the figure; the suffix chooses SVG, PDF or PNG. The same figure gives the same bytes."""
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "fabctl", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def maps(library: CellLibrary) -> Figure:
    """Return the four maps: expansion, barrier, stiffness and tangent Poisson ratio, read between the columns too."""
    figure = _figure(11, 8)
    t_mm = np.linspace(library.t_mm.min(), library.t_mm.max(), MAP_COUNT)
    theta = np.linspace(library.theta_rad.min(), library.theta_rad.max(), MAP_COUNT)
    cells = library.at(t_mm[None, :], theta[:, None])
    fields = (
        ("expansion 1 + ε", cells.expansion_ratio),
        ("barrier, mJ per cell", cells.barrier_mJ),
        ("stiffness d²E*/dε², mJ per cell", cells.stiffness_mJ),
        ("tangent Poisson ratio", cells.nu_tangent_ratio),
    )
    for axes, (title, values) in zip(figure.subplots(2, 2).flat, fields, strict=True):
        drawn = axes.pcolormesh(t_mm, np.degrees(theta), values, shading="nearest", rasterized=True)
        figure.colorbar(drawn, ax=axes)
        axes.set(title=title, xlabel="t, mm", ylabel="θ, °")
    return figure


def energy(curve: Curve, states_ratio: tuple[float, float], scale_mJ: float, title: str) -> Figure:
    """Return energy and force of one cell against its uniaxial stretch, saddle and second stable state marked."""
    figure = _figure(9, 4)
    left, right = figure.subplots(1, 2)
    marks = np.searchsorted(curve.F00_ratio, states_ratio)
    for axes, values in ((left, curve.energy_mm2 * scale_mJ), (right, curve.force_mm2 * scale_mJ)):
        axes.plot(curve.F00_ratio, values)
        axes.plot(curve.F00_ratio[marks], values[marks], "o", color="#b5482f", markersize=4)
        for mark, name in zip(marks, ("saddle", "second state"), strict=True):
            away, side = (4, "left") if name == "saddle" else (-4, "right")  # the second state lies near the frame
            below = axes is left and name != "saddle"  # the energy comes down to it from above, the force from below
            place, shift = (curve.F00_ratio[mark], values[mark]), (away, -11 if below else 4)
            axes.annotate(name, place, shift, textcoords="offset points", ha=side, fontsize=8)
        axes.margins(y=0.12)
    left.set(title=title, xlabel="1 + ε", ylabel="E*, mJ per cell")
    right.axhline(0, color="0.6", linewidth=0.8)
    right.set(xlabel="1 + ε", ylabel="dE*/dε, mJ per cell")
    return figure


def states(found: CellStates) -> Figure:
    """Return the unit at rest, at the saddle and in its second stable state, at one scale."""
    from matplotlib.collections import PolyCollection

    figure = _figure(3.2 * len(found.states), 3.4)
    axes = np.atleast_1d(figure.subplots(1, len(found.states), sharex=True, sharey=True))
    for place, state in zip(axes, found.states, strict=True):
        place.add_collection(
            PolyCollection(list(state.triangles_mm), facecolors="#7fa7c9", edgecolors="#33516b", linewidths=0.2)
        )
        place.set_aspect("equal")
        place.set_axis_off()
        place.set_title(f"{state.name}\n1 + ε = {state.stretch_ratio:.4f}", fontsize=9)
        place.autoscale_view()
    return figure
