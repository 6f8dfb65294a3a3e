"""Laying surfaces flat: the published flats, closed forms, holes, and refusals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from design.errors import FlattenError
from design.flatten import FlattenOptions, flatten
from design.flatten.laplace import _Pardiso, assemble, factored
from design.flatten.quality import check_flat, crossings, distortion, signed_areas_mm2
from design.meshfiles import read_corner_uv, read_mesh
from design.surface import TriMesh, boundary_loops, tidy
from design.targets import TARGETS, cap, freeform, pierced_cap, saddle

PUBLISHED = ["double_dome", "lilium_tower", "vase"]


def similarity_residual_ratio(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    """Return the largest distance after the best similarity, over the diagonal of `theirs`."""
    a, b = ours @ [1, 1j], theirs @ [1, 1j]
    a, b = a - a.mean(), b - b.mean()
    return float(np.abs(a * np.vdot(a, b) / np.vdot(a, a) - b).max() / np.linalg.norm(np.ptp(theirs, axis=0)))


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_flats_are_reproduced(shared: Path, name: str) -> None:
    targets = shared / "published" / "targets"
    mesh, _ = read_mesh(targets / f"{name}.obj")
    flat = flatten(mesh)
    corners_mm, uv = read_corner_uv(targets / f"{name}_flat.obj")
    order = np.argsort(mesh.vertices_mm[mesh.faces].mean(axis=1).round(3).view("f8,f8,f8").ravel())
    theirs = np.argsort(corners_mm.mean(axis=1).round(3).view("f8,f8,f8").ravel())
    # Faces pair up by their centroids; corners within a face keep their order.
    ours_mm = flat.flat_mm[flat.faces[order]].reshape(-1, 2)
    np.testing.assert_allclose(
        mesh.vertices_mm[mesh.faces[order]].mean(axis=1), corners_mm[theirs].mean(axis=1), atol=2e-3
    )
    assert similarity_residual_ratio(ours_mm, uv[theirs].reshape(-1, 2)) < 2e-4


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_targets_flatten_nearly_conformally(shared: Path, name: str) -> None:
    mesh, _ = read_mesh(shared / "published" / "targets" / f"{name}.obj")
    flat = flatten(mesh)
    measured = distortion(mesh, flat.flat_mm, flat.faces)
    assert measured.mean_ratio <= 1.02
    assert len(measured.flipped) == 0


def test_a_plane_stays_as_it_is() -> None:
    mesh = saddle(height_mm=0)
    flat = flatten(mesh)
    assert similarity_residual_ratio(flat.flat_mm, mesh.vertices_mm[:, :2]) < 1e-9
    assert flat.expansion_ratio == pytest.approx(1, abs=1e-9)


@settings(max_examples=12, deadline=None)
@given(angle_rad=st.floats(-3, 3), shift_mm=st.floats(-500, 500), scale=st.floats(0.2, 5))
def test_moving_and_scaling_the_target_changes_nothing_but_the_scale(
    angle_rad: float, shift_mm: float, scale: float
) -> None:
    mesh = freeform(edge_mm=16)
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[c, -s, 0], [s * 0.6, c * 0.6, -0.8], [s * 0.8, c * 0.8, 0.6]])
    moved = TriMesh(scale * mesh.vertices_mm @ turn.T + shift_mm, mesh.faces)
    before, after = flatten(mesh), flatten(moved)
    assert similarity_residual_ratio(after.flat_mm, before.flat_mm) < 1e-9
    np.testing.assert_allclose(after.expansion_ratio, before.expansion_ratio, rtol=1e-9)


def test_numbering_does_not_matter() -> None:
    mesh = freeform(edge_mm=10)
    order = np.random.default_rng(4).permutation(len(mesh.vertices_mm))
    shuffled = TriMesh(mesh.vertices_mm[order], np.argsort(order)[mesh.faces[::-1]])
    assert similarity_residual_ratio(flatten(shuffled).flat_mm, flatten(mesh).flat_mm[order]) < 1e-9


@pytest.mark.parametrize("name", ["cap", "hemisphere", "double-bump", "saddle", "freeform", "pierced-cap"])
def test_the_projects_targets_lie_flat_without_flips(name: str) -> None:
    mesh = TARGETS[name]()
    flat = flatten(mesh)
    assert (signed_areas_mm2(flat.flat_mm, flat.faces) > 0).all()
    assert flat.findings == ()
    assert flat.expansion_ratio.shape == (len(mesh.faces),)


def test_holes_are_closed_for_the_computation_and_open_again_afterwards() -> None:
    mesh = pierced_cap(edge_mm=5)
    flat = flatten(mesh)
    assert flat.flat_mm.shape == (len(mesh.vertices_mm), 2)
    np.testing.assert_array_equal(flat.faces, mesh.faces)
    assert len(boundary_loops(TriMesh(np.pad(flat.flat_mm, ((0, 0), (0, 1))), flat.faces))) == 2


def test_the_rim_keeps_its_length_and_a_prescribed_one_gets_its_own() -> None:
    mesh = freeform(edge_mm=8)
    (rim,) = boundary_loops(mesh)
    wave = 0.05 * np.sin(2 * np.pi * np.arange(len(rim)) / len(rim))
    u = np.zeros(len(mesh.vertices_mm))
    u[rim] = 0.3 + wave
    before_mm = np.linalg.norm(mesh.vertices_mm[np.roll(rim, -1)] - mesh.vertices_mm[rim], axis=1)

    def rim_mm(flat_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.linalg.norm(flat_mm[np.roll(rim, -1)] - flat_mm[rim], axis=1))

    isometric = flatten(mesh)
    prescribed = flatten(mesh, FlattenOptions(boundary="prescribed", boundary_u=u))
    asked_mm = before_mm * np.exp(0.5 * (u[rim] + u[np.roll(rim, -1)]))
    assert rim_mm(isometric.flat_mm) == pytest.approx(before_mm, rel=0.02)
    assert rim_mm(prescribed.flat_mm) == pytest.approx(asked_mm, rel=0.02)


def test_a_raised_boundary_scales_the_flat_and_nothing_else() -> None:
    mesh = freeform(edge_mm=10)
    plain = flatten(mesh)
    raised = flatten(mesh, FlattenOptions("prescribed", np.full(len(mesh.vertices_mm), math.log(2))))
    assert raised.flat_mm == pytest.approx(2 * plain.flat_mm, abs=1e-6)


def test_a_prescribed_boundary_without_values_is_refused() -> None:
    with pytest.raises(FlattenError, match="boundary_u"):
        flatten(cap(edge_mm=15), FlattenOptions(boundary="prescribed"))


def test_a_rim_that_crosses_itself_is_counted() -> None:
    eight = np.array([[0, 0], [2, 2], [2, 0], [0, 2.0]])
    assert crossings(eight, np.arange(4)) == 1
    assert crossings(eight[[0, 2, 1, 3]], np.arange(4)) == 0


def long_spiral() -> TriMesh:
    """Return a developable ramp of one turn and a half: flat it must cover part of itself twice."""
    turn, across = np.meshgrid(np.linspace(0, 3 * np.pi, 120), np.linspace(40, 60, 7), indexing="ij")
    points = np.stack([across * np.cos(turn), across * np.sin(turn), 2.0 * turn], axis=-1).reshape(-1, 3)
    k = (np.arange(119)[:, None] * 7 + np.arange(6)).ravel()
    return TriMesh(points, np.vstack([np.column_stack([k, k + 1, k + 8]), np.column_stack([k, k + 8, k + 7])])[:, ::-1])


def test_an_overlapping_flat_is_refused() -> None:
    with pytest.raises(FlattenError) as caught:
        flatten(long_spiral())
    assert {finding.code for finding in caught.value.findings} >= {"FLAT-OVERLAP"}


def holed(mesh: TriMesh, centre_mm: tuple[float, float], radius_mm: float) -> TriMesh:
    middle_mm = mesh.vertices_mm[mesh.faces].mean(axis=1)[:, :2]
    return tidy(TriMesh(mesh.vertices_mm, mesh.faces[np.linalg.norm(middle_mm - centre_mm, axis=1) > radius_mm]))[0]


def test_a_plane_with_holes_stays_as_it_is_when_its_rims_are_free() -> None:
    mesh = holed(holed(saddle(height_mm=0), (20, 10), 15), (-35, -5), 9)
    flat = flatten(mesh, FlattenOptions("prescribed", np.zeros(len(mesh.vertices_mm)), holes="free"))
    assert similarity_residual_ratio(flat.flat_mm, mesh.vertices_mm[:, :2]) < 1e-9


def test_free_rims_distort_less_than_a_large_filled_hole() -> None:
    mesh = holed(cap(edge_mm=4), (10, 0), 40)
    filled, free = (flatten(mesh, FlattenOptions(holes=holes)) for holes in ("filled", "free"))  # type: ignore[arg-type]
    worst = [distortion(mesh, flat.flat_mm, flat.faces).max_ratio for flat in (filled, free)]
    assert worst[0] > 1.5
    assert worst[1] < 1.05


@pytest.mark.parametrize("place_mm", [(10, 0), (30, -20)])
def test_free_rims_spread_less_and_still_close(place_mm: tuple[float, float]) -> None:
    mesh = holed(freeform(edge_mm=4), place_mm, 18)
    filled = flatten(mesh, FlattenOptions("optimised", holes="filled"))
    free = flatten(mesh, FlattenOptions("optimised"))
    assert free.findings == ()
    assert free.spread_ratio() < 0.99 * filled.spread_ratio()
    assert distortion(mesh, free.flat_mm, free.faces).mean_ratio < 1.02
    promised = np.exp(-free.u[free.faces].mean(axis=1))
    assert np.abs(free.expansion_ratio / promised - 1).max() < 0.02


def test_prescribed_rims_of_holes_get_the_lengths_asked_for() -> None:
    mesh = pierced_cap(edge_mm=5)
    start = flatten(mesh, FlattenOptions(holes="free"))
    hole = boundary_loops(mesh)[1]
    again = flatten(mesh, FlattenOptions("prescribed", start.u, holes="free"))
    assert similarity_residual_ratio(again.flat_mm, start.flat_mm) < 1e-9
    lengths = [np.linalg.norm(np.diff(v[hole], axis=0), axis=1) for v in (again.flat_mm, mesh.vertices_mm)]
    asked = np.exp(0.5 * (start.u[hole[1:]] + start.u[hole[:-1]]))
    np.testing.assert_allclose(lengths[0] / lengths[1], asked, rtol=0.02)


def test_a_flipped_face_is_counted_and_an_anisotropic_stretch_measured() -> None:
    mesh = saddle(height_mm=0, edge_mm=15)
    flat_mm = mesh.vertices_mm[:, :2] * [1.5, 1.0]
    measured = distortion(mesh, flat_mm, mesh.faces)
    assert measured.mean_ratio == pytest.approx(1.5)
    assert measured.max_ratio == pytest.approx(1.5)
    assert len(measured.flipped) == 0
    flat_mm[0] += [60, 60]  # the middle, thrown over its neighbours
    flipped = np.flatnonzero(signed_areas_mm2(flat_mm, mesh.faces) < 0)
    assert len(flipped) > 0
    np.testing.assert_array_equal(distortion(mesh, flat_mm, mesh.faces).flipped, flipped)
    codes = {finding.code for finding in check_flat(mesh, flat_mm, mesh.faces, boundary_loops(mesh))}
    assert "FLAT-FLIPPED" in codes


def test_the_optional_solver_gives_the_same_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pypardiso", reason="the extra `pardiso` is not installed")
    mesh = freeform(edge_mm=6)
    usual = flatten(mesh)
    monkeypatch.setattr("design.flatten.laplace.PARDISO_FROM", 0)
    (rim,) = boundary_loops(mesh)
    assert isinstance(factored(assemble(mesh), rim).factor, _Pardiso)
    np.testing.assert_allclose(flatten(mesh).flat_mm, usual.flat_mm, atol=1e-8)
