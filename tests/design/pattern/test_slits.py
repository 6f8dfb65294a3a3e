"""Slits and outline: the published pattern from its published parameters, topology, loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

from benchmarks._published import SHEET_OFFSET_MM, flat, half_map, table
from design.cells.select import SelectionOptions, select
from design.pattern.assign import averaged
from design.pattern.slits import HingeOptions, hinge_widths_mm, outline_loops, slit_paths, slits_of
from design.pattern.tiling import Tiling, lattice, tile

SLIT_mm = 0.125


def hexagon() -> Tiling:
    tiling = lattice(np.zeros(2), np.array([30.0, 30.0]), 10.0)
    middle = tiling.vertices_mm[tiling.cells[len(tiling.cells) // 2, 0]]
    return tiling.part(np.linalg.norm(tiling.centres_mm() - middle, axis=1) < 6)


def patterned(tiling: Tiling, t_mm: float = 1.0, theta_rad: float = 0.2, hinge_mm: float = 0.25):
    count = len(tiling.cells)
    return slits_of(tiling, np.full(count, t_mm), np.full(count, theta_rad), np.full(count, hinge_mm), SLIT_mm)


def test_six_cells_meet_in_a_hexagon_with_one_outline_of_six_corners() -> None:
    tiling = hexagon()
    assert len(tiling.cells) == 6
    (loop,) = outline_loops(tiling)
    assert len(loop) == 6
    assert shapely.Polygon(loop).exterior.is_ccw
    assert shapely.Polygon(loop).area == pytest.approx(6 * np.sqrt(3) / 4 * 100)


def test_a_ring_of_cells_has_an_outer_and_an_inner_loop() -> None:
    tiling = lattice(np.zeros(2), np.array([60.0, 60.0]), 10.0)
    vertices = tiling.vertices_mm
    middle = vertices[np.argmin(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1))]
    distance = np.linalg.norm(tiling.centres_mm() - middle, axis=1)
    ring = tiling.part((distance > 6) & (distance < 25))
    loops = outline_loops(ring)
    assert sorted(shapely.LinearRing(loop).is_ccw for loop in loops) == [False, True]
    total = sum(shapely.Polygon(loop).area * (1 if shapely.LinearRing(loop).is_ccw else -1) for loop in loops)
    assert total == pytest.approx(len(ring.cells) * np.sqrt(3) / 4 * 100)


def test_every_slit_ends_a_hinge_away_from_the_next_one() -> None:
    tiling = hexagon()
    slits = patterned(tiling, hinge_mm=0.4)
    for cell in range(6):
        for k in range(3):
            after = shapely.LineString([slits.edge_mm[cell, (k + 1) % 3], slits.inner_mm[cell, (k + 1) % 3]])
            # From this slit's end to the next one's centre line: the hinge and half of that slit's own width.
            gap = shapely.Point(slits.inner_mm[cell, k]).distance(after)
            half_width = SLIT_mm / 2 * np.cos(0.2 + np.pi / 6)
            assert gap == pytest.approx(0.4 + half_width, abs=1e-9)


def test_an_inner_edge_gets_one_polyline_and_a_border_edge_a_half_slit() -> None:
    tiling = hexagon()
    paths = slit_paths(tiling, patterned(tiling))
    assert sorted(len(path.points_mm) for path in paths) == [2] * 6 + [3] * 6
    assert [path.opens for path in paths].count(True) == 6


def test_unequal_neighbours_meet_in_the_middle_of_their_shared_edge() -> None:
    tiling = hexagon()
    t = np.linspace(0.8, 1.6, 6)
    slits = slits_of(tiling, t, np.full(6, 0.2), np.full(6, 0.25), SLIT_mm)
    neighbours = tiling.neighbours()
    corners = tiling.vertices_mm[tiling.cells]
    for cell, k in zip(*np.nonzero(neighbours >= 0), strict=True):
        along = np.linalg.norm(slits.edge_mm[cell, k] - corners[cell, k])
        assert along == pytest.approx((t[cell] + t[neighbours[cell, k]]) / 2 + SLIT_mm / 2)
    bent = [path for path in slit_paths(tiling, slits) if len(path.points_mm) == 5]
    assert len(bent) == 6


def test_a_passive_cell_has_no_slit_and_its_neighbours_keep_their_half() -> None:
    tiling = hexagon()
    cut = np.array([True, True, False, True, True, True])
    slits = slits_of(tiling, np.linspace(0.8, 1.6, 6), np.full(6, 0.2), np.full(6, 0.25), SLIT_mm, cut)
    paths = slit_paths(tiling, slits, cut)
    assert all(path.cell != 2 for path in paths)
    passive = shapely.Polygon(tiling.vertices_mm[tiling.cells[2]]).buffer(-1e-6)
    assert not any(shapely.LineString(path.points_mm).intersects(passive) for path in paths)
    assert len(paths) == 5 + 6  # five border edges; four inner edges whole, two half


def test_hinges_widen_from_the_least_to_the_greatest_expansion() -> None:
    widths = hinge_widths_mm(np.array([1.2, 1.5, 1.6]), HingeOptions("widening", 0.30, 0.125))
    assert widths == pytest.approx([0.30, 0.39375, 0.425])
    assert hinge_widths_mm(np.array([1.2, 1.6]), HingeOptions()) == pytest.approx([0.25, 0.25])


def test_the_published_slits_follow_from_the_published_parameters(shared: Path) -> None:
    points, faces, _ = flat(shared, "double_dome")
    cells = table(shared / "published" / "double_dome_pattern_cells.csv")
    tiling = tile(points, faces, 10.0)
    assert len(tiling.cells) == 332
    distance, row = cKDTree(np.column_stack([cells["cx_mm"], cells["cy_mm"]])).query(
        tiling.centres_mm() + SHEET_OFFSET_MM
    )
    assert distance.max() < 0.001
    assert (cells["down"][row] == tiling.inverted).all()
    mine = cells[row]
    slits = slits_of(tiling, mine["t_mm"], np.radians(mine["theta_deg"]), mine["hinge_width_mm"], SLIT_mm)
    rows = table(shared / "published" / "double_dome_pattern_slits.csv").reshape(332, 3)[row]
    # The published order of a cell's three slits varies: they are told apart by their inner ends.
    inner = np.stack([rows["inner_x"], rows["inner_y"]], axis=-1) - SHEET_OFFSET_MM
    which = np.linalg.norm(slits.inner_mm[:, :, None] - inner[:, None], axis=-1).argmin(axis=2)
    rows = np.take_along_axis(rows, which, axis=1)
    for name, found in (("edge", slits.edge_mm), ("kink", slits.kink_mm), ("inner", slits.inner_mm)):
        published = np.stack([rows[f"{name}_x"], rows[f"{name}_y"]], axis=-1)
        error = np.linalg.norm(found + SHEET_OFFSET_MM - published, axis=-1)
        assert np.nanmax(error) <= 0.001, name


def test_the_published_cells_follow_by_the_published_rules(shared: Path) -> None:
    points, faces, ratio = flat(shared, "double_dome")
    published = table(shared / "published" / "double_dome_pattern_cells.csv")
    library = half_map(shared)
    tiling = tile(points, faces, 10.0)
    wanted = averaged(tiling, points, faces, ratio, "published")
    wanted *= 1.75 / wanted.max()
    chosen = select(library, wanted, SelectionOptions("published"))
    at = np.column_stack([published["cx_mm"], published["cy_mm"]])
    mine = published[cKDTree(at).query(tiling.centres_mm() + SHEET_OFFSET_MM)[1]]
    entries = {(round(t, 6), round(a, 7)) for t, a in zip(library.t_mm, library.theta_rad, strict=True)}
    theirs = list(zip((10 * mine["t_over_l0_lib"]).round(6), mine["theta_rad_lib"].round(7), strict=True))
    in_half = np.array([entry in entries for entry in theirs])
    same = np.isclose(chosen.t_mm, 10 * mine["t_over_l0_lib"]) & np.isclose(chosen.theta_rad, mine["theta_rad_lib"])
    assert in_half.sum() == 157
    assert same[in_half].all()
    assert np.abs(chosen.expansion_ratio - wanted).max() <= 0.005
