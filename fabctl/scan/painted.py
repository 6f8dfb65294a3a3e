"""Coded marks that lie on the table, found in the colours of the cloud itself, by a picture from straight above."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.clean import Cleaned, Plane
from fabctl.scan.foreign import spacing_of

Floats = NDArray[np.float64]

PIXELS_PER_SPACING = 2.0
MOST_PIXELS = 1600  # along the longer side
SMOOTHED_OVER = 4  # points a pixel takes its grey from
SMALLEST_PX = 14.0
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601


def table_picture(points: Floats, grey: Floats, table: Plane) -> tuple[NDArray[np.uint8], Floats, Floats, float]:
    """Return the table's `points` as seen from above: picture, its upper left corner, its axes (2, 3), and a pixel.

    Corner and pixel are in the cloud's units, in the table's own frame.
    """
    helper = np.eye(3)[int(np.argmin(np.abs(table.normal)))]
    right = np.cross(helper, table.normal)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(table.normal, right)])  # x to the right, y down, seen from the specimen's side
    flat = points @ axes.T
    low, high = np.quantile(flat, 0.002, axis=0), np.quantile(flat, 0.998, axis=0)
    tree = cKDTree(flat)
    pixel = spacing_of(tree, flat[:: max(1, len(flat) // 3000)]) * 2 / PIXELS_PER_SPACING
    pixel = max(pixel, float((high - low).max()) / MOST_PIXELS)
    columns, rows = (np.ceil((high - low) / pixel).astype(int) + 1).tolist()
    x, y = np.meshgrid(low[0] + pixel * np.arange(columns), low[1] + pixel * np.arange(rows))
    asked = np.stack([x.ravel(), y.ravel()], axis=1)
    distance, at = tree.query(asked, k=SMOOTHED_OVER, workers=-1)
    weight = 1.0 / (np.asarray(distance) + 0.3 * pixel)
    shown = (weight * grey[np.asarray(at)]).sum(axis=1) / weight.sum(axis=1)
    shown[np.asarray(distance)[:, 0] > 8 * pixel] = float(np.median(grey))
    return np.clip(shown, 0, 255).astype(np.uint8).reshape(rows, columns), low, axes, pixel


def marks_on_table(points: Floats, colours: NDArray[np.uint8], cleaned: Cleaned) -> Mapping[str, Floats]:
    """Return the coded marks that the cloud's colours show on its table: id as text -> centre in the cloud's units."""
    from fabctl.vision.markers import find_markers

    table = cleaned.table
    if table is None:
        return {}
    on = np.abs(table.height(points)) < max(cleaned.table_top_cu, 4 * table.spread_cu)
    if on.sum() < 1000:
        return {}
    picture, low, axes, pixel = table_picture(points[on], colours[on] @ LUMA, table)
    found = find_markers(picture, upscale=2, smallest_px=SMALLEST_PX)
    return {
        str(mark.id): (low + pixel * np.asarray(mark.centre_px)) @ axes + table.offset_cu * table.normal
        for mark in found
    }
