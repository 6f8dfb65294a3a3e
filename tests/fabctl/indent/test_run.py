"""A run in virtual time: what is asked of the controller, and how every way out leaves the stage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from benchmarks._rig_memory import REGISTERS, Kept, MemoryBus, method
from drivers.errors import DeviceTimeout
from drivers.rig.indenter import Indenter
from drivers.rig.refusals import RigFaulted
from drivers.rig.samples import Sample
from fabctl.config.loader import parse
from fabctl.config.method import MethodConfig
from fabctl.errors import RefusedError, Stopped
from fabctl.events import Event
from fabctl.indent.method import actions
from fabctl.indent.run import ForceOffZero, NoContact, Runner, left_behind
from fabctl.indent.sampling import TimeLeft, Wish
from simulators.rig import registers as R
from simulators.rig.controller import Controller, Machine
from simulators.specimens.analytic import linear, softening
from simulators.specimens.curve import Curves, Place, Specimen

QUIET = Machine(noise_N=0.001, contact_mm=2.0, parked_mm=0.2, backlash_mm=0.0)


class Bench:
    """A controller, a runner on it, and what was heard."""

    def __init__(
        self,
        curves: Curves | None,
        plan: MethodConfig,
        machine: Machine = QUIET,
        wish: Callable[[Bench], Wish] = lambda _: "go",
    ) -> None:
        self.device = Controller(machine, Specimen(curves) if curves else None)
        self.told: list[tuple[str, dict[str, object]]] = []
        self.device.tell = lambda kind, facts: self.told.append((kind, facts))
        self.bus, self.kept, self.events = MemoryBus(self.device), Kept(), list[Event]()
        self.rig = Indenter(self.bus, REGISTERS, now_s=self.bus.now_s, sleep=self.bus.sleep)
        self.runner = Runner(
            self.rig,
            plan,
            actions(plan),
            self.kept,
            self.bus,
            100.0,
            self.events.append,
            lambda: wish(self),
        )

    def codes(self) -> list[int]:
        return [int(facts["code"]) for kind, facts in self.told if kind == "command"]  # type: ignore[call-overload]


def left_standing(bench: Bench) -> bool:
    """Tell whether the stage stands disarmed, and does not move in the second that follows."""
    at = bench.device.axis.position_mm
    bench.device.advance(1000)
    state = R.values_of(R.STATUS, bench.device.status_words()[:-1])["state"]
    return state in (R.DISARMED, R.FAULTED) and abs(bench.device.axis.position_mm - at) < 0.05


def test_a_normal_end_draws_back_and_disarms() -> None:
    bench = Bench(linear(0.5), method(3.0, 2.0))
    ending = bench.runner.execute()
    assert ending.curves_done == [(0, 1)]
    assert bench.device.axis.position_mm == pytest.approx(0.2, abs=1e-3)
    assert left_standing(bench)
    assert bench.codes()[-2:] == [R.STOP, R.DISARM]


def test_limits_are_in_the_controller_before_the_first_motion() -> None:
    bench = Bench(linear(0.5), method(3.0, 2.0))
    bench.runner.execute()
    assert bench.device.settings["force_max"] == pytest.approx(45.0)
    assert bench.device.settings["travel_max"] == pytest.approx(55.0)
    assert bench.codes().index(R.ARM) < bench.codes().index(R.HOME)


def test_a_stop_leaves_the_stage_where_it_is() -> None:
    bench = Bench(linear(0.5), method(5.0, 1.0), wish=lambda b: "stop" if b.device.depth_mm > 1.0 else "go")
    with pytest.raises(Stopped):
        bench.runner.execute()
    assert left_standing(bench)
    assert bench.device.depth_mm == pytest.approx(1.0, abs=0.1)


def test_a_pause_stands_and_goes_on_to_the_same_place() -> None:
    paused_ticks: list[int] = []

    def wish(bench: Bench) -> Wish:
        if bench.device.depth_mm > 1.0 and len(paused_ticks) < 50:
            paused_ticks.append(bench.device.tick_count)
            return "pause"
        return "go"

    bench = Bench(linear(0.5), method(3.0, 1.0), wish=wish)
    ending = bench.runner.execute()
    assert ending.curves_done == [(0, 1)]
    assert paused_ticks[-1] - paused_ticks[0] > 200
    deepest = max(row.position_mm for row in bench.kept.rows)
    assert deepest == pytest.approx(2.0 + 3.0, abs=0.2)  # contact is taken where the trigger is met


def test_a_pause_asked_for_while_the_stage_stands_lets_no_motion_begin() -> None:
    asked: list[int] = []

    def wish(bench: Bench) -> Wish:
        during_the_tare = bench.runner.sampler.action.kind == "tare"
        if during_the_tare or (asked and len(asked) < 80):
            asked.append(bench.device.tick_count)
            return "pause"
        return "go"

    bench = Bench(linear(0.5), method(3.0, 1.0), wish=wish)
    bench.device.tell = lambda kind, facts: bench.told.append((kind, {**facts, "tick": bench.device.tick_count}))
    bench.runner.execute()
    downwards = [f["tick"] for kind, f in bench.told if kind == "command" and f["code"] == R.MOVE_UNTIL_ABOVE]
    assert downwards[0] > asked[-1]  # type: ignore[operator]


def test_an_overload_stops_and_is_not_drawn_back() -> None:
    plan = method(8.0, 2.0)
    plan = plan.model_copy(update={"limits": plan.limits.model_copy(update={"force_N": 2.0})})
    bench = Bench(linear(0.5), plan)
    with pytest.raises(RigFaulted, match="overload"):
        bench.runner.execute()
    assert left_standing(bench)
    assert bench.device.true_N == pytest.approx(2.0, abs=0.15)


def test_no_specimen_is_no_contact() -> None:
    bench = Bench(None, method(3.0, 2.0))
    with pytest.raises(NoContact, match="did not rise"):
        bench.runner.execute()
    assert left_standing(bench)


GRID = """
name: grid
safe_height_mm: 0.5
travel_speed_mm_s: 20
acceleration_mm_s2: 200
limits: {force_N: 20, travel_mm: 40}
steps:
  - step: grid
    x_mm: [-15, 0, 15]
    y_mm: [0]
    steps:
      - {step: tare, time_s: 0.3}
      - {step: approach, speed_mm_s: 6, trigger_N: 0.06, clearance_mm: 1, travel_mm: 6}
      - {step: cycles, cycles_count: 1, depth_mm: 2, speed_mm_s: 2}
