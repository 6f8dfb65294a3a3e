"""Ten different jobs for the laser, and the burnt picture of a job against what was asked."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks._laser_rig import Rig, Watch, slits
from drivers.grbl.run import run_program
from fabctl.cut.estimate import Dynamics
from fabctl.cut.plan import with_lit_ends
from fabctl.cut.program import read_program

STEP_MM = 0.01
NEAR_MM = 0.02
LATTICE_RATIO = 1.001

HEAD, TAIL = ["G21", "G90", "G94", "M4S0"], ["M5", "G4P0.01"]


def polyline(points: Sequence[tuple[float, float]], feed: int, power: int) -> list[str]:
    """Return one stroke through `points`."""
    (x, y), *rest = points
    first, *others = [f"X{a:.3f}Y{b:.3f}" for a, b in rest]
    return [f"G0X{x:.3f}Y{y:.3f}", f"G1{first}F{feed}S{power}", *others]


def zigzag() -> list[str]:
    """Return one long stroke with sharp corners."""
    return [*HEAD, *polyline([(-200 + 2 * k, -150 + 20 * (k % 2)) for k in range(60)], 1500, 500), *TAIL]


def circles() -> list[str]:
    """Return full circles as arcs."""
    lines = list(HEAD)
    for k in range(8):
        lines += [f"G0X{-200 + 20 * k}Y-100", f"G2X{-200 + 20 * k}Y-100I{3 + k / 2:g}J0F1200S400"]
    return [*lines, *TAIL]


def spirals() -> list[str]:
    """Return hexagonal spirals, such as a cell's slits."""
    lines = list(HEAD)
    for k in range(12):
        cx, cy = -220 + 16 * (k % 6), -150 + 20 * (k // 6)
        points = [
            (cx + 0.55 * n * math.cos(n * math.pi / 3), cy + 0.55 * n * math.sin(n * math.pi / 3)) for n in range(2, 12)
        ]
        lines += polyline(points, 1500, 600)
    return [*lines, *TAIL]


def wave() -> list[str]:
    """Return a smooth curve in half-millimetre pieces."""
    return [*HEAD, *polyline([(-250 + 0.5 * k, -100 + 15 * math.sin(k / 20)) for k in range(400)], 3000, 300), *TAIL]


def scattered() -> list[str]:
    """Return short strokes in random places: mostly travel."""
    rng = random.Random(4)
    lines = list(HEAD)
    for _ in range(60):
        x, y, a = rng.uniform(-280, -20), rng.uniform(-180, -20), rng.uniform(0, 6.3)
        lines += polyline([(x, y), (x + 4 * math.cos(a), y + 4 * math.sin(a))], 1500, 700)
    return [*lines, *TAIL]


def squares() -> list[str]:
    """Return nested squares at several speeds."""
    lines = list(HEAD)
    for k in range(1, 12):
        a = 3.0 * k
        points = [(-150 - a, -100 - a), (-150 + a, -100 - a), (-150 + a, -100 + a), (-150 - a, -100 + a)]
        lines += polyline([*points, points[0]], 300 * k, 50 * k)
    return [*lines, *TAIL]


def letters() -> list[str]:
    """Return an engraved id: tiny strokes."""
    rng = random.Random(9)
    lines = list(HEAD)
    for k in range(40):
        x, y = -200 + 2 * k, -80
        points = [(x + rng.uniform(0, 1.5), y + rng.uniform(0, 3)) for _ in range(4)]
        lines += polyline(points, 3600, 120)
    return [*lines, *TAIL]


def slow() -> list[str]:
    """Return thick material: slow cuts, divided as the planner divides them."""
    return [*HEAD, *polyline([(-200 + k, -150) for k in range(30)], 120, 900), *TAIL]


def paused() -> list[str]:
    """Return cuts with air and pauses between."""
    lines = ["G21", "G90", "G94", "M8", "M4S0"]
    for k in range(6):
        lines += [*polyline([(-100 + 10 * k, -50), (-100 + 10 * k, -20)], 1200, 500), "G4P0.2"]
    return [*lines, "M5", "M9", "G4P0.01"]


def dense_job(feed: int = 1500) -> list[str]:
    """Return 0.1 mm pieces: as dense as a traced curve gets."""
    points = [(-150 + 30 * math.cos(k / 300), -100 + 30 * math.sin(k / 300)) for k in range(1200)]
    return [*HEAD, *polyline(points, feed, 500), *TAIL]


def timed_jobs() -> dict[str, list[str]]:
    """Return the jobs whose time is estimated: the look-ahead of fifteen moves is what bounds the last one."""
    return {**JOBS, "dense": dense_job(), "hurried": dense_job(6000)}


JOBS: dict[str, list[str]] = {
    "slits": slits(40),
    "zigzag": zigzag(),
    "circles": circles(),
    "spirals": spirals(),
    "wave": wave(),
    "scattered": scattered(),
    "squares": squares(),
    "letters": letters(),
    "slow": slow(),
    "paused": paused(),
}


@dataclass(frozen=True, slots=True)
class Burnt:
    """How a burnt picture differs from its program."""

    worst_mm: float  # from a burnt place to the nearest designed one
    missing_count: int  # designed places with nothing burnt near
    extra_count: int  # burnt places with nothing designed near
    excess_mm: float  # burnt beyond what was designed, per stroke


def burnt_against(name: str, lines: Sequence[str]) -> Burnt:
    """Run a job on the simulated board and compare the beam's trace with the program."""
    rig = Rig()
    laser = rig.laser()
    laser.connect()
    program = read_program(lines)
    assert laser.identity is not None
    run_program(laser, with_lit_ends(lines, Dynamics.of(laser.identity.settings)), Watch())
    strokes = [
        ((a.x_mm, a.y_mm), (b.x_mm, b.y_mm))
        for a, b in itertools.pairwise(rig.trace)
        if a.power_frac > 0 and (a.x_mm, a.y_mm) != (b.x_mm, b.y_mm)
    ]
    return compare([(s.start_mm, s.end_mm) for s in program.steps if s.burns], strokes)


Segment = tuple[tuple[float, float], tuple[float, float]]


def compare(designed: Sequence[Segment], burnt: Sequence[Segment]) -> Burnt:
    """Return how two pictures made of segments differ."""
    from shapely import STRtree
    from shapely.geometry import LineString, Point

    lines, traces = [LineString(s) for s in designed], [LineString(s) for s in burnt]
    tree, other = STRtree(lines), STRtree(traces)
    from_burnt = [point.distance(lines[tree.nearest(point)]) for point in _points(burnt, Point)]
    from_design = [point.distance(traces[other.nearest(point)]) for point in _points(designed, Point)]
    count = 1 + sum(a[1] != b[0] for a, b in itertools.pairwise(designed))
    # The trace's points lie on the lattice of steps, which makes a long curve a little longer than it is.
    excess = (sum(math.dist(*s) for s in burnt) - LATTICE_RATIO * sum(math.dist(*s) for s in designed)) / count
    missing, extra = sum(d > NEAR_MM for d in from_design), sum(d > NEAR_MM for d in from_burnt)
    return Burnt(max([*from_burnt, *from_design]), missing, extra, excess)


def _points(segments: Sequence[Segment], point):  # type: ignore[no-untyped-def]
    for (ax, ay), (bx, by) in segments:
        count = max(int(math.dist((ax, ay), (bx, by)) / (5 * STEP_MM)), 1)
        for k in range(count + 1):
            t = k / count
            yield point(ax + t * (bx - ax), ay + t * (by - ay))
