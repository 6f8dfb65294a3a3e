"""The tiling and what cells are asked to do: neighbours, exact averages, placements."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from design.errors import DesignError
from design.pattern.assign import ScaleOptions, averaged, factor, overlaps, shared_area_mm2
from design.pattern.tiling import Place, best_place, lattice, region_of, tile

coordinate = st.floats(-5, 5)
triangle = st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=3)


def disk(radius_mm: float, rings_count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import Delaunay

    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rings = [
        radius_mm * r * np.column_stack([np.cos(angle + r), np.sin(angle + r)])
        for r in np.linspace(0.1, 1, rings_count)
    ]
    points = np.vstack([[[0, 0]], *rings])
    return points, Delaunay(points).simplices.astype(np.int64)


@settings(deadline=None)
@given(triangle, triangle)
def test_the_shared_area_of_two_triangles_is_the_polygon_librarys(a: list, b: list) -> None:
    one, two = shapely.Polygon(a), shapely.Polygon(b)
    if one.area < 1e-3 or two.area < 1e-3:
        return
    assert shared_area_mm2(np.array([a]), np.array([b]))[0] == pytest.approx(one.intersection(two).area, abs=1e-6)


def test_upright_and_inverted_cells_are_mirror_images_across_their_edge() -> None:
    tiling = lattice(np.zeros(2), np.array([30.0, 20.0]), 10.0)
    neighbours = tiling.neighbours()
    corners = tiling.vertices_mm[tiling.cells]
    inner = np.flatnonzero((neighbours >= 0).all(axis=1))
    assert len(inner) > 10
    for cell in inner:
        for k in range(3):
            other = neighbours[cell, k]
            shared = [corners[cell, k], corners[cell, k - 1]]
            assert tiling.inverted[cell] != tiling.inverted[other]
            # The same two corners in the same order: both slits measure t from the same end.
            m = next(m for m in range(3) if neighbours[other, m] == cell)
            assert np.array([corners[other, m], corners[other, m - 1]]) == pytest.approx(np.array(shared))


def test_cells_are_equilateral_and_their_first_edge_lies_along_x() -> None:
    tiling = lattice(np.zeros(2), np.array([30.0, 20.0]), 7.0)
    corners = tiling.vertices_mm[tiling.cells]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2) == pytest.approx(7.0)
    along = corners[:, 1] - corners[:, 0]
    assert along == pytest.approx(np.tile([7.0, 0.0], (len(along), 1)))


def test_a_uniform_expansion_stays_uniform_and_areas_add_up() -> None:
    points, faces = disk(60)
    tiling = tile(points, faces, 10)
    for how in ("exact", "published"):
        assert averaged(tiling, points, faces, np.full(len(faces), 1.44), how) == pytest.approx(1.2)
    cell, area, _ = overlaps(tiling.vertices_mm[tiling.cells], points[faces])
    region = region_of(points, faces)
    cells = shapely.polygons(tiling.vertices_mm[tiling.cells])
    exact = shapely.area(shapely.intersection(cells, region))
    assert np.bincount(cell, area) == pytest.approx(exact, abs=1e-9)


def test_the_exact_average_is_the_integral_over_the_cell_whatever_the_mesh() -> None:
    # Area ratio 1 + x/100 on faces so fine that each is nearly constant.
    x, y = np.meshgrid(np.linspace(-40, 40, 161), np.linspace(-40, 40, 161))
    points = np.column_stack([x.ravel(), y.ravel()])
    here = np.add.outer(np.arange(160) * 161, np.arange(160)).ravel()
    faces = np.vstack([np.column_stack([here, here + 1, here + 162]), np.column_stack([here, here + 162, here + 161])])
    ratio = 1 + points[faces].mean(axis=1)[:, 0] / 100
    tiling = tile(points, faces, 10)
    inside = np.abs(tiling.vertices_mm[tiling.cells]).max(axis=(1, 2)) <= 40
    found = averaged(tiling, points, faces, ratio)[inside]
    assert found**2 == pytest.approx(1 + tiling.centres_mm()[inside, 0] / 100, abs=1e-4)


def test_no_kept_cell_hangs_by_a_corner_of_its_own() -> None:
    tiling = tile(*disk(43), 10)
    uses = np.bincount(tiling.cells.ravel(), minlength=len(tiling.vertices_mm))
    assert (uses[tiling.cells] > 1).all()


@settings(max_examples=5, deadline=None)
@given(st.floats(35, 60))
def test_the_best_place_fits_at_least_as_well_as_the_centred_one(radius_mm: float) -> None:
    points, faces = disk(radius_mm)

    def misfit(place: Place) -> float:
        put = place.put(points)
        cells = tile(put, faces, 10, place.shift_mm)
        covered = shapely.union_all(shapely.polygons(cells.vertices_mm[cells.cells]))
        flat = region_of(put, faces)
        return flat.symmetric_difference(covered).area / flat.area

    place, estimate = best_place(points, faces, 10)
    assert misfit(place) == pytest.approx(estimate, abs=0.025)  # a border cell more or less
    assert misfit(place) <= misfit(Place()) + 0.02


def test_a_flat_smaller_than_a_cell_is_refused() -> None:
    with pytest.raises(DesignError, match="not one cell"):
        tile(*disk(3), 10)


def test_each_end_of_the_range_is_met_exactly() -> None:
    limits = (1.2, 1.8)
    assert 1.5 * factor(1.0, 1.5, limits, ScaleOptions("high")) == pytest.approx(1.8)
    assert 1.0 * factor(1.0, 1.5, limits, ScaleOptions("low")) == pytest.approx(1.2)
    middle = factor(1.0, 1.4, limits, ScaleOptions("middle"))
    assert 1.8 / (1.4 * middle) == pytest.approx(middle / 1.2)
    assert 1.5 * factor(1.0, 1.5, limits, ScaleOptions("value", 1.6)) == pytest.approx(1.6)
