"""One picture of a design: the sheet as it is cut, its cells coloured by what they expand by."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from design.coupon import Coupon, Patch
from design.export.svg import COLOURS
from design.pattern.drawing import Drawing
from design.pattern.paths import LAYERS, CutPath
from design.pattern.tiling import Array
from design.pipeline import Design

WIDTH_INCHES, DPI = 7.5, 200  # a report shows it at half a page: letters must stay legible
TICKS_COUNT = 5  # intervals along the longest axis of a picture in space


def preview_png(design: Design) -> bytes:
    """Return a PNG of the sheet with its expansions and, where predicted, of the deployed shape and the response."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = design.drawing.size_mm
    aspect = min(2.5, max(0.6, height / width))
    predicted = design.predicted is not None
    figure = Figure(figsize=(WIDTH_INCHES * (1.5 if predicted else 1.0), WIDTH_INCHES * aspect), layout="constrained")
    FigureCanvasAgg(figure)
    if predicted:
        grid = figure.add_gridspec(2, 2, width_ratios=[2, 1])
        _draw_design(figure, figure.add_subplot(grid[:, 0]), design)
        _draw_deployed(figure.add_subplot(grid[0, 1], projection="3d"), design)
        _draw_response(figure.add_subplot(grid[1, 1]), design)
    else:
        _draw_design(figure, figure.add_subplot(), design)
    return _png(figure)


def coupon_png(made: Coupon) -> bytes:
    """Return a PNG of a coupon's sheet; patches that spring back are drawn as expanding by nothing."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = made.drawing.size_mm
    figure = Figure(figsize=(WIDTH_INCHES, WIDTH_INCHES * height / width), layout="constrained")
    FigureCanvasAgg(figure)
    corners = np.concatenate([tiling.vertices_mm[tiling.cells] for tiling in made.tilings])
    counts = [len(tiling.cells) for tiling in made.tilings]
    expansion = np.repeat([patch.expansion_ratio or 1.0 for patch in made.patches], counts)
    title = f"coupon: {len(made.patches)} patches on {width:.0f} × {height:.0f} mm"
    axes = figure.add_subplot()
    _draw_sheet(figure, axes, made.drawing, corners, expansion, title)
    for patch in made.patches:
        draw_gauge(axes, patch)
    axes.set_xlabel("x, mm\nmeasure each patch from notch 1 to notch 2, flat and opened; write it into coupon.csv")
    return _png(figure)


def draw_gauge(axes: Any, patch: Patch) -> None:
    """Draw the length to measure, from one notch to the one across, both named inside the patch."""
    axes.plot(*patch.notches_mm.T, "o--", color="#b3261e", linewidth=1.2, markersize=5)
    for number, ((x, y), side) in enumerate(zip(patch.notches_mm.tolist(), ("left", "right"), strict=True), start=1):
        away = 5 if side == "left" else -5  # towards the middle: outside, the next patch's name is near
        axes.annotate(f"{patch.label.split()[0]}{number}", (x, y), (away, 0), textcoords="offset points", ha=side,
                      va="center", color="#b3261e", fontsize=8, weight="bold",
                      bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8})  # fmt: skip


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    return file.getvalue()


def _draw_design(figure: Any, axes: Any, design: Design) -> None:
    cells, (width, height) = design.cells, design.drawing.size_mm
    corners = cells.tiling.vertices_mm[cells.tiling.cells]
    title = f"{design.spec.name}: {len(corners)} cells on {width:.0f} × {height:.0f} mm"
    _draw_sheet(figure, axes, design.drawing, corners, cells.choice.expansion_ratio, title)


def _draw_sheet(figure: Any, axes: Any, drawing: Drawing, corners_mm: Array, expansion: Array, title: str) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    faces = PolyCollection(list(corners_mm), array=expansion, cmap="viridis", alpha=0.45, linewidths=0)
    axes.add_collection(faces)
    for layer in LAYERS:
        lines = [_closed(path) for path in drawing.paths if path.layer == layer]
        axes.add_collection(LineCollection(lines, colors=COLOURS[layer], linewidths=0.9 if layer == "outline" else 0.6))
    width, height = drawing.size_mm
    axes.set(xlim=(0, width), ylim=(0, height), xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes.set_title(title)
    figure.colorbar(faces, ax=axes, label="expansion, deployed over flat length", shrink=0.6)


def _closed(path: CutPath) -> Array:
    return np.vstack([path.points_mm, path.points_mm[:1]]) if path.closed else path.points_mm


def _draw_deployed(axes: Any, design: Design) -> None:
    assert design.predicted is not None
    deployed = design.predicted.deployed
    x, y, z = deployed.mesh.vertices_mm.T
    axes.plot_trisurf(x, y, z, triangles=deployed.mesh.faces, color="#d0b060", edgecolor="#80602080", linewidth=0.2)
    axes.set_aspect("equal")
    few_ticks(axes)
    axes.set_title(f"deployed: {deployed.deviation.mean_mm:.2f} mm from the target on average", fontsize=9)


def few_ticks(axes: Any) -> None:
    """Thin the ticks of each axis of a picture in space by its length, so that no label lies on the next."""
    from matplotlib.ticker import MaxNLocator

    lengths = [abs(float(np.ptp(getattr(axes, f"get_{name}lim")()))) for name in "xyz"]
    for name, length in zip("xyz", lengths, strict=True):
        intervals = max(1, round(TICKS_COUNT * length / max(lengths)))
        getattr(axes, f"{name}axis").set_major_locator(MaxNLocator(intervals, min_n_ticks=1))


def _draw_response(axes: Any, design: Design) -> None:
    assert design.predicted is not None
    response = design.predicted.response
    axes.plot(response.depth_mm, response.load_N, label="in")
    axes.plot(response.depth_mm, response.unload_N, "--", label="out")
    axes.set(xlabel="depth, mm", ylabel="force, N", title="indentation, predicted")
    axes.legend()
