"""From the laser's burn trace to what the sheet looks like: fluence of a Gaussian beam, charred below, open above.

A straight stroke with a line energy e (share of full power over speed, s/mm) lays down e times a Gaussian across it.
Where the sum over all strokes passes the material's threshold the sheet is open; below, it is charred the more the
closer it came. So the kerf follows from power, speed, passes and the beam's radius across the stroke.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from simulators.camera.scene import Beam, Pose, Sheet

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
PIECE_MM = 1.0
REACH_RADII = 2.6
BATCH = 256
JUMP_MM = 1e-9


def read_trace(path: Path) -> F64:
    """Return the burn trace (n, 4): t_s, x_mm, y_mm, power_frac; whole rows only, since the laser may be writing."""
    rows = []
    with path.open(newline="", encoding="utf-8") as stream:
        for row in csv.reader(stream):
            try:
                values = [float(cell) for cell in row[:4]]
            except ValueError:
                continue  # the header, or a row half written
            if len(values) == 4:
                rows.append(values)
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def strokes(trace: F64) -> F64:
    """Return (n, 6): x0, y0, x1, y1 in mm, line energy in s/mm, time in s, of every step with the beam on.

    The power in a row is that of the way from it. Steps in one line at one energy are joined.
    """
    step = np.diff(trace, axis=0)
    length = np.hypot(step[:, 1], step[:, 2])
    on = (trace[:-1, 3] > 0) & (length > JUMP_MM) & (step[:, 0] > 0)
    energy = trace[:-1, 3][on] * step[on, 0] / length[on]
    raw = np.column_stack([trace[:-1, 1:3][on], trace[1:, 1:3][on], energy, trace[1:, 0][on]])
    joined: list[F64] = []
    for row in raw:
        if joined and _continues(joined[-1], row):
            joined[-1][2:4] = row[2:4]
        else:
            joined.append(row.copy())
    return np.array(joined).reshape(-1, 6)


def _continues(first: F64, second: F64) -> bool:
    if np.hypot(*(second[:2] - first[2:4])) > 1e-6 or abs(second[4] - first[4]) > 0.02 * first[4]:
        return False
    a, b = first[2:4] - first[:2], second[2:4] - second[:2]
    return bool(abs(a[0] * b[1] - a[1] * b[0]) < 1e-6 * np.hypot(*a) * np.hypot(*b) and a @ b > 0)


def to_sheet(points_mm: F64, pose: Pose, size_mm: tuple[float, float]) -> F64:
    """Return machine points (n, 2) in the frame of a sheet lying as `pose`."""
    c, s = math.cos(pose.turn_rad), math.sin(pose.turn_rad)
    back = (points_mm - np.array([pose.x_mm, pose.y_mm])) @ np.array([[c, -s], [s, c]])
    back = back / np.array([pose.stretch_x_ratio, pose.stretch_y_ratio])
    return np.column_stack([size_mm[0] - back[:, 0], back[:, 1]]) if pose.upside_down else back


def to_machine(points_mm: F64, pose: Pose, size_mm: tuple[float, float]) -> F64:
    """Return points (n, 2) of the sheet's frame in machine millimetres."""
    if pose.upside_down:
        points_mm = np.column_stack([size_mm[0] - points_mm[:, 0], points_mm[:, 1]])
    c, s = math.cos(pose.turn_rad), math.sin(pose.turn_rad)
    stretched = points_mm * np.array([pose.stretch_x_ratio, pose.stretch_y_ratio])
    return np.asarray(stretched @ np.array([[c, s], [-s, c]]) + np.array([pose.x_mm, pose.y_mm]))


def on_sheet(found: F64, sheet: Sheet) -> F64:
    """Return the strokes in the sheet's frame, each by the pose the sheet had when it was burned."""
    moved = found.copy()
    starts = np.array([pose.from_s for pose in sheet.poses])
    which = np.maximum(np.searchsorted(starts, found[:, 5], side="right") - 1, 0)
    for k, pose in enumerate(sheet.poses):
        mine = which == k
        for columns in (slice(0, 2), slice(2, 4)):
            moved[mine, columns] = to_sheet(found[mine, columns], pose, sheet.size_mm)
    return moved


def kerf_mm(energy_s_mm: float, direction_rad: float, beam: Beam) -> float:
    """Return the true width of a single straight cut, 0 where it does not come through."""
    across = _radius(np.array([math.cos(direction_rad), math.sin(direction_rad)]), beam)
    reference = math.sqrt(beam.radius_x_mm * beam.radius_y_mm)
    excess = energy_s_mm / beam.through_s_mm * reference / across
    return 2 * across * math.sqrt(math.log(excess) / 2) if excess > 1 else 0.0


