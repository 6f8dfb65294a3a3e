"""The cell library: agreement with the published map, decisions, speed, growth and stability.

`python -m benchmarks cells [--published CSV] [--quick] [--no-sweep]`. The published table is looked for in
$FABCTL_SHARED and beside the project; without it the figures that need it are given as not measured.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import Figure
from design.cells import compare as comparing
from design.cells import homogenise
from design.cells.homogenise import Failure
from design.cells.library import load_library
from design.cells.mesh import REFERENCE, Density, topology
from design.cells.periodic import periodic_cell, positions, smallest_eigenvalues
from design.cells.select import select
from design.cells.sheet import Sheet
from design.cells.stability import out_of_plane_eigenvalues
from design.cells.sweep import column_t_mm, plan_of, thetas_rad

SHEET = Sheet()
PLAN = plan_of(SHEET)
CORES = 2
SAMPLE_COUNT = 120  # rows solved on the half-size mesh
STATES = (
    (1.2, 3.0),
    (0.5, 0.0),
    (2.2, 0.0),
    (0.6, 15.0),
    (2.5, -12.0),
    (2.4, 1.4),
    (2.84, -18.57),
    (0.65, 21.43),
)  # t in mm, θ in degrees
CURVE_RATIOS = np.array([1.16, 1.18, 1.2, 1.23, 1.26, 1.29, 1.35, 1.45, 1.55, 1.65, 1.75])


def measure(words: list[str]) -> list[Figure]:
    """Return the figures of the cell library."""
    figures = [*_library(), *_speed(), *_growth(), *_stability(), *_rubber()]
    path = _published(words)
    if path is None:
        figures.append(Figure("published map", None, "", "the table, beside the project or --published", None, 0))
    else:
        figures += _published_figures(path, quick="--quick" in words)
    if "--no-sweep" not in words:
        figures += _sweeps()
    return figures


def _published(words: list[str]) -> Path | None:
    if "--published" in words:
        return Path(words[words.index("--published") + 1])
    shared = Path(os.environ.get("FABCTL_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    path = shared / "published" / "cell_library_half.csv"
    return path if path.is_file() else None


def _library() -> Iterator[Figure]:
    library = load_library()
    low, high = library.range_ratio()
    counts = library.counts()
    total = sum(counts.values())
    valid = total - counts["invalid"]
    decided = (counts["bistable"] + counts["not bistable"]) / valid
    name = "range of the shipped library, all bistable cells"
    yield Figure(f"{name}, low", low, "", "1.129 within 0.005", abs(low - 1.129) <= 0.005, len(library))
    yield Figure(f"{name}, high", high, "", "1.775 within 0.005", abs(high - 1.775) <= 0.005, len(library))
    places = list(zip(*library.shallow_cells(), strict=True))
    yield Figure("  shallow wells among them, decided at half the mesh size", len(places), "", "told", None, total)
    for name, density, every in (
        ("the reference mesh", REFERENCE, 1),
        ("half the mesh size", REFERENCE.refined(2), 1),
        ("a third", REFERENCE.refined(3), 4),
        ("a quarter", REFERENCE.refined(4), 9),
    ):
        found = _expansions(places[::every], density)
        yield Figure(f"  least expansion of those, {name}", min(found), "", "told", None, len(found))
    yield Figure("valid polygons decided", decided, "", "≥ 0.995", decided >= 0.995, valid)
    for verdict, count in counts.items():
        yield Figure(f"candidates {verdict}", count, "", "shown", None, total)
    for reason, count in library.reasons().items():
        yield Figure(f"  because: {reason}", count, "", "shown", None, total)


def _expansions(places: list[tuple[float, float]], density: Density) -> list[float]:
    """Return the second states of those (t_mm, theta_rad) that have one on this mesh."""
    pairs = (homogenise.solve_pair(float(t_mm), float(theta), SHEET, density) for t_mm, theta in places)
    return [found[1].stable.s_ratio for found in pairs if not isinstance(found, Failure)]


def _column(theta_rad: float, density: Density) -> tuple[list[float], list[float]]:
    """Return CPU milliseconds of the bistable and of the other cells of one column, solved as the sweep does."""
    plan = plan_of(SHEET, density=density)
    bistable: list[float] = []
    other: list[float] = []
    trail = homogenise.Trail()
    for t_mm in column_t_mm(plan, theta_rad):
        begin = time.process_time()
        found, mesh_ratio, trail = homogenise.walked(float(t_mm), theta_rad, SHEET, density, trail)
        homogenise.cell_of(float(t_mm), theta_rad, found, mesh_ratio)
        spent_ms = 1e3 * (time.process_time() - begin)
        (other if isinstance(found, Failure) else bistable).append(spent_ms)
    return bistable, other


def _speed() -> Iterator[Figure]:
    homogenise.solve_cell(1.0, 0.0, SHEET)  # compiled and cached before the clock starts
    bistable: list[float] = []
    other: list[float] = []
    for theta in thetas_rad(plan_of(SHEET))[12:36:6]:
        good, bad = _column(float(theta), REFERENCE)
        bistable += good
        other += bad
    mean = float(np.mean(bistable))
    yield Figure("time per bistable cell, all figures, one core", mean, "ms CPU", "≤ 20 ms", mean <= 20, len(bistable))
    yield Figure("  95 % of them below", float(np.quantile(bistable, 0.95)), "ms CPU", "shown", None, len(bistable))
    yield Figure("time per cell that is not bistable", float(np.mean(other)), "ms CPU", "shown", None, len(other))


def _growth() -> Iterator[Figure]:
    sizes, spent = [], []
    for density in (REFERENCE, replace(REFERENCE, rows=6, columns=12), REFERENCE.refined(2), REFERENCE.refined(3)):
        homogenise.solve_cell(1.0, 0.0, SHEET, density)
        begin = time.process_time()
        for t_mm in (0.8, 1.2, 1.6):
            homogenise.solve_cell(t_mm, 0.05, SHEET, density)
        spent.append(1e3 * (time.process_time() - begin) / 3)
        sizes.append(18 * len(topology(density).triangles))
        yield Figure(f"a cell from rest, {sizes[-1]} elements per hexagon", spent[-1], "ms CPU", "shown", None, 3)
    power = float(np.polyfit(np.log(sizes), np.log(spent), 1)[0])
    yield Figure("growth of the time with the elements, exponent", power, "", "measured", None, len(sizes))
    ratios = []
    for count in (10, 20, 40, 80):
        begin = time.process_time()
        for t_mm in np.linspace(0.8, 1.6, count):
            homogenise.solve_cell(float(t_mm), 0.05, SHEET)
        ratios.append(time.process_time() - begin)
    power = float(np.polyfit(np.log([10, 20, 40, 80]), np.log(ratios), 1)[0])
    yield Figure("growth of the time with the cells, exponent", power, "", "linear: 1", abs(power - 1) < 0.1, 4)


def _stability() -> Iterator[Figure]:
    for t_mm, theta_deg in STATES:
        found = _eigenvalues(t_mm, np.radians(theta_deg))
        if found is None:
            continue
        where = f"t {t_mm:g} mm, θ {theta_deg:g}°, 2 × 2 cell"
        yield Figure(f"smallest eigenvalue in the plane, {where}", found[0], "", "> 0", found[0] > 0, 1)
        yield Figure(f"smallest eigenvalue out of the plane, {where}", found[1], "1/mm²", "> 0", found[1] > 0, 1)
    chosen = select(load_library(), CURVE_RATIOS)
    pairs = zip(chosen.t_mm, chosen.theta_rad, strict=True)
    values = [found for t_mm, theta in pairs if (found := _eigenvalues(float(t_mm), float(theta))) is not None]
    where = f"cells that designs choose, {CURVE_RATIOS[0]:g} to {CURVE_RATIOS[-1]:g}"
    for k, (name, unit) in enumerate((("in the plane", ""), ("out of the plane", "1/mm²"))):
        least = min(value[k] for value in values)
        yield Figure(f"smallest eigenvalue {name}, {where}", least, unit, "> 0", least > 0, len(values))


def _eigenvalues(t_mm: float, theta_rad: float) -> tuple[float, float] | None:
    """Return the second state's smallest eigenvalue in the plane and out of it, on a 2 × 2 cell."""
    found = homogenise.solve_pair(t_mm, theta_rad, SHEET, REFERENCE)
    if isinstance(found, Failure):
        return None
    m, pair = found
    s = pair.stable.s_ratio
    cell = periodic_cell(m, 8)
    at = positions(cell, m, m.nodes(pair.stable.y, s), s)
    plane = smallest_eigenvalues(cell, at, s * np.eye(2), 2)[0]
    return float(plane), float(out_of_plane_eigenvalues(cell, at, s * np.eye(2), SHEET.thickness_mm, 2)[1])


