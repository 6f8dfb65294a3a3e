"""The ladder: what fits, what does not and why, what would help."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from design.errors import NotConverged
from design.flatten import FlattenOptions, Limits, closest_feasible, feasibility, flatten
from design.flatten.bound import proven_bound
from design.flatten.ladder import outside_log, placement
from design.flatten.quality import signed_areas_mm2
from design.meshfiles import read_mesh
from design.surface import TriMesh, boundary_loops, check_target
from design.targets import cap, freeform, hemisphere, pierced_cap, spike, vase

PAPER = Limits(1.129, 1.775)  # the published library's range


def test_a_cap_fits_by_the_global_scale() -> None:
    report = feasibility(cap(edge_mm=6), PAPER)
    assert [step.rung for step in report.steps] == ["scale"]
    assert report.best() is not None
    assert not report.excess_log.any()
    placed = report.flattening().scaled(report.scale_ratio).expansion_ratio
    assert placed.min() >= PAPER.low_ratio
    assert placed.max() <= PAPER.high_ratio


def test_a_narrower_library_is_reached_by_the_rim(shared: Path) -> None:
    mesh, _ = read_mesh(shared / "published" / "targets" / "double_dome.obj")
    report = feasibility(mesh, Limits(1.2, 1.2 * 1.42))
    assert [(step.rung, step.fits) for step in report.steps] == [("scale", False), ("rim", True)]
    assert not report.excess_log.any()
    assert not report.proven_infeasible


def test_a_hemisphere_is_proven_out_of_reach_and_said_where() -> None:
    mesh = hemisphere()
    report = feasibility(mesh, PAPER)
    assert report.best() is None
    assert report.proven_infeasible
    assert report.bound_ratio == pytest.approx(1.96, abs=0.03)
    assert report.bound_ratio <= report.steps[-1].spread_ratio
    height_mm = mesh.vertices_mm[mesh.faces].mean(axis=1)[:, 2]
    assert height_mm[report.excess_log > 0].min() > height_mm[report.excess_log < 0].max()
    codes = [finding.code for finding in report.findings]
    assert codes == ["FIT-SPREAD", "FIT-WHERE", "FIT-WHERE", "FIT-PROVEN"]


def test_the_report_is_plain_json_and_its_map_shows_what_is_out() -> None:
    mesh = hemisphere(edge_mm=8)
    report = feasibility(mesh, PAPER)
    told = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert told["fits"] is False
    assert told["proven_infeasible"] is True
    red, green, blue = report.colors(mesh).astype(int).T
    height_mm = mesh.vertices_mm[:, 2]
    assert (red > blue + 30)[height_mm.argmax()]
    assert (blue > red + 30)[height_mm.argmin()]
    inside = np.unique(mesh.faces[report.excess_log == 0])
    assert (red[inside] == green[inside]).any()


def test_cones_make_a_hemisphere_feasible_on_request() -> None:
    report = feasibility(hemisphere(), PAPER, remedy="cones")
    best = report.best()
    assert best is not None
    assert best.rung == "cones"
    assert best.spread_ratio <= PAPER.range_ratio()


def test_the_nearest_feasible_surface_is_within_a_hundredth_of_the_diagonal() -> None:
    mesh = hemisphere(edge_mm=7)
    report = feasibility(mesh, PAPER, remedy="nearest")
    near = report.nearest
    assert near is not None
    assert near.rms_ratio < 0.003
    assert check_target(near.flattening.mesh) == []
    again = flatten(near.flattening.mesh, FlattenOptions(boundary="optimised"))
    assert again.spread_ratio() <= PAPER.range_ratio()
    assert (signed_areas_mm2(again.flat_mm, again.faces) > 0).all()


def test_a_feasible_surface_is_left_as_it_is() -> None:
    mesh = cap(edge_mm=8)
    near = closest_feasible(mesh, 1.4)
    assert near.rms_mm == 0
    np.testing.assert_array_equal(near.flattening.mesh.vertices_mm, mesh.vertices_mm)


def test_what_cannot_be_reached_is_refused_with_how_far_it_came() -> None:
    with pytest.raises(NotConverged, match="least spread"):
        closest_feasible(spike(edge_mm=14), 1.0)


@pytest.mark.parametrize("half_angle_rad", [math.pi / 3, math.pi / 2])
def test_the_bound_of_a_cap_is_its_closed_form(half_angle_rad: float) -> None:
    mesh = cap(80, half_angle_rad, 4)
    bound = proven_bound(mesh, boundary_loops(mesh)).spread_ratio
    assert bound == pytest.approx(2 / (1 + math.cos(half_angle_rad)), rel=2e-3)


def test_the_bound_of_a_vase_of_revolution_is_its_profile() -> None:
    mesh = vase(edge_mm=4)
    radius_mm = np.linalg.norm(mesh.vertices_mm[:, :2], axis=1)
    bound = proven_bound(mesh, boundary_loops(mesh), is_tube=True).spread_ratio
    assert bound == pytest.approx(radius_mm.max() / radius_mm.min(), rel=0.005)


@pytest.mark.parametrize("make", [freeform, pierced_cap])
def test_no_rim_that_is_tried_goes_below_the_bound(make: object) -> None:
    mesh = make(edge_mm=6)  # type: ignore[operator]
    bound = proven_bound(mesh, boundary_loops(mesh)).spread_ratio
    rng = np.random.default_rng(1)
    for _ in range(5):
        centre = rng.normal(size=3) * 80
        u = 0.2 * np.cos(np.linalg.norm(mesh.vertices_mm - centre, axis=1) / 60)
        flat = flatten(mesh, FlattenOptions("prescribed", u))
        assert np.exp(np.ptp(flat.u)) >= bound * (1 - 1e-9)
    assert np.exp(np.ptp(flatten(mesh, FlattenOptions("optimised")).u)) >= bound * (1 - 1e-9)


def test_placement_puts_what_fits_in_the_middle_and_shares_what_does_not() -> None:
    fits = placement(np.array([1.0, 1.2]), np.ones(2), Limits(1.2, 1.6))
    assert np.array([1.0, 1.2]) / fits == pytest.approx(np.sqrt(1.2 * 1.6) * np.array([1, 1.2]) / np.sqrt(1.2))
    wide = placement(np.array([1.0, 4.0]), np.ones(2), Limits(1.0, 2.0))
    assert outside_log(np.array([1.0, 4.0]) / wide, Limits(1.0, 2.0)) == pytest.approx(
        np.log(2) / 2 * np.array([-1, 1]), abs=0.01
    )


def wavy_tube() -> TriMesh:
    """Return a surface of revolution with two ends, all rings alike: its programme's equations nearly repeat."""
    around, up = np.meshgrid(np.arange(80), np.linspace(0, 1, 40))
    radius, turn = 35 + 12 * np.sin(1.98 * np.pi * up + 0.3), around * np.pi / 40
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), 156 * up], axis=-1).reshape(-1, 3)
    here = np.arange(39 * 80)
    beside = here // 80 * 80 + (here + 1) % 80
    lower, upper = np.column_stack([here, beside, beside + 80]), np.column_stack([here, beside + 80, here + 80])
    return TriMesh(points, np.vstack([lower, upper]))


