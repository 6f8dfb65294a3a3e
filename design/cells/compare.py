"""A published table of cells against this solver: each row solved afresh, and the shipped map interpolated."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells import homogenise
from design.cells.geometry import strip_mm
from design.cells.homogenise import Cell
from design.cells.library import CellLibrary, energy_scale_mJ
from design.cells.mesh import REFERENCE, Density
from design.cells.sheet import Sheet
from design.errors import DesignError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

COMPARABLE_STRIP_RATIO = 0.01  # t_s/edge: below, the published map is resampled over its own border
COMPARABLE_BARRIER = 0.3  # in the published unit
COMPARABLE_THETA_RAD = 0.26


@dataclass(frozen=True, slots=True)
class Published:
    """A table of cells in the published units, (n,) each: t and energies relative, expansion as a ratio."""

    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    barrier_ratio: Array
    stiffness_ratio: Array

    def comparable(self, sheet: Sheet) -> NDArray[np.bool_]:
        """Return where the table is not an artefact of its own resampling."""
        pairs = zip(self.t_mm, self.theta_rad, strict=True)
        strip = np.array([strip_mm(t, theta, sheet) for t, theta in pairs]) / sheet.edge_mm
        loud = self.barrier_ratio > COMPARABLE_BARRIER
        return np.asarray((strip > COMPARABLE_STRIP_RATIO) & loud & (self.theta_rad <= COMPARABLE_THETA_RAD))


@dataclass(frozen=True, slots=True)
class Spread:
    """How a set of errors lies: absolute for expansions, relative for energies."""

    count: int
    median: float
    q95: float
    q99: float
    worst: float

    @staticmethod
    def of(errors: Array) -> Spread:
        """Return the spread of the finite `errors`, taken positive."""
        good = np.abs(errors[np.isfinite(errors)])
        if not len(good):
            return Spread(0, np.nan, np.nan, np.nan, np.nan)
        return Spread(len(good), *map(float, np.quantile(good, [0.5, 0.95, 0.99, 1.0])))


@dataclass(frozen=True, slots=True)
class Comparison:
    """Errors of one way to get the numbers, over a subset of the table."""

    rows_count: int
    answered_count: int
    scale: float  # published energy per mm² of ours, one number for stiffness and barrier
    expansion: Spread
    expansion_bias_ratio: float
    stiffness: Spread
    barrier: Spread
    worst: tuple[int, ...]  # rows of the table, worst expansion first


COLUMNS = ("t_over_l0", "theta_rad", "expansion_ratio", "energy_barrier", "stiffness")
PLACE_COLUMNS = COLUMNS[:2]  # without them a row is no cell; a missing figure is only not compared
UNITS = {"t_over_l0": ("1", "-", "mm/mm"), "theta_rad": ("rad", "radian", "radians"), "expansion_ratio": ("1", "-")}
TOLD_FAULTS_COUNT = 20


class TableError(DesignError):
    """The table cannot be read; `faults` says all that is wrong with it."""

    def __init__(self, faults: Sequence[str]) -> None:
        told = "; ".join(faults[:TOLD_FAULTS_COUNT])
        more = len(faults) - TOLD_FAULTS_COUNT
        super().__init__(f"{told}; and {more} more" if more > 0 else told)
        self.faults = tuple(faults)


def read_published(text: str, sheet: Sheet) -> Published:
    """Return the table in `text`, whose header names `COLUMNS` in any order and case, among others.

    A name may be followed by its unit in brackets; cells are parted by commas, semicolons or tabs. An empty or `nan`
    figure is kept as NaN and not compared. Raises `TableError` with every fault at once.
    """
    lines = [(k, line) for k, line in enumerate(text.lstrip("\ufeff").splitlines(), 1) if _is_content(line)]
    if not lines:
        raise TableError([f"the table is empty; its header must name {', '.join(COLUMNS)}"])
    mark = max(",;\t", key=lines[0][1].count)
    headings = [_heading(cell) for cell in _cells(lines[0][1], mark)]
    names = [name for name, _ in headings]
    faults = [f"no column {name} in the header" for name in COLUMNS if name not in names]
    faults += [
        f"{name} is in {unit}, it must be in {UNITS[name][0]}" for name, unit in headings if _foreign(name, unit)
    ]
    faults += [f"the header names {name} more than once" for name in COLUMNS if names.count(name) > 1]
    if faults:
        raise TableError(faults)
    if len(lines) == 1:
        raise TableError(["the table has a header and no rows"])
    places = [names.index(name) for name in COLUMNS]
    rows = []
    for number, line in lines[1:]:
        cells = _cells(line, mark)
        if len(cells) != len(names):
            faults.append(f"line {number}: {len(cells)} cells under {len(names)} names")
            continue
        pairs = zip(COLUMNS, places, strict=True)
        rows.append([_number(cells[k], name, number, faults) for name, k in pairs])
    if faults:
        raise TableError(faults)
    t, theta, expansion, barrier, stiffness = np.array(rows).T
    return Published(t * sheet.edge_mm, theta, expansion, barrier, stiffness)


def _is_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _cells(line: str, mark: str) -> list[str]:
    return next(csv.reader([line], delimiter=mark))


def _heading(cell: str) -> tuple[str, str]:
    """Return name and unit ('' for none) of a heading such as `theta_rad [rad]`, in lower case."""
    name, bracket, unit = re.sub(r"[(\[]", "(", cell.strip().lower()).partition("(")
    return name.strip(), unit.rstrip(")] ") if bracket else ""


def _foreign(name: str, unit: str) -> bool:
    return bool(unit) and name in UNITS and unit not in UNITS[name]


def _number(cell: str, name: str, line: int, faults: list[str]) -> float:
    """Return the cell as a number, NaN where it is empty; what cannot be used is added to `faults`."""
    try:
        value = float(cell) if cell.strip() else math.nan
    except ValueError:
        faults.append(f"line {line}: {name} {cell.strip()!r} is no number")
        return math.nan
    if name in PLACE_COLUMNS and not math.isfinite(value):
        faults.append(f"line {line}: {name} is {cell.strip() or 'empty'}")
    return value if math.isfinite(value) else math.nan


def solve_rows(
    table: Published,
    sheet: Sheet,
    density: Density = REFERENCE,
    jobs: int = 1,
    done: Callable[[int], None] | None = None,
) -> list[Cell]:
    """Return each row of the table solved; rows of one θ follow each other, so each starts from its neighbours."""
    columns = [np.flatnonzero(table.theta_rad == theta) for theta in np.unique(table.theta_rad)]
    columns = [rows[np.argsort(table.t_mm[rows], kind="stable")] for rows in columns]
    columns.sort(key=len, reverse=True)  # so that no worker is left alone with a long column at the end
    found: list[Cell | None] = [None] * len(table.t_mm)
    from joblib import Parallel, delayed

    finished = 0
    work = (delayed(_solve_rows)(rows, table, sheet, density) for rows in columns)
    for rows, cells in Parallel(n_jobs=jobs, return_as="generator_unordered")(work):
        for row, cell in zip(rows, cells, strict=True):
            found[row] = cell
        finished += len(rows)
        if done is not None:
            done(finished)
    return [cell for cell in found if cell is not None]


def _solve_rows(rows: Ints, table: Published, sheet: Sheet, density: Density) -> tuple[Ints, list[Cell]]:
    return rows, _column(table.t_mm[rows], float(table.theta_rad[rows[0]]), sheet, density)


def _column(t_mm: Array, theta_rad: float, sheet: Sheet, density: Density) -> list[Cell]:
    cells, trail = [], homogenise.Trail()
    steps = np.diff(t_mm, prepend=np.nan)
    for k, t in enumerate(t_mm):
        even = bool(0.8 * steps[k - 1] < steps[k] < 1.2 * steps[k - 1])
        found, mesh_ratio, trail = homogenise.walked(float(t), theta_rad, sheet, density, trail, even)
        cells.append(homogenise.cell_of(float(t), theta_rad, found, mesh_ratio))
    return cells


def columns_of(cells: list[Cell]) -> tuple[Array, Array, Array]:
    """Return expansion, stiffness and barrier of the cells, NaN where there is none."""

    def column(name: str) -> Array:
        return np.array([np.nan if (v := getattr(c, name)) is None else v for c in cells], dtype=float)

    return column("expansion_ratio"), column("stiffness_mm2"), column("barrier_mm2")


def interpolated(table: Published, library: CellLibrary) -> tuple[Array, Array, Array]:
    """Return expansion, stiffness and barrier of the rows read off the library's map."""
    cells, scale = library.at(table.t_mm, table.theta_rad), energy_scale_mJ(library.sheet)
    return cells.expansion_ratio, cells.stiffness_mJ / scale, cells.barrier_mJ / scale


