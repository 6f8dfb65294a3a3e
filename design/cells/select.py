"""Which cell for which expansion: the isoline of the library at that expansion, and one point of it by a rule.

The library is read column by column: at one theta the expansion falls steadily with t, so (expansion, theta) is as good
a pair of coordinates as (t, theta), and every point of a table over them expands by exactly what it says. That is what
takes the bias out of the published rule, which takes the stiffest *entry* within 0.005 of the wanted expansion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from design.cells.library import CellLibrary
from design.errors import DesignError, OutOfLibrary

Array = NDArray[np.float64]
Rule = Literal["smooth", "stiffest", "barrier", "published"]

STEP_RATIO = 0.001  # of expansion, between the table's rows: a fifth of the published rule's window
WINDOW_RATIO = 0.005  # the published rule takes the stiffest entry that comes this close
DENSE_COLUMNS_COUNT, DENSE_ROWS_COUNT = 241, 401  # where the library interpolates itself: 0.17°, 0.006 mm
CHUNK_COUNT = 4000  # expansions looked up at a time
COLUMNS_LIMIT_COUNT = 400  # a library with more distinct angles than this is not a set of columns
REFINE_COUNT = 33  # finer angles on which the smooth curve is looked for once more, about the coarse one
REFINE_ROUNDS_COUNT = 4
JUMP_MM = 0.01  # in t, between two rows: more is a jump (0.02 mm per 0.002 of expansion), where a smooth curve ends


class CellMap(Protocol):
    """What selection needs of a library: its bistable cells, `(n,)` each."""

    @property
    def t_mm(self) -> Array:
        """Slit offset."""
        ...

    @property
    def theta_rad(self) -> Array:
        """Slit angle."""
        ...

    @property
    def expansion_ratio(self) -> Array:
        """Deployed over flat length."""
        ...

    @property
    def barrier_mJ(self) -> Array:
        """Energy to snap back, per hexagonal cell."""
        ...

    @property
    def stiffness_mJ(self) -> Array:
        """Second derivative of the energy by the uniaxial strain, per hexagonal cell."""
        ...


@dataclass(frozen=True, slots=True)
class SelectionOptions:
    """How the cell of an expansion is chosen.

    `smooth` follows the isoline's stiffest point but gives up to `max_stiffness_loss_frac` of stiffness for a curve
    without jumps; `stiffest` and `barrier` take the isoline's best point; `published` is the paper's rule. Cells below
    `barrier_floor_mJ` are left out, which also moves the low end of the expansions that can be had.
    """

    rule: Rule = "smooth"
    max_stiffness_loss_frac: float = 0.05
    barrier_floor_mJ: float = 0.0


@dataclass(frozen=True, slots=True)
class Choice:
    """One cell for each wanted expansion, `(k,)` arrays; `expansion_ratio` is the chosen cell's own."""

    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    stiffness_mJ: Array
    barrier_mJ: Array


@dataclass(frozen=True, slots=True)
class Table:
    """The library over (expansion, theta); NaN where no bistable cell is. Rows `(m,)`, columns `(c,)`."""

    expansion_ratio: Array  # (m,)
    theta_rad: Array  # (c,)
    t_mm: Array  # (m, c)
    stiffness_mJ: Array  # (m, c)
    barrier_mJ: Array  # (m, c)


@dataclass(frozen=True, slots=True)
class SelectionCurve:
    """The rule, worked out over the whole range once, one row per step of expansion."""

    options: SelectionOptions
    expansion_ratio: Array  # (m,) rising
    t_mm: Array  # (m,)
    theta_rad: Array  # (m,)
    stiffness_mJ: Array  # (m,)
    barrier_mJ: Array  # (m,)
    best_stiffness_mJ: Array  # (m,) the isoline's stiffest point, to say what the curve gave up
    table: Table  # what it was chosen from

    def range_ratio(self) -> tuple[float, float]:
        """Return the least and the greatest expansion the rule can serve."""
        return float(self.expansion_ratio[0]), float(self.expansion_ratio[-1])