def test_a_programme_that_presolving_gives_up_on_is_solved_whole() -> None:
    report = feasibility(wavy_tube(), Limits(1.158, 1.775))
    assert report.best() is None
    assert report.proven_infeasible
    assert report.bound_ratio is not None and 1.9 < report.bound_ratio <= report.steps[-1].spread_ratio


def test_a_proof_that_cannot_be_computed_leaves_the_rest_of_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise NotConverged("the boundary programme", math.nan, 0)

    monkeypatch.setattr("design.flatten.ladder.proven_bound", fails)
    report = feasibility(hemisphere(edge_mm=12), PAPER)
    assert report.bound_ratio is None and not report.proven_infeasible
    assert "FIT-UNPROVEN" in {finding.code for finding in report.findings}


def test_what_is_laid_flat_as_a_tube_is_searched_near_as_a_tube(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[FlattenOptions] = []

    def listens(_mesh: TriMesh, _limit: float, options: FlattenOptions, _emit: object) -> None:
        asked.append(options)
        raise NotConverged("the search for a feasible surface", 1.0, 40)

    monkeypatch.setattr("design.flatten.ladder.closest_feasible", listens)
    feasibility(wavy_tube(), Limits(1.158, 1.775), remedy="nearest")
    feasibility(hemisphere(edge_mm=12), PAPER, remedy="nearest")
    assert [options.seam for options in asked] == ["tube", "auto"]
