"""What is cut: polylines in sheet millimetres, each with the layer that says how."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Layer = Literal["engrave", "mark", "hole", "slit", "outline"]
LAYERS: tuple[Layer, ...] = ("engrave", "mark", "hole", "slit", "outline")  # in the order of cutting: inner first


@dataclass(frozen=True, slots=True)
class CutPath:
    """One stroke of the beam; the design folder's `paths.json` holds these before kerf and ordering."""

    layer: Layer
    points_mm: NDArray[np.float64]  # (n, 2), the closing point of a closed path not repeated
    closed: bool = False
    cell: int | None = None  # the cell it belongs to, where there is one
    opens: bool = False  # a half slit, whose last point lies open on a border instead of before a hinge


@dataclass(frozen=True, slots=True)
class LayerPreset:
    """How one layer is cut: power as a fraction of the machine's most, speed, number of passes."""

    power_frac: float
    feed_mm_s: float
    passes_count: int = 1
