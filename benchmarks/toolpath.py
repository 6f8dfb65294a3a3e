"""Order, kerf and read-back of cuts: `python -m benchmarks toolpath`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import shapely
from numpy.typing import NDArray

from benchmarks import Figure
from benchmarks._readback import read_dxf, read_gcode, read_svg
from benchmarks._travel_bound import bound_mm
from design.export.dxf import dxf
from design.export.gcode import LINE_LIMIT, gcode
from design.export.svg import svg
from design.pattern.order import floor_mm, greedy_with_flips, tour, travel_mm
from design.pattern.paths import LAYERS, CutPath, Layer, LayerPreset
from design.pattern.sequence import sequence
from design.pattern.toolpath import ToolOptions, strokes_of

Array = NDArray[np.float64]
COUNT = 20_000
# The published table's naive 3452 m is that of strokes scattered over 331 mm; its greedy 31.5 m belongs to 3 mm there.
SIDE_MM, STROKE_MM = 331.0, 3.0
OTHER_STROKES_MM = (0.5, 1.0, 2.0, 5.0, 10.0)
KERF_MM = 0.2


def random_strokes(stroke_mm: float = STROKE_MM, seed: int = 0) -> Array:
    """Return the ends of short strokes in random places and directions, `(2n, 2)`."""
    rng = np.random.default_rng(seed)
    start, angle = rng.uniform(0, SIDE_MM, (COUNT, 2)), rng.uniform(0, 2 * math.pi, COUNT)
    end = start + stroke_mm * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.stack([start, end], axis=1).reshape(-1, 2)


def spirals(pitch_mm: float = 3.0) -> Array:
    """Return the ends of hexagonal spirals on a hexagonal lattice in raster order, outer end first, `(2n, 2)`."""
    side = math.isqrt(COUNT)
    row, column = np.divmod(np.arange(COUNT), side)
    centre = pitch_mm * np.column_stack([column + row % 2 / 2, math.sqrt(3) / 2 * row])
    outer = centre + np.array([0.45 * pitch_mm, 0.0])
    inner = centre + 0.02 * pitch_mm * np.array([0.5, math.sqrt(3) / 2])
    return np.stack([outer, inner], axis=1).reshape(-1, 2)


def travel_figures() -> list[Figure]:
    """Return travel on both sheets, and the time it took to order them (the kernels compiled before)."""
    tour(random_strokes()[:200])
    random, hexagons = random_strokes(), spirals()
    greedy_m = travel_mm(random, greedy_with_flips(random)) / 1000
    order, took_s = _timed(lambda: tour(random))
    ratio = travel_mm(random, order) / 1000 / greedy_m
    spiral_order, spiral_s = _timed(lambda: tour(hexagons))
    over = travel_mm(hexagons, spiral_order) / floor_mm(hexagons) - 1
    return [
        Figure("greedy with flips, random strokes", round(greedy_m, 2), "m", "", None, COUNT),
        Figure("travel over greedy, random strokes", round(ratio, 4), "", "<= 0.75", ratio <= 0.75, COUNT),
        *(_shorter_or_longer(stroke_mm) for stroke_mm in OTHER_STROKES_MM),
        Figure("ordering 20,000 random strokes", round(took_s, 2), "s CPU", "<= 5 s", took_s <= 5, COUNT),
        Figure("travel over the floor, hexagonal spirals", round(100 * over, 3), "%", "<= 1 %", over <= 0.01, COUNT),
        Figure("ordering 20,000 spirals", round(spiral_s, 2), "s CPU", "<= 5 s", spiral_s <= 5, COUNT),
    ]


def _shorter_or_longer(stroke_mm: float) -> Figure:
    """Return travel over greedy for strokes of another length; without a target, which is for the published sheet."""
    ends = random_strokes(stroke_mm)
    order, took_s = _timed(lambda: tour(ends))
    ratio = travel_mm(ends, order) / travel_mm(ends, greedy_with_flips(ends))
    return Figure(f"the same, strokes of {stroke_mm:g} mm ({took_s:.1f} s CPU)", round(ratio, 4), "", "", None, COUNT)


def _timed(work: Callable[[], NDArray[np.int64]]) -> tuple[NDArray[np.int64], float]:
    began = time.process_time()
    result = work()
    return result, time.process_time() - began


def bound_figures() -> list[Figure]:
    """Return for each length of stroke the bound over greedy, and how far above it the order found lies."""
    figures = []
    for stroke_mm in (*OTHER_STROKES_MM[:2], STROKE_MM, OTHER_STROKES_MM[-1]):
        ends = random_strokes(stroke_mm)
        greedy_mm, found_mm = travel_mm(ends, greedy_with_flips(ends)), travel_mm(ends, tour(ends))
        bound = bound_mm(ends, found_mm)
        name = f"strokes of {stroke_mm:g} mm"
        figures.append(Figure(f"bound over greedy, {name}", round(bound / greedy_mm, 4), "", "", None, COUNT))
        above = round(100 * (found_mm / bound - 1), 2)
        figures.append(Figure(f"found above the bound, {name}", above, "%", "", None, COUNT))
    return figures


def nesting_figure() -> Figure:
    """Return how many contours are cut after one that holds them, among rings in rings."""
    angle = np.linspace(0, 2 * math.pi, 40, endpoint=False)
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    rng = np.random.default_rng(0)
    rings = [
        CutPath("outline", (unit if k % 2 == 0 else unit[::-1]) * (10 - 2 * k) + 25 * np.array([x, y]), closed=True)
        for x in range(6)
        for y in range(6)
        for k in range(4)
    ]
    found = sequence(strokes_of([rings[k] for k in rng.permutation(len(rings))]))
    areas = [shapely.Polygon(stroke.points_mm) for stroke in found]
    wrong = sum(areas[a].contains(areas[b]) for a in range(len(areas)) for b in range(a + 1, len(areas)))
    return Figure("contours cut after one that holds them", wrong, "", "none", wrong == 0, len(areas))


def kerf_figures() -> list[Figure]:
    """Return the worst error of areas and of widths when the beam has burnt its kerf along every stroke."""
    angle = np.linspace(0, 2 * math.pi, 720, endpoint=False)
    disk = 15 * np.column_stack([np.cos(angle), np.sin(angle)])
    area_error, width_error = 0.0, 0.0
    square, triangle = np.array([[0.0, 0], [60, 0], [60, 40], [0, 40]]), np.array([[0.0, 0], [60, 0], [10, 40]])
    # Not the triangle as a hole: no round beam cuts a sharp inner corner, whatever path it takes.
    cuts: list[tuple[Layer, list[Array]]] = [("outline", [square, triangle, disk]), ("hole", [square, disk])]
    for layer, loops in cuts:
        for loop in loops:
            drawn = shapely.Polygon(loop)
            left = shapely.box(-80, -80, 140, 120).difference(_burnt(CutPath(layer, loop, closed=True)))
            parts = sorted(getattr(left, "geoms", [left]), key=lambda part: part.area)
            found = parts[0] if layer == "outline" else shapely.Polygon(parts[-1].interiors[0])
            area_error = max(area_error, abs(found.area - drawn.area))
            width_error = max(width_error, float(np.abs(np.subtract(found.bounds, drawn.bounds)).max()))
    for width in (0.25, 0.5, 1.0):
        options = ToolOptions(KERF_MM, slit_width_mm=width, slit_sides="both")
        void = _burnt(CutPath("slit", np.array([[0.0, 0], [4, 0], [8, 0]])), options)
        low_x, low_y, high_x, high_y = shapely.Polygon(void.exterior).bounds
        width_error = max(width_error, abs(high_y - low_y - width), abs(high_x - low_x - 8))
    return [
        Figure("kerf: worst error of an area", round(area_error, 5), "mm²", "exact to 0.01", area_error <= 0.01, 5),
        Figure("kerf: worst error of a width", round(width_error, 5), "mm", "exact to 0.01 mm", width_error <= 0.01, 8),
    ]


def _burnt(path: CutPath, options: ToolOptions | None = None) -> shapely.Polygon:
    options = options or ToolOptions(KERF_MM)
    lines = [shapely.LineString(stroke.points_mm) for stroke in strokes_of([path], options)]
    return shapely.union_all([line.buffer(KERF_MM / 2, quad_segs=128) for line in lines])  # type: ignore[return-value]


def export_figures() -> list[Figure]:
    """Return how far polylines that were written and read again lie from the drawn ones."""
    rng = np.random.default_rng(0)
    paths = [CutPath(LAYERS[k % 5], rng.uniform(0, 200, (rng.integers(2, 7), 2))) for k in range(2000)]
    paths.sort(key=lambda path: LAYERS.index(path.layer))
    presets = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
    program = gcode(paths, presets)
    lines, faults = read_gcode(program)
    found = {
        "DXF": [line.points_mm for line in read_dxf(dxf(paths, (200.0, 200.0)))],
        "SVG": [line.points_mm for line in read_svg(svg(paths, (200.0, 200.0)))],
        "G-code": lines,
    }
    figures = []
    for name, again in found.items():
        worst = max(float(np.abs(a - b.points_mm).max()) for a, b in zip(again, paths, strict=True))
        figures.append(Figure(f"{name} read back", round(worst, 6), "mm", "<= 0.001 mm", worst <= 1e-3, len(paths)))
    clean = not faults and max(map(len, program)) <= LINE_LIMIT
    figures.append(Figure("G-code: words GRBL 1.1 lacks, or over 79 characters", len(faults), "", "none", clean, 1))
    return figures


def measure(words: list[str]) -> list[Figure]:
    """Return all figures of the toolpath, or with `--bound` what no order of the random strokes can beat."""
    if words[:1] == ["--bound"]:
        return bound_figures()
    return [*travel_figures(), nesting_figure(), *kerf_figures(), *export_figures()]
