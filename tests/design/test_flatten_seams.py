"""Seams: tubes that re-join by a translation, cuts where asked, cones."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from design.errors import FlattenError
from design.flatten import Flattening, FlattenOptions, flatten
from design.flatten.cut import chain_through, cut_along, shortest_chain
from design.flatten.quality import distortion
from design.flatten.tube import tube, tube_scale_factors
from design.meshfiles import read_mesh, weld
from design.surface import TriMesh, boundary_loops, check_target
from design.targets import TARGETS, cap, cylinder, double_bump, hemisphere, pierced_cap, revolve, vase


def opened(flat: Flattening) -> TriMesh:
    return TriMesh(flat.mesh.vertices_mm[flat.target_index], flat.faces)


def whole_vase(shared: Path) -> TriMesh:
    """Return the published half and its mirror in x = 0, welded."""
    half, _ = read_mesh(shared / "published" / "targets" / "vase.obj")
    mirrored = half.vertices_mm * [-1, 1, 1]
    count = len(mirrored)
    faces = np.vstack([half.faces, half.faces[:, ::-1] + count])
    return weld(TriMesh(np.vstack([half.vertices_mm, mirrored]), faces), 1e-3)


def test_a_cylinder_unrolls_into_its_rectangle() -> None:
    mesh = cylinder(radius_mm=30, height_mm=90, edge_mm=4)
    flat = flatten(mesh)
    (seam,) = flat.seams
    columns = round(2 * math.pi * 30 / 4)
    around_mm = columns * 2 * 30 * math.sin(math.pi / columns)  # of the polygon the mesh is
    assert seam.translation_mm == pytest.approx((around_mm, 0))
    assert np.ptp(flat.flat_mm[:, 1]) == pytest.approx(90, rel=2e-3)
    assert flat.spread_ratio() == pytest.approx(1, abs=1e-6)
    assert distortion(opened(flat), flat.flat_mm, flat.faces).max_ratio == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("boundary", ["isometric", "optimised"])
def test_a_whole_vase_re_joins_by_a_pure_translation(shared: Path, boundary: str) -> None:
    mesh = whole_vase(shared)
    assert check_target(mesh) == []
    flat = flatten(mesh, FlattenOptions(boundary=boundary))  # type: ignore[arg-type]
    (seam,) = flat.seams
    assert seam.rotation_rad == 0
    assert seam.translation_mm[1] == 0
    moved = flat.flat_mm[seam.left] + seam.translation_mm
    assert np.abs(moved - flat.flat_mm[seam.right]).max() <= 0.01
    np.testing.assert_array_equal(flat.target_index[seam.left], flat.target_index[seam.right])
    assert flat.spread_ratio() < 1.572
    assert distortion(opened(flat), flat.flat_mm, flat.faces).mean_ratio <= 1.02


def test_a_vase_of_revolution_has_the_spread_of_its_profile() -> None:
    mesh = vase(edge_mm=3)
    radius_mm = np.linalg.norm(mesh.vertices_mm[:, :2], axis=1)
    assert flatten(mesh).spread_ratio() == pytest.approx(radius_mm.max() / radius_mm.min(), rel=0.005)


def uneven_tube() -> TriMesh:
    mesh = vase(edge_mm=5)
    x, y, z = mesh.vertices_mm.T
    return TriMesh(np.column_stack([x * (1 + 0.003 * z) + 0.002 * z**2, 0.8 * y + 0.1 * x, z + 0.1 * x]), mesh.faces)


@pytest.mark.parametrize("boundary", ["isometric", "optimised"])
def test_neither_end_of_a_tube_turns_in_total(boundary: str) -> None:
    mesh = uneven_tube()
    surface = tube(mesh, boundary_loops(mesh), "cotangent")
    u = tube_scale_factors(surface, FlattenOptions(boundary=boundary))  # type: ignore[arg-type]
    assert [float(turning.sum()) for turning in surface.turning(u)] == pytest.approx([0, 0], abs=1e-9)


def test_an_uneven_tube_re_joins_too() -> None:
    bent = uneven_tube()
    flat = flatten(bent, FlattenOptions(boundary="optimised"))
    plain = flatten(bent)
    assert flat.seams[0].gap_mm < 1e-9
    assert flat.spread_ratio() < plain.spread_ratio()
    assert distortion(opened(flat), flat.flat_mm, flat.faces).mean_ratio < 1.05


def test_scale_factors_are_constant_on_each_end_of_a_plain_tube() -> None:
    mesh = vase(edge_mm=5)
    flat = flatten(mesh)
    for loop in boundary_loops(mesh):
        assert np.ptp(flat.u[loop]) < 1e-9


def test_a_tube_is_scaled_to_whole_cells() -> None:
    flat = flatten(vase())
    scales = flat.whole_cell_scales(10.0, 0.8, 1.0)
    assert len(scales) >= 3
    for count, scale in scales:
        assert flat.scaled(scale).seams[0].translation_mm[0] == pytest.approx(10.0 * count)
        assert flat.scaled(scale).expansion_ratio * scale == pytest.approx(flat.expansion_ratio)
    assert flatten(cap(edge_mm=12)).whole_cell_scales(10.0, 0.5, 2) == []


@pytest.mark.parametrize("asked", [FlattenOptions(), FlattenOptions(cones_count=2)])
def test_seams_turn_and_shift_with_their_flat(asked: FlattenOptions) -> None:
    flat = flatten(vase(edge_mm=6) if asked.cones_count == 0 else hemisphere(edge_mm=6), asked)
    turned_mm = flat.flat_mm @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + [30.0, -7.0]
    moved = flat.moved_to(turned_mm)
    for before, seam in zip(flat.seams, moved.seams, strict=True):
        assert seam.gap_mm < 1e-9
        assert seam.rotation_rad == pytest.approx(before.rotation_rad)
        turn = np.exp(1j * seam.rotation_rad)
        carried = turn * (turned_mm[seam.left] @ [1, 1j]) + complex(*seam.translation_mm)
        assert carried == pytest.approx(turned_mm[seam.right] @ [1, 1j])


def test_an_unrolled_tube_covers_a_period_whole_wherever_its_seam_runs() -> None:
    flat = flatten(vase(edge_mm=6))
    points_mm, faces, face_of = flat.unrolled()
    period_mm = flat.seams[0].translation_mm[0]
    triangles = shapely.polygons(points_mm[faces])
    assert shapely.area(triangles) == pytest.approx(shapely.area(shapely.polygons(flat.flat_mm[flat.faces]))[face_of])
    middle_mm = flat.flat_mm.mean(axis=0)
    low, high = np.quantile(flat.flat_mm[:, 1], [0.3, 0.7])
    window = shapely.box(middle_mm[0] - period_mm / 2, low, middle_mm[0] + period_mm / 2, high)
    assert shapely.intersection(triangles, window) is not None
    assert shapely.area(shapely.intersection(triangles, window)).sum() == pytest.approx(window.area, rel=1e-9)
    plain = flatten(cap(edge_mm=12))
    assert plain.unrolled()[0] is plain.flat_mm


def test_a_short_wide_ring_is_a_disk_with_a_hole_and_a_seam_only_when_asked() -> None:
    washer = revolve(lambda part: 80 - 40 * part, 1.0, 60.0, 8.0)
    assert flatten(washer).seams == ()
    asked = flatten(washer, FlattenOptions(seam="tube"))
    assert len(asked.seams) == 1
    assert asked.seams[0].closes_tube


def test_the_seam_runs_where_it_is_asked_to() -> None:
    mesh = cylinder(edge_mm=6)
    first, second = boundary_loops(mesh)
    path = shortest_chain(mesh, first[4:5], second, np.array([], dtype=np.int64))
    for chain in (path, path[::-1]):
        flat = flatten(mesh, FlattenOptions(cut_path=chain))
        assert sorted(flat.target_index[flat.seams[0].left]) == sorted(path)


def test_a_dart_keeps_both_sides_alike() -> None:
    mesh = double_bump(edge_mm=5)
    (rim,) = boundary_loops(mesh)
    top = np.array([int(mesh.vertices_mm[:, 2].argmax())])
    dart = shortest_chain(mesh, top, rim, np.array([], dtype=np.int64))
    flat = flatten(mesh, FlattenOptions(cut_path=dart))
    (seam,) = flat.seams
    sides = [np.linalg.norm(np.diff(flat.flat_mm[chain], axis=0), axis=1) for chain in (seam.left, seam.right)]
    np.testing.assert_allclose(*sides, rtol=1e-9)
    assert flat.target_index[seam.left].tolist() == dart.tolist()


def test_a_cut_goes_through_the_places_that_are_named() -> None:
    mesh = double_bump(edge_mm=5)
    (rim,) = boundary_loops(mesh)
    places = np.array([[0.0, -200, 0], [10, 0, 0], [30, 5, 0]])
    chain = chain_through(mesh, places)
    assert chain[0] in rim and not np.isin(chain[1:], rim).any()
    nearest = [np.linalg.norm(mesh.vertices_mm - place, axis=1).argmin() for place in places[1:]]
    assert np.isin(nearest, chain).all() and chain[-1] == nearest[-1]
    assert len(flatten(mesh, FlattenOptions(cut_path=chain)).seams) == 1
    tube = cylinder(edge_mm=6)
    low, high = tube.vertices_mm.min(axis=0), tube.vertices_mm.max(axis=0)
    seam = chain_through(tube, np.array([[high[0], 0, low[2]], [high[0], 0, high[2] - 1]]))
    flat = flatten(tube, FlattenOptions(cut_path=seam))
    assert flat.seams[0].closes_tube
    assert tube.vertices_mm[seam][:, 0].min() > 0  # on the side that was asked for


@pytest.mark.parametrize("places", [[[0, -90, 0], [0, 90, 0]], [[0, -90, 0], [0, -91, 0]]], ids=["across", "nothing"])
def test_a_cut_that_would_part_the_surface_is_refused(places: list[list[float]]) -> None:
    with pytest.raises(FlattenError, match="from the rim inwards"):
        chain_through(cap(edge_mm=10), np.array(places, dtype=float))


def test_a_cut_off_the_edges_is_refused() -> None:
    with pytest.raises(FlattenError, match="not joined by an edge"):
        flatten(cap(edge_mm=10), FlattenOptions(cut_path=np.array([0, 200])))


def test_cutting_keeps_faces_and_doubles_only_the_cut() -> None:
    mesh = cap(edge_mm=10)
    (rim,) = boundary_loops(mesh)
    chain = shortest_chain(mesh, np.array([0]), rim, np.array([], dtype=np.int64))
    cut = cut_along(mesh, [chain])
    assert check_target(cut.mesh) == []
    assert len(cut.mesh.vertices_mm) == len(mesh.vertices_mm) + len(chain) - 1
    np.testing.assert_array_equal(cut.target_index[cut.mesh.faces], mesh.faces)
    left, right = cut.sides[0]
    assert left[0] == right[0]
    assert (left[1:] != right[1:]).all()


def test_cones_bring_a_hemisphere_into_reach_and_their_seams_close() -> None:
    mesh = hemisphere()
    spreads = []
    for count in (0, 1, 3):
        flat = flatten(mesh, FlattenOptions(boundary="optimised", cones_count=count))
        spreads.append(flat.spread_ratio())
        assert len(flat.seams) == count
        assert all(seam.gap_mm < 1e-6 for seam in flat.seams)
        assert all(flat.flat_mm[seam.left[0]] == pytest.approx(flat.flat_mm[seam.right[0]]) for seam in flat.seams)
        assert len(distortion(opened(flat), flat.flat_mm, flat.faces).flipped) == 0
    assert spreads == sorted(spreads, reverse=True)
    assert spreads[0] > 1.9
    assert spreads[1] < 1.572


def test_a_cones_seam_opens_by_its_angle() -> None:
    flat = flatten(TARGETS["cap"](), FlattenOptions(cones_count=1))
    (seam,) = flat.seams
    fan = (flat.target_index[flat.faces] == flat.target_index[seam.left[0]]).any(axis=1)
    corners = flat.flat_mm[flat.faces[fan]] @ [1, 1j]
    tip = (flat.target_index[flat.faces[fan]] == flat.target_index[seam.left[0]]).argmax(axis=1)
    a, b, c = (corners[np.arange(len(tip)), (tip + k) % 3] for k in range(3))
    angle_rad = np.angle((c - a) / (b - a)).sum()
    assert abs(seam.rotation_rad) == pytest.approx(2 * math.pi - angle_rad, abs=0.05)


def test_seams_stay_clear_of_holes() -> None:
    mesh = pierced_cap(edge_mm=5)
    flat = flatten(mesh, FlattenOptions(cones_count=4))
    hole = boundary_loops(mesh)[1]
    for seam in flat.seams:
        assert not np.isin(flat.target_index[seam.left], hole).any()
        assert seam.gap_mm < 1e-6
