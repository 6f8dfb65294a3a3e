"""The laser room's figures: `python -m benchmarks laser [PART…] [--url URL [--allow-motion]] [--quick]`.

Without `--url`, on the simulated board in virtual time, which makes every figure repeatable; the recorded dialogues are
looked for beside the project or in `FABCTL_SHARED`. With `--url`, lines/s and reaction times are measured on whatever
answers there, and with `--allow-motion` (at most 5 mm, beam off) the estimate of a small job too.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import Figure
from benchmarks._laser_dialogues import differences, recorded_job, rows_of
from benchmarks._laser_endpoint import motion, reactions, ready
from benchmarks._laser_jobs import JOBS, burnt_against, timed_jobs
from benchmarks._laser_kills import KILLS, RUN_ON_S, killed_run, missing_count, resumed, twice_mm
from benchmarks._laser_kills import PROGRAM as KILL_PROGRAM
from benchmarks._laser_rig import Rig, Watch, lit_while_standing, slits
from drivers.errors import DeviceError, TransportError
from drivers.grbl.check import check_program
from drivers.grbl.faults import BoardRestarted, DoubledOk, GarbledLine, LinkStalled, LostOk
from drivers.grbl.laser import Laser
from drivers.grbl.run import StoppedByOperator, run_program
from drivers.transport import open_transport
from fabctl.cut.estimate import Dynamics, estimate
from fabctl.cut.execute import run_plan
from fabctl.cut.place import Affine
from fabctl.cut.plan import CutPlan, program_times
from fabctl.cut.program import read_program
from fabctl.events import silent
from simulators.faults import Fault

WIRE_LINES_S, LINE_BYTES = 1239.0, 9.3
SEEDS_COUNT = 20
EXPECTED: dict[str, type[Exception] | None] = {
    "lost-ok": LostOk,
    "double-ok": DoubledOk,
    "corrupt": GarbledLine,
    "nul": None,
    "merged": None,
    "banner": BoardRestarted,
    "unplug": TransportError,
    "stall": LinkStalled,
    "slow": None,
}


def measure(words: list[str]) -> list[Figure]:
    """Return the figures; `--quick` takes fewer lines, seeds and kills."""
    quick = "--quick" in words
    url = words[words.index("--url") + 1] if "--url" in words else None
    if url is not None:
        there = [*throughput(url, 5_000 if quick else 100_000), *reactions(url)]
        return [*there, *motion(url)] if "--allow-motion" in words else there
    parts: dict[str, Callable[[], list[Figure]]] = {
        "dialogues": dialogues,
        "throughput": lambda: throughput(None, 5_000 if quick else 100_000),
        "pacer": pacer,
        "burn": burn,
        "faults": lambda: faults(4 if quick else SEEDS_COUNT),
        "slow-move": slow_move,
        "pin": pin,
        "kills": lambda: [*kills(10 if quick else len(KILLS)), *short_slits(2 if quick else 9)],
        "estimates": estimates,
    }
    chosen = [name for name in parts if name in words] or list(parts)
    return [figure for name in chosen for figure in parts[name]()]


def dialogues() -> list[Figure]:
    """Replay the recorded dialogues against the simulated board."""
    folder = Path(os.environ.get("FABCTL_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    paths = sorted((folder / "laser" / "grbl-1.1h-dialogues").glob("*.jsonl"))
    same = sum(not differences(rows_of(path)) for path in paths)
    asked = "all, to the byte but for status numbers" if paths else "not measured: no recordings here"
    met = same == len(paths) if paths else None
    found = [Figure("recorded dialogues answered alike", f"{same}/{len(paths)}", "", asked, met, len(paths))]
    motion_path = folder / "laser" / "grbl-1.1h-dialogues" / "motion.jsonl"
    if motion_path.exists():
        lines, took_s = recorded_job(motion_path)
        board = Dynamics.of({1: 25, 100: 250, 101: 250, 110: 6000, 111: 6000, 120: 500, 121: 500})
        error = estimate(read_program(lines).steps, board).total_s / took_s - 1
        name = f"time estimate of the recorded job of {took_s:.2f} s"
        found.append(Figure(name, round(100 * error, 1), "%", "within 2 %", abs(error) <= 0.02, 1))
    return found


def nine_bytes(count: int, positive: bool = False) -> list[str]:
    """Return lines that are 9.3 bytes long on average, newline included, within 100 × 80 mm of the travel.

    Check mode obeys soft limits: machine space is negative, or positive where the firmware homes to zero.
    """
    x, y = ("X{}.5", "Y{}") if positive else ("X-{}", "Y-{}")
    moves = (x.format(k % 90 + 10) + y.format(k % 70 + 10) + (".5" if k % 20 < 3 else "") for k in range(count))
    return ["G21G90", "G1F1000", *moves]


def throughput(url: str | None, count: int) -> list[Figure]:
    """Measure check-mode lines per second on a paced line, against the wire's own limit for these lines."""
    with tempfile.TemporaryDirectory() as folder:
        process, address = (None, url) if url else start_board(Path(folder) / "port")
        try:
            with Laser(open_transport(str(address))) as laser:
                identity = ready(laser).identity
                assert identity is not None
                lines = nine_bytes(count, identity.homes_to_zero)
                began_s = time.perf_counter()
                refused = check_program(laser.link, lines, identity.rx_bytes)
                took_s = time.perf_counter() - began_s
                laser.end()
        finally:
            if process is not None:
                process.terminate()
                process.wait()
    rate = len(lines) / took_s
    mean_bytes = sum(len(line) + 1 for line in lines) / len(lines)
    wire = 11_520 / mean_bytes
    return [
        Figure(f"check-mode throughput, {mean_bytes:.1f} B lines", round(rate), "lines/s",
               f">= 95 % of the wire ({0.95 * wire:.0f} lines/s)", rate >= 0.95 * wire, count),
        Figure("lines refused in check mode", len(refused), "", "0 of 100,000", not refused, count),
    ]  # fmt: skip


