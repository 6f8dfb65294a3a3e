"""Where contact is found: on softening, straight, Hertzian and bistable beginnings; and where it is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from fabctl.indent.contact import find_contact

Reals = NDArray[np.float64]
STARTS: dict[str, Callable[[Reals], Reals]] = {
    "softening": lambda d: 0.5 * 4 * (np.sqrt(1 + 2 * d / 4) - 1),
    "softening sharply": lambda d: np.sqrt(1 + 2 * d) - 1,
    "straight": lambda d: 0.5 * d,
    "bistable": lambda d: 0.02 * d * (d**2 - 18.75 * d + 75),
    "Hertzian": lambda d: 0.24 * d**1.5,
}


def curve(
    start: Callable[[Reals], Reals],
    seed: int,
    noise_N: float = 0.01,
    contact_mm: float = 7.3,
    drift_N_mm: float = 3e-4,
    free_mm: float = 1.0,
    apart_mm: float = 0.01,
) -> tuple[Reals, Reals]:
    rng = np.random.default_rng(seed)
    depth = np.arange(-free_mm, 6.0, apart_mm)
    force = start(np.maximum(depth, 0.0)) + rng.normal(0, noise_N, len(depth)) + drift_N_mm * (depth + free_mm)
    return depth + contact_mm, force


@pytest.mark.parametrize("name", sorted(STARTS))
def test_the_bias_of_the_contact_is_below_0_03_mm_at_10_mN_of_noise(name: str) -> None:
    found = [find_contact(*curve(STARTS[name], seed)).position_mm for seed in range(16)]
    off = np.array([at - 7.3 for at in found if at is not None])
    assert len(off) == 16
    # At most 0.03 mm, beside what sixteen draws scatter by.
    assert abs(off.mean()) <= 0.03 + 2 * off.std() / 4 * (name == "Hertzian")


def test_the_usual_estimators_are_early_on_a_softening_curve_and_their_spread_is_told() -> None:
    found = find_contact(*curve(STARTS["softening"], 1))
    others = dict(found.others_mm)
    assert others["hertz"] < 7.3 - 1.0
    assert found.spread_mm is not None
    assert found.spread_mm > 1.0


def test_the_standard_error_is_what_the_contact_scatters_by() -> None:
    found = [find_contact(*curve(STARTS["softening"], seed)) for seed in range(24)]
    scatter = np.std([f.position_mm for f in found if f.position_mm is not None])
    told = np.mean([f.se_mm for f in found if f.se_mm is not None])
    assert 0.4 < told / scatter < 2.5


def test_the_slope_at_contact_is_the_stiffness_of_a_sloped_start_only() -> None:
    sloped = find_contact(*curve(STARTS["straight"], 3))
    assert sloped.slope_N_mm == pytest.approx(0.5, abs=4 * (sloped.slope_se_N_mm or 0))
    assert find_contact(*curve(STARTS["Hertzian"], 3, noise_N=0.002)).slope_N_mm is None


@pytest.mark.parametrize(
    ("position", "force", "why"),
    [
        (np.arange(5.0), np.zeros(5), "only 5 samples"),
        (np.arange(0, 5, 0.01), np.random.default_rng(1).normal(0, 0.01, 500), "never leaves the noise"),
        (np.arange(0, 5, 0.01), 1.0 + np.arange(0, 5, 0.01) ** 0.9, "begins in contact"),
    ],
    ids=["too few", "nothing there", "no free part"],
)
def test_what_is_not_there_is_not_found(position: Reals, force: Reals, why: str) -> None:
    found = find_contact(position, force)
    assert found.position_mm is None
    assert why in found.reason


def test_a_start_too_soft_for_the_noise_is_not_found() -> None:
    found = find_contact(*curve(lambda d: 0.004 * d, 2))
    assert found.position_mm is None
    assert found.reason


@pytest.mark.parametrize("drift_N_mm", [-0.03, 0.03, 0.1])
@pytest.mark.parametrize("name", sorted(STARTS))
def test_a_sharp_drift_before_contact_is_not_taken_for_the_specimen(name: str, drift_N_mm: float) -> None:
    found = [find_contact(*curve(STARTS[name], seed, drift_N_mm=drift_N_mm, free_mm=2.0)) for seed in range(3)]
    off_mm = [abs((one.position_mm or 0.0) - 7.3) for one in found]
    assert max(off_mm) < (0.15 if name == "Hertzian" else 0.03)
    assert [one.drift_N_mm for one in found] == pytest.approx([drift_N_mm] * 3, abs=0.012)


BENT: dict[str, Callable[[Reals], Reals]] = {
    "growing": lambda x: 0.02 * x**2,
    "turning": lambda x: -0.02 * x**2,
    "settling": lambda x: 0.08 * (1 - np.exp(-x)),
}


@pytest.mark.parametrize("drift", sorted(BENT))
@pytest.mark.parametrize("name", ["softening", "straight", "Hertzian"])
def test_a_drift_that_bends_by_80_mN_before_contact_is_not_taken_for_the_specimen(name: str, drift: str) -> None:
    """A straight free part would put the contact up to 1.3 mm early here, with an error of 0.02 mm told."""
    for seed in range(3):
        u, force = curve(STARTS[name], seed, noise_N=0.003, drift_N_mm=0.0, free_mm=2.0)
        found = find_contact(u, force + BENT[drift](u - u[0]))
        assert found.position_mm is not None
        assert found.drift_N_mm2 != 0
        off_mm = abs(found.position_mm - 7.3)
        assert off_mm < (0.06 if name == "Hertzian" else 0.02)
        assert off_mm < 4 * (found.se_mm or 0)


@pytest.mark.parametrize("seed", range(4))
def test_a_specimen_that_stiffens_after_a_first_touch_is_no_drift_that_bends(seed: int) -> None:
    found = find_contact(*curve(lambda d: 0.3 * d + 0.5 * np.maximum(d - 0.7, 0.0), seed, drift_N_mm=0.0, free_mm=0.6))
    assert found.position_mm == pytest.approx(7.3, abs=0.1)
    assert found.drift_N_mm2 == 0


def test_a_bump_of_the_noise_that_falls_again_is_no_contact() -> None:
    """A fit that rises and falls again before the sure rise would be half a millimetre early in this draw."""
    rng = np.random.default_rng(10)
    u = np.arange(0, 5.2, 0.01)
    found = find_contact(u, 0.3 * np.maximum(u - 2.0, 0.0) ** 1.5 + rng.normal(0, 0.01, len(u)))
    assert found.position_mm == pytest.approx(2.0, abs=0.1)


def test_no_drift_is_told_where_there_is_none() -> None:
    told = [find_contact(*curve(STARTS["softening"], seed, drift_N_mm=0.0)).drift_N_mm for seed in range(20)]
    assert sum(drift_N_mm != 0 for drift_N_mm in told) <= 3


def test_a_drift_as_steep_as_the_specimen_is_no_free_part() -> None:
    found = find_contact(*curve(lambda d: 0.05 * d + 0.02 * d**2, 1, drift_N_mm=0.1, noise_N=0.002))
    assert found.position_mm is None
    assert "drifts too much" in found.reason


@pytest.mark.parametrize("name", sorted(STARTS))
def test_samples_that_lie_far_apart_still_show_the_contact(name: str) -> None:
    found = [find_contact(*curve(STARTS[name], seed, free_mm=2.0, apart_mm=0.15)) for seed in range(4)]
    for one in found:
        assert one.position_mm is not None
        assert abs(one.position_mm - 7.3) < max(0.05, 3.5 * (one.se_mm or 0))


def test_too_few_samples_before_contact_are_told_as_such() -> None:
    found = find_contact(*curve(STARTS["softening"], 1, free_mm=1.2, apart_mm=0.15))
    assert found.position_mm is None
    assert "samples" in found.reason
    assert "lie before the rise, 12 are needed" in found.reason


def test_a_start_that_pulls_is_none() -> None:
    """Where noise dips before contact, a fit with a negative first slope would be early by 0.2 mm."""
    found = [find_contact(*curve(lambda d: 0.47 * d - 0.04 * d**2, seed)).position_mm for seed in range(40)]
    assert max(abs((at or 0.0) - 7.3) for at in found) < 0.06


@pytest.mark.parametrize("name", ["softening", "straight"])
def test_a_load_cell_behind_a_filter_errs_slowly_and_is_believed_less(name: str) -> None:
    found = []
    for seed in range(6):
        position, force = curve(STARTS[name], seed, noise_N=0.0, free_mm=1.5)
        noise = np.zeros(len(force))
        for k, kick in enumerate(np.random.default_rng(seed).normal(0, 0.006, len(force))):
            noise[k] = 0.8 * noise[k - 1] + kick
        found.append(find_contact(position, force + noise))
    off_mm = [abs((one.position_mm or 0.0) - 7.3) for one in found]
    assert max(off_mm) < 0.05
    assert min(one.se_mm or 0.0 for one in found) > 0.006


@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_a_slow_wave_before_contact_is_noise_and_no_contact(seed: int) -> None:
    """Draughts sway a soft cell: taken for a start, they put the contact a millimetre early."""
    rng = np.random.default_rng(seed)
    u = np.arange(0, 5.0, 0.01)
    loaded = np.maximum(u - 1.5, 0.0)
    quiet = 0.6 * loaded - 0.09 * loaded**2 + 0.006 * loaded**3 + rng.normal(0, 0.002, len(u))
    found = find_contact(u, quiet + 0.01 * np.sin(0.018 * np.pi * np.arange(len(u)) + rng.uniform(0, 6)))
    assert found.position_mm == pytest.approx(1.5, abs=0.06)