def table_of(
    library: CellMap, barrier_floor_mJ: float = 0.0, rows: Array | None = None, angles_rad: Array | None = None
) -> Table:
    """Return the library resampled to rows of equal expansion; cells under the barrier floor are left out.

    `rows` and `angles_rad` take the place of the library's own expansions and angles.
    """
    columns = _columns(library, barrier_floor_mJ, angles_rad)
    if not columns:
        raise DesignError(
            f"no cell of the library has a barrier of {barrier_floor_mJ:g} mJ; the highest is "
            f"{float(np.max(library.barrier_mJ)):g} mJ: lower the floor or take thicker rubber"
        )
    low = min(column.expansion_ratio[-1] for column in columns)
    high = max(column.expansion_ratio[0] for column in columns)
    if rows is None:
        rows = np.linspace(low, high, max(2, round((high - low) / STEP_RATIO) + 1))
    shape = (len(rows), len(columns))
    t, stiffness, barrier = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    for k, column in enumerate(columns):
        rising = column.expansion_ratio[::-1]
        for table, value in ((t, column.t_mm), (stiffness, column.stiffness_mJ), (barrier, column.barrier_mJ)):
            table[:, k] = np.interp(rows, rising, value[::-1], left=np.nan, right=np.nan)
    return Table(rows, np.array([column.theta_rad for column in columns]), t, stiffness, barrier)


@dataclass(frozen=True, slots=True)
class _Column:
    """The cells of one angle, by rising t and so falling expansion."""

    theta_rad: float
    expansion_ratio: Array
    t_mm: Array
    stiffness_mJ: Array
    barrier_mJ: Array


@dataclass(frozen=True, slots=True)
class _Samples:
    """A library interpolated at many more points than it has cells."""

    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    barrier_mJ: Array
    stiffness_mJ: Array


def angles_of(library: CellMap) -> Array:
    """Return the dense angles on which a library is read that can interpolate itself."""
    return np.linspace(library.theta_rad.min(), library.theta_rad.max(), DENSE_COLUMNS_COUNT)


def _densely(library: CellMap, angles_rad: Array | None) -> CellMap:
    """Return the library on dense columns where it can interpolate itself, else as it is."""
    if isinstance(library, CellLibrary):
        library = library.firm()
    at = getattr(library, "at", None)
    if at is None:
        return library
    theta_rad = angles_of(library) if angles_rad is None else angles_rad
    t_mm = np.linspace(library.t_mm.min(), library.t_mm.max(), DENSE_ROWS_COUNT)
    cells = at(*(grid.ravel() for grid in np.meshgrid(t_mm, theta_rad)))
    fields = (cells.t_mm, cells.theta_rad, cells.expansion_ratio, cells.barrier_mJ, cells.stiffness_mJ)
    return _Samples(*(field[cells.inside] for field in fields))


def _columns(library: CellMap, floor_mJ: float, angles_rad: Array | None) -> list[_Column]:
    found = []
    library = _densely(library, angles_rad)
    angles, which = np.unique(np.round(library.theta_rad, 7), return_inverse=True)
    if len(angles) > COLUMNS_LIMIT_COUNT:
        raise DesignError(
            f"the library has {len(angles)} different angles; it must be sampled in columns of equal theta"
        )
    for k, theta in enumerate(angles):
        rows = np.flatnonzero((which == k) & (library.barrier_mJ >= floor_mJ))
        rows = rows[np.argsort(library.t_mm[rows], kind="stable")]
        ratio = library.expansion_ratio[rows]
        if len(rows) > 1 and ratio[0] < ratio[-1]:  # contracting cells close less and less as t grows
            rows = rows[: _falling_count(-ratio)][::-1]
        else:
            rows = rows[: _falling_count(ratio)]
        if len(rows) < 2:
            continue
        values = (library.expansion_ratio, library.t_mm, library.stiffness_mJ, library.barrier_mJ)
        found.append(_Column(float(theta), *(value[rows] for value in values)))
    return found


def _falling_count(expansion_ratio: Array) -> int:
    """Return how many entries fall strictly before the first one that does not."""
    rises = np.flatnonzero(np.diff(expansion_ratio) >= 0)
    return int(rises[0]) + 1 if len(rises) else len(expansion_ratio)


def selection_curve(library: CellMap, options: SelectionOptions = SelectionOptions()) -> SelectionCurve:
    """Return the rule's choice over the whole range; not for the published rule, which has no curve."""
    return curve_of(table_of(library, options.barrier_floor_mJ), options)