def _radius(direction: F64, beam: Beam) -> float:
    return math.hypot(direction[1] * beam.radius_x_mm, direction[0] * beam.radius_y_mm)


def fluence(found: F64, size_mm: tuple[float, float], texel_mm: float, beam: Beam) -> F32:
    """Return the fluence over the threshold, (rows, columns) of texels, row 0 at the sheet's upper edge."""
    shape = (math.ceil(size_mm[1] / texel_mm), math.ceil(size_mm[0] / texel_mm))
    top_mm = shape[0] * texel_mm
    total = np.zeros(shape[0] * shape[1], dtype=np.float32)
    pieces = _pieces(found)
    reach_mm = PIECE_MM / 2 + REACH_RADII * max(beam.radius_x_mm, beam.radius_y_mm)
    half = math.ceil(reach_mm / texel_mm)
    offset = np.arange(-half, half + 1)
    reference = math.sqrt(beam.radius_x_mm * beam.radius_y_mm)
    for start in range(0, len(pieces), BATCH):
        a, b, energy = (
            pieces[start : start + BATCH, :2],
            pieces[start : start + BATCH, 2:4],
            pieces[start : start + BATCH, 4],
        )
        middle = (a + b) / 2
        column = np.floor(middle[:, 0] / texel_mm).astype(int)[:, None, None] + offset[None, None, :]
        row = np.floor((top_mm - middle[:, 1]) / texel_mm).astype(int)[:, None, None] + offset[None, :, None]
        x = (column + 0.5) * texel_mm - middle[:, 0, None, None]
        y = top_mm - (row + 0.5) * texel_mm - middle[:, 1, None, None]
        length = np.linalg.norm(b - a, axis=1)
        u = (b - a) / length[:, None]
        r = np.hypot(u[:, 1] * beam.radius_x_mm, u[:, 0] * beam.radius_y_mm)[:, None, None]
        along = x * u[:, 0, None, None] + y * u[:, 1, None, None]
        across = y * u[:, 0, None, None] - x * u[:, 1, None, None]
        ends = [erf(math.sqrt(2) * (along + sign * length[:, None, None] / 2) / r) for sign in (1, -1)]
        value = (energy / beam.through_s_mm)[:, None, None] * reference / r * np.exp(-2 * (across / r) ** 2)
        value = value * (ends[0] - ends[1]) / 2
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        np.add.at(total, (row * shape[1] + column)[inside], value[inside].astype(np.float32))
    return total.reshape(shape)


def _pieces(found: F64) -> F64:
    """Return the strokes split so that none is longer than PIECE_MM."""
    parts: list[F64] = []
    for x0, y0, x1, y1, energy, _ in found:
        count = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / PIECE_MM))
        t = np.linspace(0, 1, count + 1)
        x, y = x0 + (x1 - x0) * t, y0 + (y1 - y0) * t
        parts.append(np.column_stack([x[:-1], y[:-1], x[1:], y[1:], np.full(count, energy)]))
    return np.vstack(parts) if parts else np.empty((0, 5))


def _fallen(solid: NDArray[np.bool_], most_texels: float) -> NDArray[np.bool_]:
    """Return the pieces cut loose that are small enough to fall through the bed."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid.astype(np.uint8), connectivity=4)
    falls = stats[:count, cv2.CC_STAT_AREA] < most_texels
    falls[0] = False  # what is open already
    return np.asarray(falls[labels], dtype=bool)


def burned(grey: F32, share: F32, sheet: Sheet, texel_mm: float) -> F32:
    """Return the sheet's grey values after burning; `share` is fluence over threshold.

    How much of a texel is open follows from the logarithm of the fluence and its slope, so edges lie between texels.
    """
    beam = sheet.beam
    charred = grey * (1 - beam.char_frac * (1 - np.exp(-share / beam.char_at_ratio)))
    level = np.log(np.maximum(share, 1e-6))
    slope = np.hypot(*np.gradient(level))
    open_share = np.clip(0.5 + level / np.maximum(slope, 1e-3), 0, 1)
    open_share[share < 0.2] = 0
    open_share[_fallen(open_share < 0.5, sheet.drop_mm2 / texel_mm**2)] = 1
    return np.asarray(charred * (1 - open_share) + sheet.open_frac * open_share, dtype=np.float32)


def kerf_table(energies_s_mm: Sequence[float], directions_rad: Sequence[float], beam: Beam) -> list[list[float]]:
    """Return the true kerfs, one row per direction."""
    return [[kerf_mm(e, d, beam) for e in energies_s_mm] for d in directions_rad]
