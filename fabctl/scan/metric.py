"""Millimetres from outside the cloud: its own pictures with coded marks, or bars picked as pairs of points. **W**"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from fabctl.errors import UsageError
from fabctl.files import text_of
from fabctl.scan.markers import Scale
from fabctl.vision.boards import MarkSheet
from fabctl.vision.scale import Bar, ScanScale, scale_by_bars

BAR_HEADER = ("x1", "y1", "z1", "x2", "y2", "z2", "length_mm")


def scale_from_bars(path: Path) -> Scale:
    """Return the scale of the bars in the file; raise `RefusedError` where they contradict each other."""
    return _as_scale(scale_by_bars(read_bars(path)), with_pose=False)


def scale_from_shots(model: Path, pictures: Path, sheet: MarkSheet) -> Scale:
    """Return scale and first pose from the scan's pictures and their COLMAP text model."""
    from fabctl.vision.colmap import scale_from_pictures

    return _as_scale(scale_from_pictures(model, pictures, sheet), with_pose=True)


def read_bars(path: Path) -> list[Bar]:
    """Return the bars in a CSV file: two points in cloud units and their distance in mm; errors name the line."""
    bars = []
    for number, row in enumerate(csv.reader(text_of(path, "scale bars").splitlines()), start=1):
        if row and tuple(cell.strip() for cell in row) != BAR_HEADER:
            bars.append(_bar(row, f"{path}:{number}"))
    if not bars:
        raise UsageError(f"{path}: no bars; a line is {','.join(BAR_HEADER)}")
    return bars


def _bar(row: list[str], where: str) -> Bar:
    try:
        values = [float(cell) for cell in row]
    except ValueError as fault:
        raise UsageError(f"{where}: not numbers; a line is {','.join(BAR_HEADER)}") from fault
    if len(values) != len(BAR_HEADER) or not all(map(math.isfinite, values)):
        raise UsageError(f"{where}: {len(values)} values; a line is {','.join(BAR_HEADER)}")
    return Bar(np.array(values[:3]), np.array(values[3:6]), values[6])


def _as_scale(found: ScanScale, with_pose: bool) -> Scale:
    rows = tuple(tuple(float(value) for value in row) for row in found.to_mm) if with_pose else None
    sigma = found.uncertainty_ratio / 2 if math.isfinite(found.uncertainty_ratio) else float("nan")
    return Scale(found.mm_per_unit_ratio, sigma, found.used_count, rows, found.findings)