def start_board(port: Path, *more: str) -> tuple[subprocess.Popen[str], str]:
    """Start a simulated board behind a pty; return the process and its URL."""
    command = [sys.executable, "-m", "simulators", "grbl", "--pty", str(port), "--set", "32=1", *more]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert process.stdout is not None
    return process, process.stdout.readline().split()[1]


def pacer() -> list[Figure]:
    """Measure the fastest second of the simulated line, host to board, in virtual time."""
    rig = Rig()
    arrivals: list[float] = []
    interrupt = rig.board._interrupt

    def noted(byte: int) -> bool:
        arrivals.append(rig.clock.now_s())
        return interrupt(byte)

    rig.board._interrupt = noted  # type: ignore[method-assign]
    rig.board.receive(b"G4P0\n" * 4000)
    rig.board.advance_to(rig.clock.now_s() + 3)
    worst = max((k + 11_520 for k in range(0, len(arrivals) - 11_520, 97)), default=0)
    fastest = min((arrivals[k] - arrivals[k - 11_520] for k in range(11_520, worst)), default=math.inf)
    rate = 11_520 / fastest
    return [
        Figure(
            "the pacer's fastest second", round(rate, 1), "B/s", "never above 11,520", rate <= 11_520.5, len(arrivals)
        )
    ]


def burn() -> list[Figure]:
    """Compare the burnt picture with the programs that were asked for."""
    worst_mm, missing, extra, twice = 0.0, 0, 0, 0.0
    for name, lines in JOBS.items():
        found = burnt_against(name, lines)
        worst_mm = max(worst_mm, found.worst_mm)
        missing, extra = missing + found.missing_count, extra + found.extra_count
        twice = max(twice, found.excess_mm)
    n = len(JOBS)
    return [
        Figure("burn trace: farthest from the design", round(worst_mm, 4), "mm", "within 0.02 mm", worst_mm <= 0.02, n),
        Figure("burn trace: design points not burnt", missing, "", "every slit burnt", missing == 0, n),
        Figure("burn trace: burnt points off the design", extra, "", "nothing else", extra == 0, n),
        Figure(
            "burn trace: length burnt too much per stroke", round(twice, 4), "mm", "once (0.02 mm)", twice <= 0.02, n
        ),
    ]