"""


def beside_the_middle(x_mm: float, _y_mm: float) -> Place | None:
    """A specimen with a hole in the middle of the grid."""
    return None if x_mm == 0 else Place(0.0, 1.0)


def test_a_grid_point_without_contact_is_noted_and_the_next_one_gone_to_by_the_safe_height() -> None:
    bench = Bench(linear(0.5), parse(GRID, MethodConfig, "grid.yaml"))
    bench.device.place = beside_the_middle
    ending = bench.runner.execute()
    assert ending.curves_done == [(1, 1), (3, 1)]
    assert set(ending.contacts_mm) == {1, 3}
    assert list(ending.no_contact) == [2]
    assert "did not rise by 0.06 N" in ending.no_contact[2]
    stages = [facts for kind, facts in bench.told if kind == "command" and facts["code"] == R.MOVE_STAGE]
    assert [facts["reason"] for facts in stages] == [R.NO_REASON] * 3  # the controller refuses one from below
    assert [e.data["point"] for e in bench.events if e.kind == "no_contact"] == [2]
    assert any("point 2: no contact" in e.message for e in bench.events if e.kind == "warning")
    assert len(ending.tares_N) == 3
    assert {row.curve for row in bench.kept.rows if row.point == 2} == {0}


def test_a_grid_point_that_ends_in_a_latched_fault_ends_the_run() -> None:
    def press_the_button(at: Bench) -> Wish:
        at.device.estop_open |= at.device.stage_mm[0] == 0 and at.device.axis.position_mm > 4
        return "go"

    bench = Bench(linear(0.5), parse(GRID, MethodConfig, "grid.yaml"), wish=press_the_button)
    bench.device.place = beside_the_middle
    with pytest.raises(RigFaulted, match="estop"):
        bench.runner.execute()
    assert bench.runner.ending.no_contact == {}
    bench.device.advance(100)  # it brakes
    assert left_standing(bench)


def test_the_time_left_stands_still_while_the_operator_holds_it_up() -> None:
    left = TimeLeft([10.0, 20.0, 5.0], 0.0)
    left.begin(1, 12.0)
    assert left.left_s(15.0) == pytest.approx(22.0)
    left.hold(16.0)
    assert left.left_s(90.0) == pytest.approx(21.0)
    left.go_on(100.0)
    assert left.left_s(101.0) == pytest.approx(20.0)
    # An action that takes longer than was thought takes nothing from those to come.
    assert left.left_s(1000.0) == pytest.approx(5.0)
    assert left.done_frac(1000.0) == pytest.approx(30 / 35)


def test_a_pause_is_shown_with_the_time_that_is_left_after_it() -> None:
    asked: list[int] = []

    def wish(bench: Bench) -> Wish:
        if bench.device.depth_mm > 1.0 and len(asked) < 300:
            asked.append(1)
            return "pause"
        return "go"

    bench = Bench(linear(0.5), method(3.0, 1.0), wish=wish)
    bench.runner.execute()
    shown = [e for e in bench.events if e.kind == "progress"]
    paused = [e.message for e in shown if e.data["step"] == "paused"]
    assert len(paused) > 10
    assert len({message.split()[-3] for message in paused}) == 1
    assert shown[-1].done_frac is not None
    assert 0.95 < shown[-1].done_frac < 1
    fractions = [e.done_frac for e in shown if e.done_frac is not None]
    assert fractions == sorted(fractions)


def test_a_cell_far_off_zero_is_refused_before_the_approach() -> None:
    bench = Bench(linear(0.5), method(3.0, 2.0), replace(QUIET, zero_N=30.0))
    with pytest.raises(ForceOffZero):
        bench.runner.execute()
    assert bench.device.depth_mm < 0


def test_a_line_that_falls_silent_ends_the_run_within_the_watchdog() -> None:
    bench = Bench(linear(0.5), method(8.0, 1.0))
    plain = bench.bus.exchange
    silent_since: list[float] = []

    def exchange(read_address: int, count: int, write_address: int, values: list[int]) -> list[int]:
        if bench.device.depth_mm > 1.0:
            silent_since.append(bench.bus.now_s())
            bench.device.advance(100)
            raise DeviceTimeout("memory:", "exchange", 0.1)
        return plain(read_address, count, write_address, values)

    bench.bus.exchange = exchange  # type: ignore[method-assign, assignment]
    with pytest.raises(DeviceTimeout):
        bench.runner.execute()
    fault = next(facts for kind, facts in bench.told if kind == "fault")
    assert fault["bit"] == R.WATCHDOG
    assert left_standing(bench)


def test_a_soft_specimen_is_approached_to_where_it_is_first_touched() -> None:
    plan = method(3.0, 1.0, trigger_N=0.02)
    bench = Bench(softening(0.01, 3.0), plan, replace(QUIET, noise_N=0.0003))
    ending = bench.runner.execute()
    # The trigger is met some 3 mm deep.
    assert ending.contacts_mm[0] == pytest.approx(2.0, abs=0.2)


def test_only_fresh_samples_feed_the_watchdog() -> None:
    bench = Bench(linear(0.5), method(3.0, 1.0))
    bench.runner.execute()
    fed = bench.device.last_feed
    assert fed in {row.sequence for row in bench.kept.rows}


SAMPLE = Sample(1, 0.0, 0.2, 0.0, "disarmed", (), 0, "none", "none")


def test_an_indenter_left_down_is_refused_before_anything_moves() -> None:
    bench = Bench(linear(0.5), method(3.0, 2.0), wish=lambda b: "stop" if b.device.depth_mm > 2.0 else "go")
    with pytest.raises(Stopped):
        bench.runner.execute()
    plan, before = method(3.0, 2.0), len(bench.codes())
    again = Runner(bench.rig, plan, actions(plan), bench.kept, bench.bus, 100.0)
    with pytest.raises(RefusedError, match="RIG-DOWN"):
        again.execute()
    assert set(bench.codes()[before:]) <= {R.STOP, R.DISARM}


def test_a_latched_fault_is_not_cleared_behind_the_operators_back() -> None:
    found = left_behind(replace(SAMPLE, faults=("watchdog",)), 1.0)
    assert [finding.code for finding in found] == ["RIG-LATCHED"]
    assert left_behind(replace(SAMPLE, faults=("unhomed", "restarted"), position_mm=9.0), 1.0) == []
