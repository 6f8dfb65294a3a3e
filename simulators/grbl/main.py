"""`python -m simulators grbl`: a GRBL laser behind a pty or a TCP port."""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from simulators.clock import Clock
from simulators.endpoints import PtyEndpoint, TcpEndpoint
from simulators.faults import KINDS, SLOW_S, Fault
from simulators.grbl.board import Board, Point
from simulators.grbl.dialects import DIALECTS
from simulators.grbl.machine import Machine, World
from simulators.grbl.settings import Memory

LONGEST_WAIT_S = 0.02
SHORTEST_WAIT_S = 0.0008  # nine bytes of a fast line: looking at each by itself would cost more than all the rest
Trace = Callable[[Point], None]
# A laser as a lab has it: 300 × 200 mm, homing at the far corner, laser mode on, motors that never let go.
LAB: dict[int, float] = {
    1: 255,
    22: 1,
    20: 1,
    32: 1,
    30: 1000,
    10: 3,
    130: 300,
    131: 200,
    110: 6000,
    111: 6000,
    120: 500,
    121: 500,
    25: 3000,
    24: 300,
    26: 50,
}


def main(words: list[str]) -> int:
    """Run until terminated; prints `ready URL` once it listens."""
    options = _parse(words)
    signal.signal(signal.SIGTERM, _leave)
    with contextlib.suppress(KeyboardInterrupt), _beam_log(options.trace) as trace:
        endpoint = PtyEndpoint(options.pty, options.baud) if options.pty else TcpEndpoint(options.tcp)
        try:
            print(f"ready {endpoint.url}", flush=True)
            _serve(endpoint, options, trace)
        finally:
            endpoint.close()
    return 0


def make_machine(options: argparse.Namespace) -> Machine:
    """Return the board that the options describe; its EEPROM is as from the factory but for `--lab` and `--set`."""
    memory = Memory()
    changes: dict[int, float] = dict(LAB) if options.lab else {}
    for pair in options.set or []:
        number, _, value = pair.partition("=")
        changes[int(number)] = float(value)
    for number, value in changes.items():
        if memory.store(number, float(value)):
            raise SystemExit(f"${number}={value:g} is not a setting this board takes")
    memory.pending_s = 0.0
    world = World(switches=options.lab or options.switches)
    if options.lab:
        world.real_mm = (-40.0, -30.0, -5.0)
        memory.values[132] = 10.0
    return Machine(memory=memory, world=world, options=options.options, dialect=DIALECTS[options.dialect])


def _serve(endpoint: PtyEndpoint | TcpEndpoint, options: argparse.Namespace, trace: Trace | None) -> None:
    clock = Clock(options.speed)
    fault = Fault(options.fault, options.seed) if options.fault else None
    machine = make_machine(options)
    board = Board(machine, baud=options.baud if options.pace else None, trace=trace)
    while True:
        now_s = clock.now_s()
        board.advance_to(now_s)
        out = board.take()
        if fault is not None:
            out = _spoil(fault, out, now_s, board, endpoint)
        wait_s = min(board.next_event_s(), board.next_output_s()) - clock.now_s()
        wait_s = (
            min(max(clock.real_s(wait_s), SHORTEST_WAIT_S), LONGEST_WAIT_S)
            if not math.isnan(wait_s)
            else LONGEST_WAIT_S
        )
        data, opened = endpoint.exchange(out, wait_s)
        if opened and options.dtr_reset:
            board.restart()
        if data and (fault is None or fault.passes(now_s)):
            board.advance_to(clock.now_s())
            board.receive(data)


def _spoil(fault: Fault, out: bytes, now_s: float, board: Board, endpoint: PtyEndpoint | TcpEndpoint) -> bytes:
    if not fault.passes(now_s):
        return b""
    out = fault.spoil(out, now_s)
    if fault.restart:
        fault.restart = False
        board.restart()
    if fault.crawl:
        fault.crawl = False
        board.machine.stepper.linger_s = SLOW_S
    if fault.unplug:
        fault.unplug = False
        endpoint.exchange(out, 0.0)
        endpoint.unplug()
        return b""
    return out


@contextlib.contextmanager
def _beam_log(path: Path | None) -> Iterator[Trace | None]:
    """Write the beam's path to a CSV file: from each row's time and place on, the beam had the row's power."""
    if path is None:
        yield None
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="ascii", buffering=1) as stream:
        stream.write("t_s,x_mm,y_mm,power_frac\n")

        def note(point: Point) -> None:
            stream.write(f"{point.t_s:.6f},{point.x_mm:.4f},{point.y_mm:.4f},{point.power_frac:.4f}\n")

        yield note


def _parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m simulators grbl", description=__doc__)
    line = parser.add_mutually_exclusive_group(required=True)
    line.add_argument("--pty", type=Path, metavar="PATH", help="make a pseudo terminal and link it here")
    line.add_argument("--tcp", type=int, metavar="PORT", help="listen on this port of the loopback (0: any)")
    parser.add_argument("--baud", type=int, default=115200)
    parser.add_argument("--no-pace", dest="pace", action="store_false", help="let bytes pass at once")
    parser.add_argument("--speed", type=float, default=1.0, help="let time run so many times as fast")
    parser.add_argument("--trace", type=Path, metavar="CSV", help="write the beam's path here")
    parser.add_argument("--lab", action="store_true", help="a configured laser with limit switches, not a bare board")
    parser.add_argument("--switches", action="store_true", help="connect limit switches")
    parser.add_argument("--set", action="append", metavar="N=VALUE", help="change a setting before power-up")
    parser.add_argument("--options", default="V", help="the build options that $I shows")
    parser.add_argument("--dialect", choices=sorted(DIALECTS), default="grbl", help="speak as this firmware does")
    parser.add_argument("--dtr-reset", action="store_true", help="restart when a host opens the line")
    parser.add_argument("--fault", choices=KINDS, help="let this fault happen once")
    parser.add_argument("--seed", type=int, default=0, help="seed of the fault's moment")
    return parser.parse_args(words)


def _leave(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
