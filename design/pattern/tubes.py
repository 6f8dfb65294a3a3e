"""Tubes: the flat repeats along x by a period, and so must the cells, so that the joined sheet shows no seam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from design.flatten import Flattening
from design.pattern.tiling import Array, Tiling, tile

SAME_MM = 1e-6  # vertices a period apart are computed twice, by the same sums


def period_mm(flat: Flattening) -> float | None:
    """Return by how much the flat of a tube repeats along x; None where it is no tube."""
    seam = next((seam for seam in flat.seams if seam.closes_tube), None)
    return None if seam is None else abs(seam.translation_mm[0])


def tile_tube(flat: Flattening, edge_mm: float) -> Tiling:
    """Return one period of cells, whole ones only, with `twins` saying which vertices meet when the seam is joined.

    The period must be a whole number of edges. The joint runs straight up, from cell to cell, wherever the surface was
    cut: a vertex on its right side is its twin on the left, moved by the period.
    """
    period = period_mm(flat)
    assert period is not None
    points, faces, _ = flat.unrolled()
    whole = tile(points, faces, edge_mm)
    # A quarter of an edge aside of any centroid, so that rounding decides nothing.
    start = whole.centres_mm()[0, 0] + edge_mm / 4
    start += period * np.floor((float(np.median(flat.flat_mm[:, 0])) - period / 2 - start) / period)
    x = whole.centres_mm()[:, 0]
    tiling = whole.part((x >= start) & (x < start + period)).compact()
    gap, left = cKDTree(tiling.vertices_mm).query(tiling.vertices_mm - [period, 0.0])
    twins = np.where(gap < SAME_MM * edge_mm, left, np.arange(len(tiling.vertices_mm)))
    return replace(tiling, twins=np.asarray(twins, dtype=np.int64))


def seam_gap_mm(tiling: Tiling, period: float) -> float:
    """Return how far joined vertices are from lying a period apart."""
    if tiling.twins is None:
        return 0.0
    right = np.flatnonzero(tiling.twins != np.arange(len(tiling.twins)))
    moved: Array = tiling.vertices_mm[right] - tiling.vertices_mm[tiling.twins[right]]
    return float(np.linalg.norm(moved - [period, 0.0], axis=1).max()) if len(right) else 0.0
