"""What the board itself, or the state it is in, has against a program is found before anything moves."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks._laser_rig import LAB, Rig
from design.findings import errors
from drivers.errors import DeviceAlarm
from drivers.grbl.laser import Laser
from fabctl.config.bench import LaserConfig
from fabctl.config.material import LaserPreset, LayerConfig, MaterialConfig
from fabctl.cut.by_hand import run_here
from fabctl.cut.execute import check_on_board
from fabctl.cut.job import recheck_offset
from fabctl.cut.place import Affine
from fabctl.cut.plan import CutPlan, program_times
from fabctl.cut.preflight import preflight
from fabctl.cut.program import read_program
from fabctl.errors import RefusedError
from fabctl.events import silent
from simulators.grbl.machine import State

HERE = ("G21", "G90", "G94", "M4S0", "G1X-5F600S{s}", "M5", "G4P0.01")
BENCH: Any = SimpleNamespace(
    config=SimpleNamespace(name="small", laser=LaserConfig(url="tcp://x:1", travel_mm=(300.0, 200.0)))
)


LAYER = LayerConfig(power_frac=0.5, feed_mm_s=25.0)
RUBBER = MaterialConfig(
    name="rubber", E_MPa=1.5, nu_ratio=0.45, thickness_mm=2.3, density_kg_m3=1150.0,
    laser=LaserPreset(slit=LAYER, outline=LAYER, engrave=LAYER, mark=LAYER, kerf_mm=0.125, air_assist=False),
)  # fmt: skip


def connected(rig: Rig) -> Laser:
    laser = rig.laser()
    laser.connect()
    return laser


def refusal(run: Any) -> set[str]:
    with pytest.raises(RefusedError) as caught:
        run()
    return {finding.code for finding in caught.value.findings}


def assert_stands(rig: Rig, laser: Laser) -> None:
    assert laser.report().machine_mm == pytest.approx((-1.0, -1.0, -1.0), abs=0.002)  # told in inches, rounded
    assert all(point.power_frac == 0 for point in rig.trace)


def test_every_line_that_the_board_refuses_in_check_mode_is_named() -> None:
    rig = Rig()
    laser = connected(rig)
    with pytest.raises(RefusedError) as caught:
        check_on_board(laser, ["G21", "G1X-5F600", "G1X-9", "M117", "G2X-90R0.1"])
    assert [(f.code, f.where) for f in caught.value.findings] == [("CUT-BOARD", "line 4"), ("CUT-BOARD", "line 5")]
    assert_stands(rig, laser)


def test_an_offset_that_changed_since_the_plan_is_found() -> None:
    laser = connected(Rig())
    assert laser.identity is not None
    program = read_program(HERE[:2])
    plan = CutPlan(program, program_times(program, laser.identity), Affine(), (0.0, 0.0, 0.0), ())
    recheck_offset(laser, plan)
    laser.ask("G10L2P1X-7")
    assert refusal(lambda: recheck_offset(laser, plan)) == {"CUT-OFFSET"}


@pytest.mark.parametrize("ends", [(-6.0, -2.0), (-6.0, 0.0), (-6.0, 0.001), (-300.0, -290.0), (-300.001, -290.0)])
def test_what_passes_the_preflight_passes_the_board_s_own_soft_limits(ends: tuple[float, float]) -> None:
    low, high = ends
    lines = ("G21", "G90", "M4S0", f"G0X{low:g}Y-5F600S300", f"G1X{high:g}", "M5", "G4P0.01")
    laser = connected(Rig())
    assert laser.identity is not None
    bench = LaserConfig(url="tcp://x:1", travel_mm=(300.0, 200.0))
    found = preflight(read_program(lines), laser.identity, laser.report(), bench, RUBBER, (0.0, 0.0, 0.0))
    assert (errors(found) == []) is (low >= -300.0 and high <= 0.0)
    if errors(found):
        with pytest.raises(DeviceAlarm):
            check_on_board(laser, lines)
    else:
        check_on_board(laser, lines)


@pytest.mark.parametrize(
    ("expected", "settings", "lines"),
    [
        ("CUT-LASER-MODE", {32: 0}, HERE),
        ("CUT-X", {}, ("G21", "G90", "M4S0", "G1X90F600S{s}", "M5")),
        ("CUT-INCHES", {13: 1}, HERE),
        ("CUT-HOMING", {20: 0, 22: 0}, HERE),
        ("CUT-RATE", {110: 500}, HERE),
        ("CUT-S", {30: 1000}, ("G21", "G90", "M4S0", "G1X-5F600S1001", "M5")),
        ("CUT-M3", {}, ("G21", "G90", "M3S0", "G1X-5F600S{s}", "M5")),
        ("CUT-FORBIDDEN", {}, (*HERE, "G10L2P1X0")),
    ],
)
def test_by_hand_too_nothing_moves_that_could_not_end_well(
    expected: str, settings: dict[int, float], lines: Sequence[str]
) -> None:
    rig = Rig(settings={**LAB, **settings})
    laser = connected(rig)
    assert refusal(lambda: run_here(laser, BENCH, lines, 0.1, silent)) == {expected}
    assert_stands(rig, laser)


@pytest.mark.parametrize("expected", ["CUT-STARTUP", "CUT-OVERRIDE", "CUT-SWITCH", "CUT-STATE"])
def test_by_hand_too_the_board_s_own_state_is_looked_at(expected: str) -> None:
    rig = Rig()
    laser = connected(rig)
    if expected == "CUT-STARTUP":
        laser.ask("$N1=M3S9")
        laser.connect()
    elif expected == "CUT-OVERRIDE":
        laser.override("feed", 120)
        for _ in range(9):  # the next reports do not tell them
            laser.report()
    elif expected == "CUT-SWITCH":
        rig.board.machine.world.switch_stuck = True
    else:
        laser.open_door()
        laser.report()
    assert refusal(lambda: run_here(laser, BENCH, HERE, 0.1, silent)) == {expected}
    assert_stands(rig, laser)


def test_a_board_that_tells_work_places_only_burns_from_where_the_head_is() -> None:
    rig = Rig(settings={**LAB, 10: 0})
    laser = connected(rig)
    laser.ask("G10L2P1X-30Y-20")
    laser.connect()
    run_here(laser, BENCH, HERE, 0.1, silent)
    lit = [point for point in rig.trace if point.power_frac > 0]
    assert lit[0].x_mm == pytest.approx(-1.0, abs=0.1)
    assert laser.report().machine_mm == pytest.approx((-6.0, -1.0, -1.0), abs=0.03)


def test_a_locked_board_runs_nothing_by_hand() -> None:
    rig = Rig()
    laser = connected(rig)
    rig.board.machine.state = State.ALARM
    assert refusal(lambda: run_here(laser, BENCH, HERE, 0.1, silent)) == {"CUT-LOCKED"}
    assert_stands(rig, laser)