def faults(seeds_count: int) -> list[Figure]:
    """Let every fault happen; count how many are named rightly, how soon, and whether a line was ever sent twice."""
    program = slits(70)
    right = total = resent = 0
    slowest_s = 0.0
    for kind, expected in EXPECTED.items():
        for seed in range(seeds_count):
            rig = Rig(fault=Fault(kind, seed))
            laser = rig.laser()
            laser.connect()
            stops: list[float] = []
            rig.before_send = (
                lambda data, rig=rig, stops=stops: (  # type: ignore[misc]
                    stops.append(rig.clock.now_s()) if data[:1] in (b"!", b"\x18") else None
                )
            )
            caught: type[Exception] | None = None
            watch = Watch(since_s=lambda rig=rig: _done_s(rig))  # type: ignore[misc]
            try:
                run_program(laser, program, watch)
            except DeviceError as fault:
                caught = type(fault)
            total += 1
            right += caught is expected
            sent = re.sub(rb"[?!~\x18\x80-\xff]", b"", bytes(rig.sent)).decode().split("\n")
            lines = [line for line in sent if line and line[0] != "$"]
            resent += lines != program[: len(lines)]
            if expected is not None:
                # a lost answer shows at standstill only, a doubled one there at the latest
                evidence_s = watch.idle_s if kind in ("lost-ok", "double-ok") else _done_s(rig)
                acted_s = stops[0] if stops else rig.clock.now_s()
                slowest_s = max(slowest_s, acted_s - (evidence_s or acted_s))
    return [
        Figure("faults classified rightly", f"{right}/{total}", "", "each × 20 seeds, all", right == total, total),
        Figure("slowest reaction to the evidence", round(slowest_s, 3), "s", "within 1 s", slowest_s < 1.0, total),
        Figure("runs in which a line was sent twice or out of order", resent, "", "never", resent == 0, total),
    ]


def _done_s(rig: Rig) -> float:
    return math.inf if rig.fault is None or rig.fault.done_s is None else rig.fault.done_s


def slow_move() -> list[Figure]:
    """Run a single move of 60 s and see that nobody takes it for a stall."""
    rig = Rig()
    laser = rig.laser()
    laser.connect()
    begun_s = rig.clock.now_s()
    try:
        run_program(laser, ["G21", "G90", "M4S0", "G0X-200Y-150", "G1X-190F10S300", "M5", "G4P0.01"], Watch())
        healthy = True
    except DeviceError:
        healthy = False
    took_s = rig.clock.now_s() - begun_s
    return [
        Figure(
            "a healthy move of 60 s runs through", round(took_s, 1), "s", "never aborted", healthy and took_s > 60, 1
        )
    ]


def pin() -> list[Figure]:
    """Measure when the beam is off after a hold and after an abort at 25 mm/s and 500 mm/s²."""
    hold_s, abort_s = [], []
    for seed in range(20):
        rig = Rig()
        laser = rig.laser()
        laser.connect()
        at_s = rig.clock.now_s() + 1.0 + 0.0137 * seed
        watch = Watch([(at_s, "hold"), (at_s + 0.6, "stop")], rig.clock)
        sent_s: list[float] = []
        rig.before_send = (
            lambda data, rig=rig, sent_s=sent_s: (  # type: ignore[misc]
                sent_s.append(rig.clock.now_s()) if data[:1] == b"!" else None
            )
        )
        with contextlib.suppress(StoppedByOperator):
            run_program(laser, ["G21", "G90", "M4S0", "G1X-100F1500S500", "M5", "G4P0.01"], watch)
        hold_s.append(next(p.t_s for p in rig.trace if p.t_s >= sent_s[0] and p.power_frac == 0) - sent_s[0])
        rig = Rig()
        rig.board.receive(b"G21G90M4S0\nG1X-100F1500S500\n")
        rig.board.advance_to(rig.clock.now_s() + 1.0 + 0.0137 * seed)
        began_s = rig.clock.now_s()
        rig.board.receive(b"\x18")
        rig.board.advance_to(began_s + 1.0)
        abort_s.append(next(p.t_s for p in rig.trace if p.t_s >= began_s and p.power_frac == 0) - began_s)
    brake_s = 25 / 500
    limit_s = brake_s + 0.050
    return [
        Figure("beam off after a hold (braking takes 50 ms)", round(1000 * max(hold_s), 1), "ms",
               "within deceleration + 50 ms", max(hold_s) <= limit_s + 0.001, len(hold_s)),
        Figure("beam off after an abort", round(1000 * max(abort_s), 2), "ms", "at once", max(abort_s) < 0.001, 20),
    ]  # fmt: skip


