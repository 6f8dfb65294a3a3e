"""Grey values across a line: how much of the light is missing, and where.

Widths come from adding up what is missing, not from finding edges: blur moves light about but loses none, so the sum
holds down to slits narrower than a pixel. That needs light itself, not the camera's code values; hence the sRGB table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fabctl.vision.template import F64, look

ToPixels = Callable[[F64], F64]


@dataclass(frozen=True, slots=True)
class Profiles:
    """Rows of light across a line: `light` (m, k) at `offset_mm` (k,) to the left of the line's direction."""

    offset_mm: F64
    light: F64
    along_mm: F64  # (m,) where on the line


def linear_light(image: NDArray[np.uint8], gamma: str = "srgb") -> F64:
    """Return light, 0 to 1, of a grey picture whose code values are `srgb` (IEC 61966-2-1) or `linear`."""
    code = np.arange(256) / 255
    table = code if gamma == "linear" else np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return np.asarray(table[image], dtype=np.float64)


def across(light: F64, to_pixels: ToPixels, ends_mm: F64, reach_mm: float, step_mm: float, along_mm: F64) -> Profiles:
    """Return the light across the segment `ends_mm` (2, 2) at the places `along_mm` (m,) from its first end."""
    direction = (ends_mm[1] - ends_mm[0]) / np.linalg.norm(ends_mm[1] - ends_mm[0])
    left = np.array([-direction[1], direction[0]])
    offset = np.arange(-reach_mm, reach_mm + step_mm / 2, step_mm)
    points = ends_mm[0] + along_mm[:, None, None] * direction + offset[None, :, None] * left
    values = look(light, to_pixels(points.reshape(-1, 2))).reshape(len(along_mm), len(offset))
    return Profiles(offset, values, along_mm)


def missing(profiles: Profiles, inner_mm: float) -> tuple[F64, F64]:
    """Return the background (m, k), a line through what lies outside ±`inner_mm`, and the light missing from it."""
    outside = np.abs(profiles.offset_mm) > inner_mm
    rows = np.column_stack([np.ones(outside.sum()), profiles.offset_mm[outside]])
    levels = np.linalg.lstsq(rows, profiles.light[:, outside].T, rcond=None)[0]
    background = levels[0][:, None] + levels[1][:, None] * profiles.offset_mm
    return background, np.where(outside, 0.0, background - profiles.light)


def centroid_mm(profiles: Profiles, lacking: F64) -> F64:
    """Return where the missing light lies on average, per row (m,); NaN where none is missing."""
    total = lacking.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((lacking * profiles.offset_mm).sum(axis=1) / np.where(np.abs(total) > 0, total, np.nan))
