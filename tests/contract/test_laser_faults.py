"""Every fault of the line, twenty times each: named rightly, soon, with the beam off, and nothing sent twice."""

from __future__ import annotations

import pytest

from benchmarks._laser_rig import Rig, Watch, lit_while_standing, slits
from drivers.errors import TransportError
from drivers.grbl.faults import BoardRestarted, DoubledOk, GarbledLine, LinkStalled, LostOk
from drivers.grbl.run import run_program
from simulators.faults import Fault

SEEDS = range(5)  # `python -m benchmarks laser` does twenty
PROGRAM = slits(70)
EXPECTED: dict[str, tuple[type[Exception], ...]] = {
    "lost-ok": (LostOk,),
    "double-ok": (DoubledOk,),
    "corrupt": (GarbledLine,),
    "banner": (BoardRestarted,),
    "unplug": (TransportError,),
    "stall": (LinkStalled,),
}


def lines_sent(rig: Rig) -> list[str]:
    text = bytes(byte for byte in rig.sent if byte < 0x80 and byte not in b"?!~\x18").decode()
    return [line for line in text.split("\n") if line and line[0] != "$"]


def note_first_hold(rig: Rig) -> list[float]:
    """Return a list that will hold the moment at which the driver first says stop."""
    times: list[float] = []
    rig.before_send = lambda data: times.append(rig.clock.now_s()) if data[:1] in (b"!", b"\x18") else None
    return times


@pytest.mark.parametrize("kind", sorted(EXPECTED))
@pytest.mark.parametrize("seed", SEEDS)
def test_a_fault_is_named_within_a_second_and_the_beam_goes_off(kind: str, seed: int) -> None:
    rig = Rig(fault=Fault(kind, seed))
    laser = rig.laser()
    laser.connect()
    first_hold_s = note_first_hold(rig)
    with pytest.raises(EXPECTED[kind]):
        run_program(laser, PROGRAM, Watch())
    assert rig.fault is not None and rig.fault.done_s is not None
    if kind == "unplug":
        assert rig.clock.now_s() - rig.fault.done_s < 1.0
    elif kind not in ("lost-ok", "double-ok"):  # those two show only when the board stands
        assert first_hold_s[0] - rig.fault.done_s < 1.0
    rig.board.advance_to(rig.clock.now_s() + 10)
    assert rig.board.machine.pin.power_frac == 0
    assert lit_while_standing(rig.trace) < 0.02
    assert lines_sent(rig) == PROGRAM[: len(lines_sent(rig))]


@pytest.mark.parametrize("kind", ["nul", "merged", "slow"])
@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_harmless_does_not_stop_the_job(kind: str, seed: int) -> None:
    rig = Rig(fault=Fault(kind, seed))
    laser = rig.laser()
    laser.connect()
    began_s = rig.clock.now_s()
    done = run_program(laser, PROGRAM, Watch())
    assert (rig.clock.now_s() - began_s > 60) is (kind == "slow")
    assert rig.fault is not None and rig.fault.done_s is not None
    assert done.answered_count == len(PROGRAM)
    assert lines_sent(rig) == PROGRAM
