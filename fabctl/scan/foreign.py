"""Two libraries behind plain types: open3d, imported only when it is needed, and SciPy's tree of points."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def open3d() -> Any:
    """Return the module; importing it takes two seconds, so nothing does before it must."""
    return importlib.import_module("open3d")


def nearest(tree: cKDTree, points: Floats, reach: float = math.inf) -> tuple[Floats, Ints]:
    """Return distance and index of the tree's point nearest to each of `points`, `(n,)` each.

    Where none is within `reach` the distance is infinite and the index is `tree.n`.
    """
    distance, at = tree.query(points, distance_upper_bound=reach, workers=-1)
    return np.asarray(distance, dtype=np.float64), np.asarray(at, dtype=np.int64)


def spacing_of(tree: cKDTree, points: Floats) -> float:
    """Return the median distance from `points`, some of the tree's own, to their nearest neighbour."""
    distance, _ = tree.query(points, k=2, workers=-1)
    return float(np.median(np.asarray(distance)[:, 1]))