def curve_of(table: Table, options: SelectionOptions) -> SelectionCurve:
    """Return the rule's choice over all rows of a table."""
    stiffness = np.where(np.isnan(table.stiffness_mJ), -np.inf, table.stiffness_mJ)
    best = stiffness.max(axis=1)
    if options.rule == "smooth":
        theta_rad = _smooth_path(table, options.max_stiffness_loss_frac)
    else:
        theta_rad = table.theta_rad[_best_column(table.barrier_mJ if options.rule == "barrier" else table.stiffness_mJ)]
    values = [_along(table, value, theta_rad) for value in (table.t_mm, table.stiffness_mJ, table.barrier_mJ)]
    rows = _smooth_rows(values[0]) if options.rule == "smooth" else slice(0, None)
    t, chosen, barrier = (value[rows] for value in values)
    return SelectionCurve(options, table.expansion_ratio[rows], t, theta_rad[rows], chosen, barrier, best[rows], table)


def _best_column(value: Array) -> NDArray[np.int64]:
    return np.asarray(np.argmax(np.where(np.isnan(value), -np.inf, value), axis=1))


def _smooth_rows(t_mm: Array) -> slice:
    """Return the longest run of rows without a jump: near the bistable limit a library is ragged, whatever the cap."""
    ends = np.r_[-1, np.flatnonzero(~(np.abs(np.diff(t_mm)) <= JUMP_MM)), len(t_mm) - 1]
    longest = int(np.argmax(np.diff(ends)))
    start, stop = int(ends[longest]) + 1, int(ends[longest + 1]) + 1
    if stop - start < 2:
        raise DesignError(
            "no smooth curve of cells runs through this library within the allowed loss of stiffness; "
            "raise max_stiffness_loss_frac, take the rule `stiffest`, or a finer library"
        )
    return slice(start, stop)


def select(library: CellMap, expansion_ratio: Array, options: SelectionOptions = SelectionOptions()) -> Choice:
    """Return a cell for every wanted expansion, `(k,)`; raise `OutOfLibrary` where the rule has none."""
    if options.rule == "published":
        return _published(library, expansion_ratio, options.barrier_floor_mJ)
    return on_curve(selection_curve(library, options), expansion_ratio)


