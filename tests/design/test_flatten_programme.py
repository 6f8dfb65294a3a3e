"""The boundary programme: the least spread, its proof, and what the flats make of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.flatten import FlattenOptions, flatten
from design.flatten.disk import best_rim, disk
from design.flatten.programme import least_spread
from design.flatten.quality import distortion
from design.meshfiles import read_mesh
from design.surface import boundary_loops
from design.targets import cap, freeform


@pytest.mark.parametrize(("name", "limit"), [("double_dome", 1.41), ("lilium_tower", 1.32), ("vase", 1.22)])
def test_an_optimised_rim_lowers_the_published_spreads(shared: Path, name: str, limit: float) -> None:
    mesh, _ = read_mesh(shared / "published" / "targets" / f"{name}.obj")
    flat = flatten(mesh, FlattenOptions(boundary="optimised"))
    assert flat.spread_ratio() <= limit
    assert len(distortion(mesh, flat.flat_mm, flat.faces).flipped) == 0


def test_a_cap_is_best_as_it_is() -> None:
    mesh = cap(edge_mm=6)
    optimised = flatten(mesh, FlattenOptions(boundary="optimised"))
    assert optimised.spread_ratio() == pytest.approx(flatten(mesh).spread_ratio(), rel=2e-3)


def test_more_modes_never_spread_more() -> None:
    mesh = freeform(edge_mm=8)
    surface = disk(mesh, boundary_loops(mesh), "cotangent")
    bounds = [best_rim(surface, count)[1].bound_ratio for count in (2, 4, 8, 16)]
    assert bounds == sorted(bounds, reverse=True)


def test_the_realised_expansions_are_those_the_programme_promised() -> None:
    mesh = freeform(edge_mm=4)
    flat = flatten(mesh, FlattenOptions(boundary="optimised"))
    promised = np.exp(-flat.u[flat.faces].mean(axis=1))
    assert np.abs(flat.expansion_ratio / promised - 1).max() < 0.01


numbers = st.floats(-2, 2)


@settings(max_examples=40, deadline=None)
@given(
    base=st.lists(numbers, min_size=6, max_size=30).map(np.array),
    seed=st.integers(0, 10_000),
    tries=st.lists(numbers, min_size=3, max_size=3).map(np.array),
)
def test_no_choice_beats_the_proven_bound(base: np.ndarray, seed: int, tries: np.ndarray) -> None:
    columns = np.random.default_rng(seed).normal(size=(len(base), 3))
    answer = least_spread(base, columns)
    assert answer.proof.sum() == pytest.approx(0, abs=1e-9)
    assert np.abs(answer.proof).sum() == pytest.approx(2, abs=1e-6) or answer.bound_ratio == pytest.approx(1)
    assert answer.bound_ratio <= answer.spread_ratio * (1 + 1e-9)
    assert np.ptp(base + columns @ tries) >= np.log(answer.bound_ratio) - 1e-7
    assert np.ptp(base + columns @ answer.choice) == pytest.approx(np.log(answer.bound_ratio), abs=1e-6)


def test_equations_and_bounds_are_kept() -> None:
    rng = np.random.default_rng(3)
    base, columns = rng.normal(size=50), rng.normal(size=(50, 4))
    equal = (np.array([[1.0, 1, 0, 0]]), np.array([0.3]))
    answer = least_spread(base, columns, [(None, None), (None, None), (0, 0.1), (-0.2, 0)], equal)
    assert answer.choice[0] + answer.choice[1] == pytest.approx(0.3)
    assert 0 <= answer.choice[2] <= 0.1
    assert -0.2 <= answer.choice[3] <= 0
    assert np.log(answer.spread_ratio) == pytest.approx(np.log(answer.bound_ratio), abs=1e-6)


def test_many_rows_give_the_same_answer_as_few_at_a_time() -> None:
    rng = np.random.default_rng(5)
    base, columns = rng.normal(size=3000), rng.normal(size=(3000, 5))
    answer = least_spread(base, columns)
    assert np.log(answer.spread_ratio) == pytest.approx(np.log(answer.bound_ratio), abs=1e-6)