def compared(
    table: Published, numbers: tuple[Array, Array, Array], subset: NDArray[np.bool_], scale: float | None = None
) -> Comparison:
    """Return the errors over `subset`; the one scale is fitted to the stiffness there unless given."""
    expansion, stiffness, barrier = (values[subset] for values in numbers)
    if scale is None:
        scale = _median(table.stiffness_ratio[subset] / stiffness)
    error = expansion - table.expansion_ratio[subset]
    order = np.argsort(-np.where(np.isfinite(error), np.abs(error), -1.0))[:5]
    return Comparison(
        rows_count=int(subset.sum()),
        answered_count=int(np.isfinite(expansion).sum()),
        scale=scale,
        expansion=Spread.of(error),
        expansion_bias_ratio=_median(error),
        stiffness=Spread.of(scale * stiffness / table.stiffness_ratio[subset] - 1),
        barrier=Spread.of(scale * barrier / table.barrier_ratio[subset] - 1),
        worst=tuple(int(row) for row in np.flatnonzero(subset)[order]),
    )


def _median(values: Array) -> float:
    """Return the median of the finite `values`, NaN where there is none."""
    good = values[np.isfinite(values)]
    return float(np.median(good)) if len(good) else math.nan


@dataclass(frozen=True, slots=True)
class Unanswered:
    """A row of the table for which a way has no numbers."""

    row: int  # counted from 1, the header left out
    t_mm: float
    theta_deg: float
    verdict: str
    reason: str