def on_curve(curve: SelectionCurve, expansion_ratio: Array, slack_ratio: float = 1e-9) -> Choice:
    """Return the curve's cells at the wanted expansions; `slack_ratio` forgives rounding at the two ends."""
    wanted = np.asarray(expansion_ratio, dtype=np.float64)
    low, high = curve.range_ratio()
    if wanted.size and (wanted.min() < low - slack_ratio or wanted.max() > high + slack_ratio):
        raise OutOfLibrary(float(wanted.min()), float(wanted.max()), (low, high))
    wanted = np.clip(wanted, low, high)
    if curve.options.rule == "smooth":
        values = [
            np.interp(wanted, curve.expansion_ratio, y)
            for y in (curve.t_mm, curve.theta_rad, curve.stiffness_mJ, curve.barrier_mJ)
        ]
    else:  # the best point may jump from column to column: look at all of them, at this very expansion
        parts = np.array_split(wanted, max(1, len(wanted) // CHUNK_COUNT))
        values = [np.concatenate(column) for column in zip(*(_best_at(curve, part) for part in parts), strict=True)]
    return Choice(values[0], values[1], wanted, values[2], values[3])


def _best_at(curve: SelectionCurve, wanted: Array) -> tuple[Array, Array, Array, Array]:
    """Return t, theta, stiffness and barrier of the rule's best column at each wanted expansion."""
    table = curve.table
    rows = table.expansion_ratio
    k = np.clip(np.searchsorted(rows, wanted, side="right") - 1, 0, len(rows) - 2)
    share = ((wanted - rows[k]) / (rows[k + 1] - rows[k]))[:, None]
    t, stiffness, barrier = (
        (1 - share) * value[k] + share * value[k + 1] for value in (table.t_mm, table.stiffness_mJ, table.barrier_mJ)
    )
    pick = _best_column(barrier if curve.options.rule == "barrier" else stiffness)
    here = np.arange(len(wanted))
    return t[here, pick], table.theta_rad[pick], stiffness[here, pick], barrier[here, pick]


def _along(table: Table, value: Array, theta_rad: Array) -> Array:
    """Return `value` of the table at one angle per row, linear between columns, `(m,)`."""
    columns = table.theta_rad
    if len(columns) == 1:
        return value[:, 0]
    k = np.clip(np.searchsorted(columns, theta_rad, side="right") - 1, 0, len(columns) - 2)
    share = (theta_rad - columns[k]) / (columns[k + 1] - columns[k])
    row = np.arange(len(value))
    left, right = value[row, k], value[row, k + 1]
    # At a column itself the neighbour may be empty and must not spoil the value.
    return np.where(share <= 0, left, np.where(share >= 1, right, (1 - share) * left + share * right))


def _smooth_path(table: Table, loss_frac: float) -> Array:
    """Return the angle per row of the shortest path in (t, l0 theta) that keeps the allowed stiffness.

    Dynamic programming over the table's columns, then again over ever finer angles about the path found.
    """
    best = np.nanmax(np.where(np.isnan(table.stiffness_mJ), -np.inf, table.stiffness_mJ), axis=1)
    floor = (1 - loss_frac) * best
    candidates = np.broadcast_to(table.theta_rad, table.t_mm.shape)
    path = _cheapest(table, candidates, floor)
    if len(table.theta_rad) == 1:
        return path
    reach = float(np.max(np.diff(table.theta_rad)))
    for _ in range(REFINE_ROUNDS_COUNT):
        around = path[:, None] + np.linspace(-reach, reach, REFINE_COUNT)
        around[:, REFINE_COUNT // 2] = path
        path = _cheapest(table, np.clip(around, table.theta_rad[0], table.theta_rad[-1]), floor)
        reach *= 4 / REFINE_COUNT
    return path


def _cheapest(table: Table, theta_rad: NDArray[np.float64], floor_mJ: Array) -> Array:
    """Return the path over `(m, c)` candidate angles with the least sum of squared steps."""
    t = np.column_stack([_along(table, table.t_mm, column) for column in theta_rad.T])
    stiffness = np.column_stack([_along(table, table.stiffness_mJ, column) for column in theta_rad.T])
    # The best point itself always passes, whatever rounding says.
    allowed = ~np.isnan(stiffness) & (stiffness >= floor_mJ[:, None] * (1 - 1e-12))
    scale_mm = 3 * float(np.nanmax(table.t_mm))  # stands for the edge: t goes up to a third of it
    cost = np.where(allowed[0], 0.0, np.inf)
    came = np.zeros(t.shape, dtype=np.int64)
    for row in range(1, len(t)):
        step = (t[row][None, :] - t[row - 1][:, None]) ** 2
        step += (scale_mm * (theta_rad[row][None, :] - theta_rad[row - 1][:, None])) ** 2
        total = cost[:, None] + np.where(np.isnan(step), np.inf, step)
        came[row] = np.argmin(total, axis=0)
        cost = np.where(allowed[row], total[came[row], np.arange(t.shape[1])], np.inf)
    pick = int(np.argmin(cost))
    path = np.empty(len(t))
    for row in range(len(t) - 1, -1, -1):
        path[row] = theta_rad[row, pick]
        pick = came[row, pick]
    return path


def _published(library: CellMap, expansion_ratio: Array, floor_mJ: float) -> Choice:
    """Return the stiffest entry within 0.005 of each wanted expansion (Chen et al. 2021)."""
    usable = np.flatnonzero(library.barrier_mJ >= floor_mJ)
    order = usable[np.argsort(library.expansion_ratio[usable], kind="stable")]
    ratio, stiffness = library.expansion_ratio[order], library.stiffness_mJ[order]
    wanted = np.asarray(expansion_ratio, dtype=np.float64)
    first = np.searchsorted(ratio, wanted - WINDOW_RATIO, side="right")
    last = np.searchsorted(ratio, wanted + WINDOW_RATIO, side="left")
    if (first >= last).any():
        raise OutOfLibrary(float(wanted.min()), float(wanted.max()), (float(ratio[0]), float(ratio[-1])))
    pick = order[[a + int(np.argmax(stiffness[a:b])) for a, b in zip(first, last, strict=True)]]
    return Choice(
        library.t_mm[pick],
        library.theta_rad[pick],
        library.expansion_ratio[pick],
        library.stiffness_mJ[pick],
        library.barrier_mJ[pick],
    )
