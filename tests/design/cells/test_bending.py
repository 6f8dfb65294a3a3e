"""Bending stiffness comes from the solid, and agrees with what is known."""

from __future__ import annotations

import numpy as np
import pytest

from design.cells.bending import PlaneCell, bend
from design.cells.bending_map import load_bending, plane_cell
from design.cells.homogenise import Failure
from design.cells.library import load_library
from design.cells.sheet import Sheet


def solid_sheet(parts: int, edge_mm: float, stretch: float = 1.0) -> PlaneCell:
    """Return a rhombus without any slits, periodic, in `parts`² pairs of triangles."""
    basis = np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    place: dict[tuple[int, int], int] = {}

    def node(i: int, j: int) -> int:
        return place.setdefault((i, j), len(place))

    triangles = []
    for i in range(0, 2 * parts, 2):
        for j in range(0, 2 * parts, 2):
            low = [(i, j), (i + 2, j), (i, j + 2), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            high = [(i + 2, j), (i + 2, j + 2), (i, j + 2), (i + 2, j + 1), (i + 1, j + 2), (i + 1, j + 1)]
            triangles += [[node(*n) for n in low], [node(*n) for n in high]]
    index = np.array(list(place))
    points = index @ basis * edge_mm / (2 * parts)
    inside = index % (2 * parts)
    _, owner = np.unique(inside[:, 0] * 1000 + inside[:, 1], return_inverse=True)
    jump = (index - inside) / (2 * parts) @ basis * edge_mm
    return PlaneCell(points, stretch * points, np.array(triangles), owner, jump, np.sqrt(0.75) * edge_mm**2, stretch)


@pytest.mark.parametrize("layers", [1, 2])
def test_a_solid_sheet_bends_like_a_plate(layers: int) -> None:
    found = bend(solid_sheet(2, 10.0), 2.3, 0.45, layers)
    assert pytest.approx(2.3**3 / (12 * (1 - 0.45**2)), rel=1e-9) == found.D_mm3
    assert found.nu_ratio == pytest.approx(0.45, rel=1e-9)
    assert found.anisotropy_ratio < 1e-9


def test_a_solid_sheet_that_starts_stretched_comes_back_to_rest() -> None:
    assert bend(solid_sheet(2, 10.0, stretch=1.05), 2.3, 0.45).expansion_ratio == pytest.approx(1.0, abs=1e-9)


@pytest.fixture(scope="module")
def cell() -> PlaneCell:
    found = plane_cell(1.0, 0.2, Sheet())
    assert not isinstance(found, Failure)
    return found


def test_a_deployed_cell_is_isotropic_only_with_the_work_of_its_prestress(cell: PlaneCell) -> None:
    whole = bend(cell, 2.3, 0.45)
    assert whole.anisotropy_ratio < 1e-8
    assert 0.09 < whole.relative_ratio(2.3) < 0.12
    assert bend(cell, 2.3, 0.45, prestress=False).anisotropy_ratio > 0.1


def test_where_the_cell_is_cut_out_of_the_tiling_does_not_matter(cell: PlaneCell) -> None:
    shift = np.array([3.7, -12.1])
    moved = PlaneCell(
        cell.rest_mm + shift, cell.deployed_mm + cell.expansion_ratio * shift, cell.triangles, cell.owner,
        cell.jump_mm, cell.area_mm2, cell.expansion_ratio,
    )  # fmt: skip
    assert bend(moved, 2.3, 0.45).D_mm3 == pytest.approx(bend(cell, 2.3, 0.45).D_mm3, rel=1e-6)


def test_the_shipped_map_is_what_the_solver_gives() -> None:
    shipped = load_bending()
    k = len(shipped.t_mm) // 2
    fresh_cell = plane_cell(shipped.t_mm[k], shipped.theta_rad[k], shipped.sheet)
    assert not isinstance(fresh_cell, Failure)
    fresh = bend(fresh_cell, shipped.sheet.thickness_mm, shipped.sheet.nu_ratio)
    assert fresh.relative_ratio(shipped.sheet.thickness_mm) == pytest.approx(shipped.D_ratio[k], rel=1e-6)
    assert len(shipped.t_mm) >= 60
    assert shipped.anisotropy_ratio.max() < 1e-7


def test_the_map_answers_for_every_cell_of_the_library() -> None:
    library, shipped = load_library(), load_bending()
    D, nu = shipped.at(library.expansion_ratio, library.theta_rad)
    assert np.all((D > 0.03) & (D < 0.2))
    assert np.all(np.abs(nu[library.expansion_ratio > 1.2]) < 1)  # nearer to the limit a cell hardly resists doming
    sheet = Sheet(E_MPa=3.0)
    assert shipped.D_mJ(1.5, 0.1, sheet) == pytest.approx(shipped.at(1.5, 0.1)[0] * 3.0 * 2.3**3 / 12)


def test_left_out_cells_are_foretold_from_the_others() -> None:
    from scipy.interpolate import CloughTocher2DInterpolator

    shipped = load_bending()
    points = np.column_stack([shipped.expansion_ratio, shipped.theta_rad])
    errors = []
    for k in range(0, len(points), 3):
        others = np.arange(len(points)) != k
        guess = CloughTocher2DInterpolator(points[others] * 10, shipped.D_ratio[others])(points[k] * 10).item()
        errors.append(guess / shipped.D_ratio[k] - 1)
    errors = [error for error in errors if np.isfinite(error)]
    assert len(errors) > 15
    assert np.median(np.abs(errors)) < 0.03
