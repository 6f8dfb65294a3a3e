"""What can be measured on whatever answers at a URL: reaction times, and a small dark job against its estimate."""

from __future__ import annotations

import time

from benchmarks import Figure
from drivers.grbl.laser import Laser
from drivers.grbl.run import run_program
from drivers.transport import open_transport
from fabctl.cut.execute import CutWatch, from_here, no_keys
from fabctl.cut.place import Affine
from fabctl.cut.plan import CutPlan, head_mm, program_times
from fabctl.cut.program import decimal, read_program
from fabctl.cut.progress import Track
from fabctl.events import silent

REACH_MM = 5.0  # the job stays so close to where the head is
RUN_ON_S = 5.0


def ready(laser: Laser) -> Laser:
    """Connect, and unlock a board that is locked; return the laser."""
    laser.connect()
    if laser.report().state == "Alarm":
        laser.unlock()
    return laser


def reactions(url: str) -> list[Figure]:
    """Measure how long a status question and an `off` at standstill take."""
    with Laser(open_transport(url)) as laser:
        ready(laser)
        times = []
        for _ in range(50):
            began_s = time.perf_counter()
            laser.report()
            times.append(time.perf_counter() - began_s)
        began_s = time.perf_counter()
        left = laser.off()
        off_s = time.perf_counter() - began_s
    middle = sorted(times)[len(times) // 2]
    return [
        Figure("answer to a status question, median", round(1000 * middle, 1), "ms", "", None, 50),
        Figure("answer to a status question, slowest", round(1000 * max(times), 1), "ms", "", None, 50),
        Figure("off at standstill until the banner", round(1000 * off_s, 1), "ms", "confirmed", left.confirmed, 1),
    ]


def motion(url: str) -> list[Figure]:
    """Run a small dark job around where the head is, beside its estimate; then hold a move."""
    with Laser(open_transport(url)) as laser:
        identity = ready(laser).identity
        assert identity is not None
        report, offset = laser.report(), identity.work_offset_mm()
        x, y = head_mm(report, offset)
        sign = 1.0 if identity.homes_to_zero else -1.0
        program = read_program(_zigzag(x, y, sign), identity.setting(12) or 0.002, (x, y))
        plan = from_here(laser, CutPlan(program, program_times(program, identity), Affine(), offset, ()))
        watch = CutWatch(plan, Track(plan.program, plan.times, RUN_ON_S), silent, no_keys)
        took_s = run_program(laser, plan.lines, watch).time_s or 0.0
        hold_s = _held(laser, sign)
    error = plan.times.total_s / took_s - 1
    name = f"time estimate of a dark job of {took_s:.1f} s, to the report of standstill"
    return [
        Figure(name, round(100 * error, 2), "%", "within 2 %", abs(error) <= 0.02, 1),
        Figure("hold of a move at 5 mm/s until Hold:0", round(1000 * hold_s, 1), "ms", "", None, 1),
    ]


def _zigzag(x: float, y: float, sign: float) -> list[str]:
    """Return strokes with sharp and blunt corners, pauses and rapids, all within reach, beam off."""
    lines = ["G21", "G90", "G94", "M5"]
    for k in range(24):
        far = x + sign * REACH_MM if k % 2 == 0 else x
        lines.append(f"G1X{decimal(far)}Y{decimal(y + sign * REACH_MM * k / 24)}" + ("F1200" if k == 0 else ""))
        if k % 8 == 7:
            lines += ["G4P0.1", f"G0X{decimal(x)}Y{decimal(y)}"]
    return [*lines, f"G0X{decimal(x)}Y{decimal(y)}", "M5", "G4P0.01"]


def _held(laser: Laser, sign: float) -> float:
    """Hold a slow jog-like move and return how long that took; what is left of it is dropped by the reset after."""
    for line in ("G21", "G91", f"G1X{sign * REACH_MM:g}F300"):
        laser.ask(line)
    time.sleep(0.3)
    began_s = time.perf_counter()
    laser.hold()
    return time.perf_counter() - began_s