def _rubber() -> Iterator[Figure]:
    worst = 0.0
    for t_mm, theta_deg in STATES[:5]:
        pair = [
            homogenise.solve_cell(t_mm, np.radians(theta_deg), replace(SHEET, nu_ratio=nu)).expansion_ratio
            for nu in (0.30, 0.45)
        ]
        worst = max(worst, abs((pair[0] or np.nan) - (pair[1] or np.nan)))
    yield Figure("expansion at ν = 0.30 against 0.45, worst", worst, "", "< 0.002", worst < 0.002, 5)


def _published_figures(path: Path, quick: bool) -> Iterator[Figure]:
    table = comparing.read_published(path.read_text(), SHEET)
    subset = table.comparable(SHEET)
    solved = table
    if quick:
        keep = np.unique(table.theta_rad)[::6]
        rows = np.isin(table.theta_rad, keep)
        solved, subset = _rows(table, rows), subset[rows]
    numbers = comparing.columns_of(comparing.solve_rows(solved, SHEET, jobs=CORES))
    yield from _agreement("solved afresh", comparing.compared(solved, numbers, subset))
    everything = np.ones(len(solved.t_mm), dtype=bool)
    fair = comparing.compared(solved, numbers, subset)
    whole = comparing.compared(solved, numbers, everything, fair.scale)
    yield Figure("all rows: expansion, median", whole.expansion.median, "", "shown", None, whole.answered_count)
    yield Figure("all rows: expansion, 99 %", whole.expansion.q99, "", "shown", None, whole.answered_count)
    full = table.comparable(SHEET)
    read = comparing.compared(table, comparing.interpolated(table, load_library()), full)
    yield from _agreement("shipped map interpolated", read)
    yield from _drift(table, full)
    edges = comparing.edge_verdicts(table, SHEET)
    right = sum((a.verdict == "bistable") + (b.verdict != "bistable") for a, b in edges)
    name = "four grid steps inside and outside the published upper edge, right"
    yield Figure(name, right, f"of {2 * len(edges)}", "all right", right == 2 * len(edges), 2 * len(edges))


