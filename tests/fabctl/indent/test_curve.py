"""Figures of a curve against closed forms, through the rig's own controller in virtual time."""

from __future__ import annotations

import math
import statistics

import numpy as np
import pytest

from benchmarks._rig_memory import REGISTERS, Kept, MemoryBus, method, press
from drivers.rig.indenter import Indenter
from fabctl.config.loader import parse
from fabctl.config.method import MethodConfig
from fabctl.indent.analysis import analyse
from fabctl.indent.curve import CurveResult, Strokes, _extrema, analyse_curve
from fabctl.indent.freepart import without_spikes
from fabctl.indent.method import actions
from fabctl.indent.run import Runner
from simulators.rig.controller import Controller, Machine
from simulators.specimens.analytic import bistable, hertz, linear, softening, tabulate
from simulators.specimens.curve import Curves, Specimen

MACHINE = Machine(noise_N=0.005, contact_mm=2.0, parked_mm=0.2, compliance_mm_N=0.2, backlash_mm=0.0, drift_N_s=1e-4)


def result(curves: Curves, depth_mm: float = 4.0, speed_mm_s: float = 1.0, seed: int = 1) -> CurveResult:
    return press(curves, MACHINE, method(depth_mm, speed_mm_s), seed)[0][0].result


def test_the_stiffness_of_a_spring_is_found_behind_a_soft_frame() -> None:
    found = result(linear(0.5))
    for stiffness in (found.stiffness_initial_N_mm, found.stiffness_secant_N_mm):
        assert stiffness is not None
        assert stiffness.value == pytest.approx(0.5, abs=max(2 * stiffness.ci95, 0.003))
        assert stiffness.ci95 < 0.1


def test_a_softening_cap_gives_its_closed_form() -> None:
    found = result(softening(0.5, 4.0))
    assert found.stiffness_secant_N_mm is not None
    assert found.stiffness_secant_N_mm.value == pytest.approx(0.5 * 4 * (math.sqrt(2) - 1) / 2, rel=0.01)
    assert found.contact.position_mm == pytest.approx(2.0, abs=0.03)
    assert found.recovery_ratio == pytest.approx(1.0, abs=0.02)


def test_a_hertzian_contact_has_no_initial_stiffness() -> None:
    found = result(hertz(), 3.0)
    assert found.stiffness_initial_N_mm is None
    assert "Hertzian" in found.reasons["stiffness_initial_N_mm"]


def test_extrema_and_barrier_of_a_cubic_are_found() -> None:
    many = [result(bistable(2.5, 9.0), 11.0, seed=seed) for seed in range(2, 7)]
    off_mm = [abs((one.peak_depth_mm or math.inf) - 2.5) for one in many]
    assert statistics.median(off_mm) < 0.005, "half a sample: what noise of 5 mN leaves of a flat top"
    assert max(off_mm) < 0.03
    found = many[0]
    zero_mm = 0.75 * 11.5 - math.sqrt((0.75 * 11.5) ** 2 - 3 * 2.5 * 9)
    barrier = 0.02 * (zero_mm**4 / 4 - 0.5 * 11.5 * zero_mm**3 + 1.5 * 2.5 * 9 * zero_mm**2)
    assert found.barrier_mJ == pytest.approx(barrier, rel=0.01)


def test_an_extremum_is_found_within_one_sample_at_10_mN_of_noise() -> None:
    """Over windows of 1.5 mm alone it scatters by 0.006 mm, and one valley in twelve is farther off."""
    off_mm = []
    for seed in range(60):
        depth = np.arange(-1.0, 9.5, 0.01)
        force = 0.02 * np.maximum(depth, 0) * (depth**2 - 14.25 * depth + 52.5)
        found = _extrema(depth, force + np.random.default_rng(seed).normal(0, 0.01, len(depth)), 0.01, {})
        off_mm += [float(found["peak_depth_mm"]) - 2.5, float(found["valley_depth_mm"]) - 7.0]  # type: ignore[arg-type]
    assert np.quantile(np.abs(off_mm), 0.95) < 0.01
    assert np.sqrt(np.mean(np.square(off_mm))) < 0.0045


def test_the_valley_of_a_cubic_is_found() -> None:
    assert result(bistable(2.5, 7.0), 9.5).valley_depth_mm == pytest.approx(7.0, abs=0.01)


def test_a_curve_without_maximum_says_so() -> None:
    found = result(linear(0.5))
    assert found.peak_N is None
    assert found.barrier_mJ is None
    assert "rises to the end" in found.reasons["peak"]


def test_hysteresis_is_the_share_of_the_work_that_is_kept() -> None:
    found = result(tabulate(lambda d: 0.5 * d, unload_ratio=0.85), 4.0)
    assert found.hysteresis_ratio == pytest.approx(0.15, abs=0.02)


PRELOADED = """
name: preloaded
safe_height_mm: 0.2
travel_speed_mm_s: 20
limits: {force_N: 20, travel_mm: 40}
steps:
  - {step: tare, time_s: 0.5}
  - {step: approach, speed_mm_s: 3, trigger_N: 0.1, clearance_mm: 1}
  - {step: preload, force_N: 0.3, speed_mm_s: 0.5}
  - {step: zero}
  - {step: load, depth_mm: 3, speed_mm_s: 1}
  - {step: unload, speed_mm_s: 3}
  - {step: load, depth_mm: 3, speed_mm_s: 1}
  - {step: unload, speed_mm_s: 3}
"""


