"""Where a curve has its peak or its valley, finer than its samples. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

VERTEX_MM = (1.5, 2.0, 2.5, 3.0, 1.0, 0.6)  # half the widths over which an extremum is fitted, in their order
AGREE_SIGMA, MISFIT_SIGMA = 3.0, 4.0  # a wider one must agree with the one before, and be followed by the cubic


def vertex(depth: Reals, force_N: Reals, near: int) -> tuple[float, float]:
    """Return depth and force of the extremum near a sample: where a fitted cubic's slope is nothing, else the sample.

    The widest window that the cubic follows and that agrees with the one before: noise counts with its width^-1.5.
    Narrow ones, where a noise may tilt the cubic by much, only where it follows no other.
    """
    centre = float(depth[near])
    found: Vertex | None = None
    for half_mm in VERTEX_MM:
        wider = _cubic_vertex(depth, force_N, centre, half_mm)
        if wider is None:
            continue
        if found is not None and half_mm < VERTEX_MM[0]:
            break
        if found is not None and abs(wider.depth_mm - found.depth_mm) > AGREE_SIGMA * found.se_mm:
            break
        found = wider
    return (centre, float(force_N[near])) if found is None else (found.depth_mm, found.force_N)


@dataclass(frozen=True, slots=True)
class Vertex:
    """An extremum from a fitted cubic, with the standard error of its depth."""

    depth_mm: float
    force_N: float
    se_mm: float


def _cubic_vertex(depth: Reals, force_N: Reals, centre_mm: float, half_mm: float) -> Vertex | None:
    """Return the extremum of a cubic fitted within `half_mm`, or None where it has none there or does not follow."""
    inside = np.abs(depth - centre_mm) <= half_mm
    count = int(inside.sum())
    if count < 12:
        return None
    x, f = (depth[inside] - centre_mm) / half_mm, force_N[inside]
    design = np.vander(x, 4, increasing=True)
    a, *_ = np.linalg.lstsq(design, f, rcond=None)
    variance = float(np.sum((f - design @ a) ** 2)) / (count - 4)
    quiet = float(np.var(np.diff(f))) / 2
    roots = [float(r.real) for r in np.roots([3 * a[3], 2 * a[2], a[1]]) if abs(r.imag) < 1e-9 and abs(r.real) < 1]
    if not roots or variance > quiet * (1 + MISFIT_SIGMA * np.sqrt(3 / count)) + 1e-18:
        return None
    at = min(roots, key=abs)
    bend = 2 * a[2] + 6 * a[3] * at
    way = np.array([0.0, 1.0, 2 * at, 3 * at**2])
    slope_se = float(np.sqrt(way @ np.linalg.inv(design.T @ design) @ way * variance))
    se_mm = half_mm * slope_se / max(abs(float(bend)), 1e-12)
    return Vertex(centre_mm + half_mm * at, float(np.polynomial.polynomial.polyval(at, a)), se_mm)