def _rows(table: comparing.Published, rows: NDArray[np.bool_]) -> comparing.Published:
    return comparing.Published(
        table.t_mm[rows], table.theta_rad[rows], table.expansion_ratio[rows], table.barrier_ratio[rows],
        table.stiffness_ratio[rows],
    )  # fmt: skip


def _agreement(way: str, found: comparing.Comparison) -> Iterator[Figure]:
    e, k, b, n = found.expansion, found.stiffness, found.barrier, found.answered_count
    yield Figure(f"{way}: expansion, median", e.median, "", "median ≤ 0.0015", e.median <= 0.0015, n)
    yield Figure(f"{way}: expansion, 99 %", e.q99, "", "99 % within 0.004", e.q99 <= 0.004, n)
    yield Figure(f"{way}: stiffness, 95 %", k.q95, "", "95 % within 4 %", k.q95 <= 0.04, n)
    yield Figure(f"{way}: barrier, 95 %", b.q95, "", "95 % within 12 %", b.q95 <= 0.12, n)
    yield Figure(f"{way}: scale", found.scale, "per mm²", "one, fitted", None, n)


def _drift(table: comparing.Published, subset: NDArray[np.bool_]) -> Iterator[Figure]:
    rng = np.random.default_rng(1)
    chosen = np.zeros(len(subset), dtype=bool)
    chosen[rng.choice(np.flatnonzero(subset), SAMPLE_COUNT, replace=False)] = True
    part = _rows(table, chosen)
    coarse, fine = (
        comparing.columns_of(comparing.solve_rows(part, SHEET, density, jobs=CORES))
        for density in (REFERENCE, REFERENCE.refined(2))
    )
    drift = fine[0] - coarse[0]
    count = int(np.isfinite(drift).sum())
    yield Figure(
        "drift of the expansion at half the mesh size, median", float(np.nanmedian(drift)), "", "given", None, count
    )
    yield Figure("  its 95 %", float(np.nanquantile(np.abs(drift), 0.95)), "", "given", None, count)
    for name, k in (("stiffness", 1), ("barrier", 2)):
        change = float(np.nanmedian(fine[k] / coarse[k] - 1))
        yield Figure(f"drift of the {name} at half the mesh size, median", change, "", "given", None, count)


def _sweeps() -> Iterator[Figure]:
    total = sum(len(column_t_mm(PLAN, theta)) for theta in thetas_rad(PLAN))
    spent = {jobs: _build_s(jobs) for jobs in (CORES, 1)}
    ok = spent[CORES] <= 120
    yield Figure(f"the paper's sweep, {total} candidates, 2 cores", spent[CORES], "s", "≤ 120 s", ok, total)
    gain = spent[1] / spent[CORES]
    yield Figure("2 workers against 1", gain, "times", "≥ 1.8 times", gain >= 1.8, total)


def _build_s(jobs: int) -> float:
    """Return the seconds of `fabctl library build` in an empty lab, start, joining and writing included."""
    with tempfile.TemporaryDirectory() as home:
        words = [sys.executable, "-m", "fabctl", "--home", home, "library", "build", "--jobs", str(jobs)]
        begin = time.monotonic()
        subprocess.run([*words, "-o", str(Path(home) / "library.npz")], check=True, capture_output=True)
        return time.monotonic() - begin