def test_a_curve_that_begins_under_a_preload_counts_from_the_methods_zero() -> None:
    plan = parse(PRELOADED, MethodConfig, "preloaded.yaml")
    under, free = (numbered.result for numbered in press(linear(0.5), MACHINE, plan, 1)[0])
    assert under.contact.kind == "zero"
    assert under.contact.start_N == pytest.approx(0.3, abs=0.05)
    assert under.contact.position_mm == pytest.approx(2.0 + 0.3 / 0.5, abs=0.1)
    assert under.stiffness_secant_N_mm is not None
    assert under.stiffness_secant_N_mm.value == pytest.approx(0.5, rel=0.02)
    assert "under a preload" in under.reasons["stiffness_initial_N_mm"]
    # The second begins at the clearance, free: its contact can be seen and is taken.
    assert free.contact.position_mm == pytest.approx(2.0, abs=0.03)


HELD = """
name: held
safe_height_mm: 0.2
travel_speed_mm_s: 20
limits: {force_N: 20, travel_mm: 40}
steps:
  - {step: tare, time_s: 0.5}
  - {step: approach, speed_mm_s: 3, trigger_N: 0.1, clearance_mm: 1}
  - {step: load, WHERE, speed_mm_s: 2}
  - {step: hold, time_s: 20HOW}
  - {step: unload, speed_mm_s: 3}
  - {step: hold, time_s: 2}
"""


def held(where: str, how: str) -> CurveResult:
    """Press a spring of 0.5 N/mm, a fifth of whose force relaxes with 4 s, as a test on the simulated rig would."""
    device = Controller(MACHINE, Specimen(linear(0.5), creep_ratio=0.2, creep_s=4.0))
    bus, kept = MemoryBus(device), Kept()
    plan = parse(HELD.replace("WHERE", where).replace("HOW", how), MethodConfig, "held.yaml")
    Runner(Indenter(bus, REGISTERS, now_s=bus.now_s, sleep=bus.sleep), plan, actions(plan), kept, bus, 100.0).execute()
    return analyse(kept.samples(), MACHINE.compliance_mm_N, 2.0)[0].result


def test_at_a_held_depth_the_force_relaxes_by_its_share() -> None:
    found = held("depth_mm: 3", "")
    assert found.relaxation_ratio == pytest.approx(0.2 * 0.8, abs=0.03)  # some is gone while it loads
    assert found.creep_mm is None
    assert "stood" in found.reasons["creep_mm"]


def test_a_held_force_is_kept_and_the_specimen_creeps() -> None:
    found = held("force_N: 1", ", force_N: 1")
    assert found.relaxation_ratio is None
    # In the end 0.8 · 0.5 N/mm · d = 1 N, at the beginning it was about 0.5 N/mm · d = 1 N with some of it gone.
    assert found.depth_max_mm is not None
    assert found.creep_mm is not None
    assert found.depth_max_mm + found.creep_mm == pytest.approx(2.5, abs=0.06)
    assert found.creep_ratio == pytest.approx(0.2, abs=0.06)
    assert found.force_max_N is not None
    assert found.force_max_N < 1.1


def test_nothing_under_the_indenter_stays_not_found_for_all_a_zero_step() -> None:
    position = np.arange(0.0, 4.0, 0.01)
    force = np.random.default_rng(1).normal(0, 0.005, len(position))
    found = analyse_curve(Strokes(position, force, position[::-1], force, zero_position_mm=0.5, zero_N=0.004))
    assert found.contact.position_mm is None
    assert "never leaves the noise" in found.contact.reason


def test_snap_through_and_snap_back_are_jumps_of_the_force() -> None:
    machine = Machine(noise_N=0.005, contact_mm=2.0, parked_mm=0.2, compliance_mm_N=3.0, backlash_mm=0.0)
    found = press(bistable(2.5, 7.0, 0.1), machine, method(25.0, 2.0), 1)[0][0].result
    assert found.snap_through is not None
    assert found.snap_back is not None
    assert found.snap_through.fall_N > 0.5
    assert found.snap_through.depth_mm > 2.4
    rigid = result(bistable(2.5, 7.0), 9.5)
    assert rigid.snap_through is None
    assert "never falls at once" in rigid.reasons["snap_through"]


def test_single_samples_that_stand_out_are_left_out_and_counted() -> None:
    """One of half a newton before contact would put that a millimetre early."""
    u = np.arange(0, 5.0, 0.01)
    force = 0.5 * np.maximum(u - 1.5, 0.0) + np.random.default_rng(1).normal(0, 0.002, len(u))
    plain = analyse_curve(Strokes(u, force, u[::-1], force[::-1]))
    hit = force.copy()
    hit[[60, 350, 420]] += (0.5, -0.3, 2.0)
    found = analyse_curve(Strokes(u, hit, u[::-1], force[::-1]))
    assert (plain.spikes_count, found.spikes_count) == (0, 3)
    assert found.contact.position_mm == pytest.approx(1.5, abs=0.02)
    assert found.force_max_N == pytest.approx(plain.force_max_N)


def test_a_cusp_and_a_snap_are_no_disturbances() -> None:
    u = np.arange(0, 6.0, 0.15)
    cusp = np.where(u < 4.05, 0.5 * np.maximum(u - 2.0, 0.0), 0.2)
    calm, count = without_spikes(cusp, 1e-3)
    assert count == 0
    np.testing.assert_array_equal(calm, cusp)