def kills(count: int) -> list[Figure]:
    """Kill the host at random moments; look at the beam, resume, and look at what was burnt."""
    program = read_program(KILL_PROGRAM)
    lit_s, missing, worst_mm, kept = 0.0, 0, 0.0, 0
    lost_missing, lost_mm, believed = 0, 0.0, 0
    for seed in range(count):
        rig, rows, died_s = killed_run(seed, program)
        kept += resumed(rig, rows, program, died_s)
        lit_s = max(lit_s, lit_while_standing(rig.trace))
        missing += missing_count(rig, program)
        worst_mm = max(worst_mm, twice_mm(rig, program))
        # at once, in the middle of what it holds, or after all of it: a plug pulled, and the power some time later
        rig, rows, died_s = killed_run(seed, program, absence_s=(0.0, 0.4, 8.0)[seed % 3])
        believed += resumed(rig, rows, program, died_s, restart=True)
        lost_missing += missing_count(rig, program)
        lost_mm = max(lost_mm, twice_mm(rig, program))
    slit_mm = 5.0
    return [
        Figure("beam on while standing after a kill", round(lit_s, 4), "s", "never (100 kills)", lit_s < 0.015, count),
        Figure("kills with the position kept", f"{kept}/{count}", "", "board alive: all", kept == count, count),
        Figure("geometry left unburnt after kill and resume", missing, "points", "100 % burnt", missing == 0, count),
        Figure("burnt twice per kill, board alive", round(worst_mm, 3), "mm", "<= 1 mm", worst_mm <= 1.0, count),
        Figure("restarted boards believed", believed, "", "refused until homed", believed == 0, count),
        Figure("geometry left unburnt, position lost", lost_missing, "points", "100 % burnt", lost_missing == 0, count),
        Figure("burnt twice per kill, position lost", round(lost_mm, 2), "mm", "<= one slit (5 mm)",
               lost_mm <= slit_mm, count),
    ]  # fmt: skip


def short_slits(count: int) -> list[Figure]:
    """Kill cuts of slits shorter than two status reports, the position lost."""
    found = []
    for length_mm in (1.0, 2.0):
        program = read_program(slits(30, length_mm=length_mm))
        worst_mm, missing = 0.0, 0
        for seed in range(count):
            rig, rows, died_s = killed_run(seed, program, absence_s=(0.0, 0.4, 8.0)[seed % 3])
            resumed(rig, rows, program, died_s, restart=True)
            worst_mm, missing = max(worst_mm, twice_mm(rig, program)), missing + missing_count(rig, program)
        name = f"burnt twice per kill, position lost, slits of {length_mm:g} mm"
        met = worst_mm <= length_mm and missing == 0
        found.append(Figure(name, round(worst_mm, 2), "mm", f"<= one slit ({length_mm:g} mm)", met, count))
    return found


def estimates() -> list[Figure]:
    """Compare the estimated time of twelve jobs, run as a cut runs them, with the simulated board's own.

    Both count from the first line until the board is seen standing at the end, as a cut's record does. What the host
    listens on after that, with the board standing, is told beside it.
    """
    errors: list[tuple[float, str]] = []
    listened_s = 0.0
    for name, lines in timed_jobs().items():
        rig = Rig()
        rig.board.trace = None
        laser = rig.laser()
        identity = laser.connect()
        program = read_program(lines, start_mm=(-1.0, -1.0))
        plan = CutPlan(program, program_times(program, identity), Affine(), (0.0, 0.0, 0.0), ())
        begun_s = rig.clock.now_s()
        progress, track = run_plan(laser, plan, RUN_ON_S, silent)
        assert progress.time_s is not None
        listened_s = max(listened_s, rig.clock.now_s() - begun_s - progress.time_s)
        errors.append((track.times.total_s / progress.time_s - 1, name))
    worst, name = max(errors, key=lambda item: abs(item[0]))
    return [
        Figure(f"time estimate to standstill, worst of {len(errors)} jobs ({name})", round(100 * worst, 2), "%",
               "within 2 %", abs(worst) <= 0.02, len(errors)),
        Figure("host before and after a job, the board standing", round(listened_s, 2), "s", "", None, len(errors)),
    ]  # fmt: skip
