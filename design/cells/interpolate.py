"""Interpolation over a table whose columns are evenly spaced in θ and, each from its own start, evenly in t.

Cubic through four columns and four rows. Columns are met along lines that follow the lower edge of the map
(t_s = const) or along lines of constant t, whichever finds cells in all four; where neither does, two columns do with a
straight line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import SQRT3
from design.cells.sheet import Sheet

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Grid:
    """Values (f, columns, rows), NaN where there is no cell; row r of column c is at starts_mm[c] + r·step_mm."""

    theta_rad: Array
    starts_mm: Array
    step_mm: float
    values: Array
    edge_mm: float

    def __call__(self, t_mm: Array, theta_rad: Array) -> Array:
        """Return the fields at the points (n,), as (f, n); NaN where cells do not surround the point."""
        result = self._blend(t_mm, theta_rad, 4, True)
        for count, follow in ((4, False), (2, True), (2, False)):
            missing = np.flatnonzero(~np.isfinite(result[0]))
            if not len(missing):
                break
            result[:, missing] = self._blend(t_mm[missing], theta_rad[missing], count, follow)
        return result

    def _blend(self, t_mm: Array, theta_rad: Array, count: int, follow: bool) -> Array:
        first, weights = _lagrange((theta_rad - self.theta_rad[0]) / self._spacing, len(self.theta_rad), count)
        low = self._low_mm(theta_rad)
        result = np.zeros((len(self.values), len(t_mm)))
        for k in range(count):
            column = first + k
            t = t_mm + (self._low_mm(self.theta_rad[column]) - low if follow else 0.0)
            # A column of no weight must not spoil the point with its NaN.
            part = self._along(column, t, count) * weights[k]
            result += np.where(np.abs(weights[k]) < 1e-12, 0.0, part)
        result[:, (theta_rad < self.theta_rad[0] - 1e-12) | (theta_rad > self.theta_rad[-1] + 1e-12)] = np.nan
        return result

    @property
    def _spacing(self) -> float:
        return float(self.theta_rad[1] - self.theta_rad[0])

    def _low_mm(self, theta_rad: Array) -> Array:
        """Return t where t_s = 0, also where that is negative."""
        sin, cos = np.sin(theta_rad), np.cos(theta_rad)
        return np.asarray(2 * SQRT3 * self.edge_mm * sin / (3 * SQRT3 * sin - 3 * cos))

    def _along(self, column: Ints, t_mm: Array, count: int) -> Array:
        """Return the fields at t within each point's column, by as many rows as there are columns."""
        rows = self.values.shape[2]
        place = (t_mm - self.starts_mm[column]) / self.step_mm
        first, weights = _lagrange(place, rows, count)
        result = np.zeros((len(self.values), len(t_mm)))
        for k in range(count):
            part = self.values[:, column, first + k] * weights[k]
            result += np.where(np.abs(weights[k]) < 1e-12, 0.0, part)
        if count == 4:  # at the rim of the map four rows do not exist on both sides: take two
            rim = ~np.isfinite(result[0])
            if rim.any():
                result[:, rim] = self._along(column[rim], t_mm[rim], 2)
        result[:, (place < -1e-9) | (place > rows - 1 + 1e-9)] = np.nan
        return result


def _lagrange(place: Array, size: int, count: int) -> tuple[Ints, Array]:
    """Return the first of `count` nodes around `place` and their weights (count, n); nodes are 0, 1, …, size − 1."""
    first = np.clip(np.floor(place + 1e-9).astype(int) - (count // 2 - 1), 0, size - count)
    x = place - first
    weights = np.ones((count, len(place)))
    for k in range(count):
        for j in range(count):
            if j != k:
                weights[k] *= (x - j) / (k - j)
    return first, weights


def grid_of(t_mm: Array, theta_rad: Array, values: Array, sheet: Sheet) -> Grid:
    """Return the grid of a table in order of θ, then t; `values` is (f, n)."""
    thetas, begin, counts = np.unique(theta_rad, return_index=True, return_counts=True)
    steps = np.diff(t_mm)[np.diff(theta_rad) == 0]
    step = float(np.median(steps))
    dense = np.full((len(values), len(thetas), int(counts.max())), np.nan)
    for c, (b, n) in enumerate(zip(begin, counts, strict=True)):
        dense[:, c, :n] = values[:, b : b + n]
    return Grid(thetas, t_mm[begin], step, dense, sheet.edge_mm)
