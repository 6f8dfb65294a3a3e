"""A published table as people write them: any order and case of columns, gaps, and every fault told at once."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from design.cells.compare import TableError, compared, interpolated, outside, read_published, solve_rows, unanswered
from design.cells.library import CellLibrary, load_library
from design.cells.sheet import Sheet

SHEET = Sheet()
HEADER = "t_over_l0,theta_rad,expansion_ratio,energy_barrier,stiffness"


def test_columns_may_stand_in_any_order_and_case_among_others() -> None:
    plain = read_published(f"{HEADER}\n0.12,0.05,1.6,20,300\n", SHEET)
    header = "Stiffness, NAME ,theta_rad,T_over_l0,Energy_Barrier,expansion_ratio"
    other = f'\ufeff# note\n{header}\n300,"a,b",0.05,0.12,20,1.6\n\n'
    assert read_published(other, SHEET) == plain
    assert plain.t_mm[0] == pytest.approx(1.2)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_headings_may_carry_units_and_cells_other_marks(mark: str) -> None:
    plain = read_published(f"{HEADER}\n0.12,0.05,1.6,20,300\n", SHEET)
    names = ["t_over_l0 (-)", "theta_rad [rad]", "expansion_ratio [1]", "energy_barrier (a.u.)", "stiffness (N/m, old)"]
    quoted = [f'"{name}"' for name in names]
    rows = [mark.join(quoted), mark.join(["0.12", "0.05", "1.6", "20", "300"])]
    assert read_published("\r\n".join(rows), SHEET) == plain


def test_an_angle_in_degrees_is_refused() -> None:
    with pytest.raises(TableError, match="theta_rad is in deg, it must be in rad"):
        read_published(f"{HEADER.replace('theta_rad', 'theta_rad [deg]')}\n0.12,3,1.6,20,300\n", SHEET)


def test_the_order_of_the_rows_changes_nothing() -> None:
    """Each column is walked along t, whatever order its rows stand in."""
    library = load_library()
    columns = zip(library.t_mm / 10, library.theta_rad, library.expansion_ratio, strict=True)
    rows = [",".join([*map(repr, map(float, values)), "1", "1"]) for values in list(columns)[500:530]]
    mixed = [rows[k] for k in np.random.default_rng(4).permutation(len(rows))]
    plain, other = (
        {(c.t_mm, c.theta_rad): c for c in solve_rows(read_published("\n".join([HEADER, *lines]), SHEET), SHEET)}
        for lines in (rows, mixed)
    )
    assert plain == other and len(plain) == 30


def test_all_missing_columns_are_told_at_once() -> None:
    with pytest.raises(TableError) as refused:
        read_published("t_over_l0,theta_rad,theta_rad\n1,2,3\n", SHEET)
    assert len(refused.value.faults) == 4  # three missing, one twice


def test_all_unreadable_rows_are_told_with_their_lines() -> None:
    text = f"{HEADER}\n0.1,x,1.6,20,300\n0.1,0.1\n,0.1,1.6,20,300\n0.1,0.1,1.6,20,300\n0.1,nan,1.6,20,300\n"
    with pytest.raises(TableError) as refused:
        read_published(text, SHEET)
    assert [fault.split(":")[0] for fault in refused.value.faults] == ["line 2", "line 3", "line 4", "line 6"]
    assert "theta_rad 'x' is no number" in str(refused.value)


@pytest.mark.parametrize("text", ["", "\n\n", f"{HEADER}\n"])
def test_a_table_without_rows_is_refused(text: str) -> None:
    with pytest.raises(TableError, match=r"empty|no rows"):
        read_published(text, SHEET)


def test_a_missing_figure_is_not_compared_and_hides_no_other() -> None:
    table = read_published(f"{HEADER}\n0.12,0.05,1.6,20,300\n0.12,0.06,,nan,300\n", SHEET)
    ours = (np.array([1.6, 1.61]), np.array([0.3, 0.3]), np.array([0.02, 0.02]))
    found = compared(table, ours, np.array([True, True]))
    assert found.expansion.count == found.barrier.count == 1 and found.stiffness.count == 2


def test_a_row_without_a_cell_says_why_and_spoils_no_neighbour() -> None:
    rows = ["0.12,0.05", "0.12,0.05", "0.9,0.05", "-1,0.05", "0.3,0.05", "0.12,3.0"]
    table = read_published("\n".join([HEADER, *(f"{row},1.6,20,300" for row in rows)]), SHEET)
    cells = solve_rows(table, SHEET)
    assert cells[0] == replace(cells[1]) and cells[0].verdict == "bistable"
    told = unanswered(cells)
    assert [row.row for row in told] == [3, 4, 5, 6]
    assert [row.verdict for row in told] == ["invalid", "invalid", "not bistable", "invalid"]
    assert all(row.reason for row in told)
    read = interpolated(table, load_library())[0]
    assert [row.row for row in outside(table, read)] == [3, 4, 5, 6]


def test_with_no_row_answered_there_is_no_scale_and_no_warning() -> None:
    table = read_published(f"{HEADER}\n0.9,0.05,1.6,20,300\n", SHEET)
    nothing = np.array([math.nan])
    found = compared(table, (nothing, nothing, nothing), np.array([True]))
    assert found.answered_count == 0 and math.isnan(found.scale)


def test_columns_left_out_of_the_map_are_read_off_it() -> None:
    """At twice the spacing of the shipped map; its own error is a quarter (at the rim, straight) to a sixteenth."""
    library = load_library()
    thetas = np.unique(library.table["theta_rad"])
    left_out = np.isin(library.theta_rad, thetas[1::2])
    t_mm, theta = library.t_mm[left_out], library.theta_rad[left_out]
    cells = _with_columns(library, thetas[::2]).at(t_mm, theta)
    strong = library.barrier_mJ[left_out] > 0.02 * np.median(library.barrier_mJ)
    clear = cells.inside & strong
    assert clear.sum() > 0.9 * strong.sum()
    error = np.abs(cells.expansion_ratio - library.expansion_ratio[left_out])[clear]
    assert np.median(error) < 1e-4
    assert np.quantile(error, 0.95) < 0.004
    assert np.median(np.abs(cells.stiffness_mJ / library.stiffness_mJ[left_out] - 1)[clear]) < 0.002


def _with_columns(library: CellLibrary, thetas: np.ndarray) -> CellLibrary:
    from design.cells.interpolate import grid_of

    rows = np.isin(library.table["theta_rad"], thetas)
    names = ("expansion_ratio", "barrier_mm2", "stiffness_mm2", "nu_tangent_ratio")
    values = np.array([library.table[name][rows] for name in names])
    grid = grid_of(library.table["t_mm"][rows], library.table["theta_rad"][rows], values, library.sheet)
    return replace(library, grid=grid)