def unanswered(cells: list[Cell]) -> list[Unanswered]:
    """Return every row that was solved to no bistable cell, with the reason."""
    return [
        Unanswered(k, cell.t_mm, math.degrees(cell.theta_rad), cell.verdict, cell.reason)
        for k, cell in enumerate(cells, 1)
        if cell.verdict != "bistable"
    ]


def outside(table: Published, expansion_ratio: Array) -> list[Unanswered]:
    """Return every row that the map could not be read at."""
    reason = "no bistable cells of the map surround it"
    return [
        Unanswered(k + 1, float(table.t_mm[k]), math.degrees(table.theta_rad[k]), "outside the map", reason)
        for k in np.flatnonzero(~np.isfinite(expansion_ratio)).tolist()
    ]


def verdicts(cells: list[Cell]) -> dict[str, int]:
    """Return how many cells came to each verdict."""
    return dict(Counter(cell.verdict for cell in cells))


def edge_verdicts(
    table: Published, sheet: Sheet, steps: int = 4, density: Density = REFERENCE
) -> list[tuple[Cell, Cell]]:
    """Return, per column of the table, the cells `steps` of its grid inside and outside its upper edge in t."""
    spacing = float(np.median(np.diff(np.unique(np.round(table.t_mm, 9)))))
    result = []
    for theta in np.unique(table.theta_rad):
        edge = float(table.t_mm[table.theta_rad == theta].max())
        low = float(table.t_mm[table.theta_rad == theta].min())
        if edge - steps * spacing < low - 1e-9:
            continue  # the column is shorter than that
        inside, outside = (
            homogenise.solve_cell(edge + sign * steps * spacing, float(theta), sheet, density) for sign in (-1, 1)
        )
        result.append((inside, outside))
    return result
