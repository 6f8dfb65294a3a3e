"""Weight, floor and friction act as they should."""

from __future__ import annotations

import numpy as np
import pytest

from design.cells.sheet import Sheet
from design.deploy.equilibrium import solve_level
from design.deploy.indentation import border, standing_rim
from design.deploy.supports import Floor, Friction, Weight, settle, weight_of


def central(function, x, way, step=1e-6):
    return (function(x + step * way) - function(x - step * way)) / (2 * step)


@pytest.mark.parametrize("name", ["weight", "floor", "friction"])
def test_a_load_is_the_slope_of_its_energy(name: str) -> None:
    rng = np.random.default_rng(5)
    x, way = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    load = {
        "weight": Weight(rng.uniform(size=9)),
        "floor": Floor(np.full(9, 0.2), 3.0),
        "friction": Friction(rng.normal(size=(9, 2)), np.linspace(0.1, 8.0, 9), 4.0),
    }[name]

    def slope(y):
        gradient, blocks = np.zeros_like(y), np.zeros((9, 3, 3))
        load.add(y, gradient, blocks)
        return gradient, blocks

    gradient, blocks = slope(x)
    assert np.sum(gradient * way) == pytest.approx(central(load.energy, x, way), rel=1e-6)
    expected = central(lambda y: slope(y)[0], x, way)
    assert np.allclose(np.einsum("nij,nj->ni", blocks, way), expected, rtol=1e-6, atol=1e-7)


@pytest.fixture(scope="module")
def standing(cap_of):
    cap = cap_of()
    return cap.layout, solve_level(cap.layout, cap.design_mm).x_mm


def test_a_sheet_weighs_what_its_rubber_weighs(standing) -> None:
    layout, _ = standing
    area_mm2 = len(layout.cells) * np.sqrt(3) / 4 * 100
    assert weight_of(layout, Sheet()).force_N.sum() == pytest.approx(area_mm2 * 2.3 * 1150e-9 * 9.80665)


def test_a_rim_that_slips_lets_the_sheet_sag_more(standing) -> None:
    layout, x = standing
    sags = {s: settle(layout, x, Sheet(), s).sag_mm for s in ("held", "no-slip", "coulomb", "slip")}
    assert 0 < sags["held"] <= 1.01 * sags["no-slip"] < sags["coulomb"] < sags["slip"]


def test_the_floor_carries_the_whole_weight(standing) -> None:
    layout, x = standing
    found = settle(layout, x, Sheet(), "slip")
    rim_heights = Floor(np.where(found.unloaded_mm[:, 2] < 60, found.unloaded_mm[:, 2], 0.0), 1.0)
    assert found.equilibrium.residual_ratio < 1e-8
    assert found.smallest_eigenvalue_N_mm > 0
    assert found.standing_count >= 3
    assert rim_heights.energy(found.equilibrium.x_mm) > 0


def test_friction_obeys_its_limit(standing) -> None:
    layout, x = standing
    rough, smooth = (settle(layout, x, Sheet(), "coulomb", friction_ratio=mu) for mu in (2.0, 0.2))
    assert smooth.slid_mm > rough.slid_mm
    assert rough.equilibrium.residual_ratio < 1e-8
    assert rough.smallest_eigenvalue_N_mm > 0


def test_a_pierced_sheet_stands_on_its_outer_rim_and_not_on_its_hole(cap_of) -> None:
    cap = cap_of(edge_mm=8.0)
    centre = cap.layout.corners_mm.mean(axis=1)
    used, cells = np.unique(cap.layout.cells[np.hypot(*centre.T) > 15], return_inverse=True)
    cells, x = cells.reshape(-1, 3), cap.design_mm[used]
    rim, stands = border(cells, len(x)), standing_rim(cells, x)
    assert 0 < stands.sum() < rim.sum()
    assert np.all(rim[stands])
    assert x[rim & ~stands, 2].min() > x[stands, 2].max()
    upside_down = standing_rim(cells, x * [1.0, 1.0, -1.0])
    assert np.array_equal(upside_down, rim & ~stands)


def test_a_sheet_whose_only_rim_is_on_top_stands_on_it(cap_of) -> None:
    cap = cap_of(edge_mm=10.0)
    bowl = cap.design_mm * [1.0, 1.0, -1.0]
    assert np.array_equal(standing_rim(cap.layout.cells, bowl), border(cap.layout.cells, len(bowl)))


def test_a_weight_without_support_is_refused(standing) -> None:
    with pytest.raises(ValueError, match="support"):
        settle(*standing, Sheet(), "free")
