"""The specimen that lies in the slot: a design's `response.csv`, or masses hung on the load cell."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

from simulators.specimens.curve import Curves

STEP_MM = 0.005
FIRST_LINE = "# fabctl response 1"


class SlotError(Exception):
    """What lies in the slot is not what the simulator can read."""


def read_response(path: Path) -> Curves:
    """Return the curves of a `response.csv` of version 1, resampled to an even fine grid."""
    lines = path.read_text(encoding="utf-8").splitlines()
    if not lines or not lines[0].startswith(FIRST_LINE):
        raise SlotError(f"{path}: the first line is not {FIRST_LINE!r}")
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    try:
        depth = [float(row["depth_mm"]) for row in rows]
        load = [float(row["load_N"]) for row in rows]
        unload = [float(row["unload_N"]) for row in rows]
    except (KeyError, TypeError, ValueError) as fault:
        raise SlotError(f"{path}: not columns depth_mm, load_N, unload_N of numbers: {fault}") from fault
    if len(depth) < 2 or any(b <= a for a, b in itertools.pairwise(depth)):
        raise SlotError(f"{path}: depth_mm does not increase")
    zero, count = depth[0], round((depth[-1] - depth[0]) / STEP_MM) + 1
    grid = [zero + k * STEP_MM for k in range(max(count, 2))]
    # A deployed sheet carries a little prestress in its model; at first contact the force is zero by definition.
    return Curves(
        STEP_MM,
        [force - load[0] for force in _resampled(grid, depth, load)],
        [force - load[0] for force in _resampled(grid, depth, unload)],
    )


def read_mass_kg(path: Path) -> float:
    """Return the mass hung on the load cell: a file with one number, in kilograms."""
    return float(path.read_text(encoding="utf-8").strip())


def _resampled(grid: list[float], at: list[float], values: list[float]) -> list[float]:
    found, k = [], 0
    for place in grid:
        while k < len(at) - 2 and at[k + 1] < place:
            k += 1
        part = (place - at[k]) / (at[k + 1] - at[k])
        found.append(values[k] + (values[k + 1] - values[k]) * part)
    return found
