"""The shipped library against the paper's published figures, and what it refuses to answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design.cells.geometry import strip_mm
from design.cells.homogenise import even_curve_mm2, solve_pair
from design.cells.library import SHIPPED, SHIPPED_OPEN, CellLibrary, LibraryError, load_library
from design.cells.mesh import REFERENCE
from design.cells.sheet import Sheet
from design.cells.sweep import Kind, plan_of


@pytest.fixture(scope="module")
def library() -> CellLibrary:
    return load_library()


def comparable(rows: np.ndarray) -> np.ndarray:
    strip = np.array([strip_mm(10 * t, theta, Sheet()) for t, theta in rows[:, :2]]) / 10
    return (strip > 0.01) & (rows[:, 3] > 0.3) & (rows[:, 1] <= 0.26)


def test_the_interpolated_map_agrees_with_the_published_one(library: CellLibrary, shared: Path) -> None:
    rows = np.genfromtxt(shared / "published/cell_library_half.csv", delimiter=",", skip_header=1)
    rows = rows[comparable(rows)]
    assert len(rows) == 3148
    cells = library.at(10 * rows[:, 0], rows[:, 1])
    assert cells.inside.mean() > 0.995
    rows, inside = rows[cells.inside], cells.inside
    error = np.abs(cells.expansion_ratio[inside] - rows[:, 2])
    assert np.median(error) < 0.0015 and np.quantile(error, 0.99) < 0.004
    ratio = cells.stiffness_mJ[inside] / rows[:, 4]
    scale = np.median(ratio)
    assert np.quantile(np.abs(ratio / scale - 1), 0.95) < 0.04
    assert np.quantile(np.abs(cells.barrier_mJ[inside] / rows[:, 3] / scale - 1), 0.95) < 0.12


def test_a_point_on_the_grid_is_given_back_exactly(library: CellLibrary) -> None:
    some = slice(None, None, 37)
    cells = library.at(library.t_mm[some], library.theta_rad[some])
    np.testing.assert_allclose(cells.expansion_ratio, library.expansion_ratio[some], rtol=1e-9)
    np.testing.assert_allclose(cells.Y_N_mm, library.Y_N_mm[some], rtol=1e-9)


def test_every_candidate_of_the_paper_is_decided(library: CellLibrary) -> None:
    counts = library.counts()
    assert sum(counts.values()) == 7552
    assert counts["invalid"] == counts["not converged"] == 0
    assert sum(library.reasons().values()) == counts["not bistable"]


@pytest.mark.parametrize(("path", "kind"), [(SHIPPED, "slit"), (SHIPPED_OPEN, "open")])
def test_the_shipped_files_are_those_of_the_solver_beside_them(path: Path, kind: Kind) -> None:
    library = load_library(path)
    plan = plan_of(library.sheet, t_step_mm=library.meta["plan"]["t_step_mm"], kind=kind)
    assert library.hash == plan.key(), "the solver's text has changed: build both anew (docs/cells.md, Shipped files)"


def test_every_candidate_with_a_second_state_counts(library: CellLibrary) -> None:
    t_mm, theta_rad = library.shallow_cells()
    assert 100 < len(t_mm) < 150 and not any("shallow" in reason for reason in library.reasons())
    last = {theta: library.t_mm[library.theta_rad == theta].max() for theta in np.unique(library.theta_rad)}
    ends = {theta: t_mm[theta_rad == theta].max() for theta in np.unique(theta_rad)}
    assert ends == last  # each column ends in shallow wells, down to the one next to the fold
    cells = library.at(t_mm, theta_rad)
    assert cells.inside.all() and (cells.barrier_mJ > 0).all()


def test_the_range_is_the_published_one(library: CellLibrary) -> None:
    low, high = library.range_ratio()  # Chen et al. 2021: 1.129 to 1.775
    assert low == pytest.approx(1.129, abs=0.005) and high == pytest.approx(1.775, abs=0.005)


def test_outside_the_map_there_is_no_number(library: CellLibrary) -> None:
    cells = library.at(np.array([5.0, 0.5, 1.0]), np.array([0.0, 0.5, 1.0]))
    assert not cells.inside.any() and np.isnan(cells.expansion_ratio).all()


@pytest.mark.parametrize(("t_mm", "theta_deg"), [(1.0, 0.0), (1.23, 4.9), (2.1, -7.7), (0.7, 15.1)])
def test_the_energy_curve_has_the_maps_wells_and_barrier(library: CellLibrary, t_mm: float, theta_deg: float) -> None:
    curve = library.energy_curve(t_mm, np.radians(theta_deg))
    here = library.at(t_mm, np.radians(theta_deg))
    at_P5 = int(np.argmin(np.abs(curve.stretch_ratio - here.expansion_ratio)))
    assert curve.energy_mJ[0] == pytest.approx(0, abs=1e-9)
    barrier = curve.energy_mJ[:at_P5].max() - curve.energy_mJ[at_P5]
    assert barrier == pytest.approx(float(here.barrier_mJ), rel=0.02)  # sampled: the saddle lies between two points
    assert curve.energy_mJ[at_P5] == curve.energy_mJ[at_P5 - 2 : at_P5 + 3].min()


def test_a_kept_energy_curve_is_what_the_solver_finds(library: CellLibrary) -> None:
    row = int(library.table["curve_row"][200])
    t_mm, theta = library.table["t_mm"][row], library.table["theta_rad"][row]
    found = solve_pair(t_mm, theta, library.sheet, REFERENCE)
    assert isinstance(found, tuple)
    scale = library.sheet.E_MPa * library.sheet.thickness_mm
    fresh = scale * np.array(even_curve_mm2(*found))
    np.testing.assert_allclose(library.energy_curve(t_mm, theta).energy_mJ, fresh, atol=1e-6 * fresh.max())


def test_a_stiffer_thicker_sheet_scales_energies_only(library: CellLibrary) -> None:
    other = library.scaled(replace(library.sheet, E_MPa=3.0, thickness_mm=4.6))
    np.testing.assert_allclose(other.barrier_mJ, 4 * library.barrier_mJ)
    np.testing.assert_allclose(other.expansion_ratio, library.expansion_ratio)


def test_another_hinge_needs_another_library(library: CellLibrary) -> None:
    with pytest.raises(LibraryError, match="build one"):
        library.scaled(replace(library.sheet, hinge_mm=0.5))


def test_a_file_that_is_no_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cells.npz"
    path.write_bytes(b"no")
    with pytest.raises(LibraryError, match="no library of cells"):
        load_library(path)
