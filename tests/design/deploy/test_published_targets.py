"""The published targets from flat: the lilium tower's shapes and the vase, one sheet with a joined seam."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks._deploy_cases import PRESCRIBED_MJ, published_lie_rad, tiled, tiled_vase, whole_vase
from design.deploy.equilibrium import from_flat, rolled, solve_level
from design.deploy.predict import compared
from design.deploy.search import bumps, turned_over
from design.flatten import flatten
from design.meshfiles import read_corner_uv, read_mesh
from design.surface import TriMesh
from design.targets import TARGETS


def target(shared: Path, name: str) -> TriMesh:
    return read_mesh(shared / "published" / "targets" / f"{name}.obj")[0]


@pytest.fixture
def found_there(shared: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of published data, where the benchmark's cases look for it as well."""
    monkeypatch.setenv("FABCTL_SHARED", str(shared))
    return shared


def test_our_flat_turned_by_its_lie_is_the_published_one(found_there: Path) -> None:
    flat = flatten(target(found_there, "lilium_tower"))
    turn = published_lie_rad("lilium_tower", flat)
    _, uv = read_corner_uv(found_there / "published" / "targets" / "lilium_tower_flat.obj")
    turned = flat.flat_mm @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    assert np.ptp(turned, axis=0) == pytest.approx(np.ptp(uv.reshape(-1, 2), axis=0), rel=1e-3)


def test_the_lilium_towers_nearest_shape_has_its_middle_turned_over(found_there: Path) -> None:
    mesh = target(found_there, "lilium_tower")
    layout, goal = tiled(mesh, 920, PRESCRIBED_MJ, "lilium_tower")
    middle = min(bumps(layout)[:5], key=lambda b: np.linalg.norm(goal[layout.cells[b]].mean(axis=(0, 1))[:2] - 100))
    rests = [solve_level(layout, x) for x in (goal, turned_over(layout, goal, middle, 1.0))]
    percents = [100 * compared(layout, rest, mesh, goal).deviation.mean_frac for rest in rests]
    assert all(rest.stable and rest.residual_ratio < 1e-8 for rest in rests)
    assert percents[1] < 1.5 < percents[0]
    assert rests[0].energy_mJ < rests[1].energy_mJ


def test_the_published_vase_rolled_from_one_sheet_meets_its_target(found_there: Path) -> None:
    mesh = whole_vase(target(found_there, "vase"))
    layout, goal = tiled_vase(mesh, 900)
    found = from_flat(layout, rolled)
    assert layout.rejoined_count() > 10
    assert found.stable
    assert found.residual_ratio < 1e-8
    assert 100 * compared(layout, found, mesh, goal).deviation.mean_frac < 1.1


def test_our_own_vase_rolled_from_one_sheet_meets_its_target() -> None:
    mesh = TARGETS["vase"]()
    layout, goal = tiled_vase(mesh, 700)
    found = from_flat(layout, rolled)
    assert layout.rejoined_count() > 10
    assert found.stable
    assert 100 * compared(layout, found, mesh, goal).deviation.mean_frac < 1.1
