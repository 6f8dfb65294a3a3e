"""Many alignments at once: nearest neighbours from a grid, and robust steps in both directions, compiled.

The grid holds for every cell the nearest sample; from there a walk over the neighbour graph finds the nearest one in
almost all cases. That makes a look-up cost some ten nanoseconds, and hundreds of starts affordable.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

NEIGHBOURS = 8
STILL = 3e-4  # a step smaller than this (rad, diagonals) ends a pose's round


@dataclass(frozen=True, slots=True)
class NearestGrid:
    """Samples with a table of who is nearest where; a point outside the box asks its nearest cell."""

    points: Floats  # (n, 3)
    cells: Ints  # (g, g, g), index of the sample nearest to the cell's centre
    low: Floats  # (3,)
    cell_frac: float
    near: Ints  # (n, NEIGHBOURS), the neighbours of each sample


def nearest_grid(points: Floats, cells_per_side: int = 40, margin_ratio: float = 0.25) -> NearestGrid:
    """Return the table for samples `(n, 3)`, n > NEIGHBOURS; its cube reaches `margin_ratio` past their box."""
    tree = cKDTree(points)
    low, high = points.min(axis=0), points.max(axis=0)
    side = float((high - low).max()) * (1 + 2 * margin_ratio)
    corner = (low + high) / 2 - side / 2
    ticks = (np.arange(cells_per_side) + 0.5) * side / cells_per_side
    centres = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3) + corner
    _, cells = tree.query(centres, workers=-1)
    _, found = tree.query(points, k=NEIGHBOURS + 1, workers=-1)
    near = np.asarray(found)
    shape = (cells_per_side,) * 3
    return NearestGrid(
        points,
        np.asarray(cells).astype(np.int32).reshape(shape),
        corner,
        side / cells_per_side,
        np.ascontiguousarray(near[:, 1:].astype(np.int32)),
    )


@njit(cache=True, fastmath=True)
def _farthest(points, count):  # type: ignore[no-untyped-def]  # compiled
    chosen = np.empty(count, np.int64)
    distance = np.full(len(points), np.inf)
    at = 0
    for m in range(count):
        chosen[m] = at
        x, y, z = points[at]
        far = -1.0
        for i in range(len(points)):
            d2 = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if d2 < distance[i]:
                distance[i] = d2
            if distance[i] > far:
                far, at = distance[i], i
    return chosen


def farthest_order(points: Floats, count: int) -> NDArray[np.int64]:
    """Return indices of up to `count` points, each the farthest from those before it; starts with the first point.

    So any leading part of them is spread evenly too.
    """
    return np.asarray(_farthest(np.ascontiguousarray(points), min(count, len(points))))


@njit(cache=True, fastmath=True)
def _nearest(  # type: ignore[no-untyped-def]  # compiled
    points, cells, low, cell_frac, near, x, y, z
):
    g = cells.shape[0]
    i = min(max(int((x - low[0]) / cell_frac), 0), g - 1)
    j = min(max(int((y - low[1]) / cell_frac), 0), g - 1)
    k = min(max(int((z - low[2]) / cell_frac), 0), g - 1)
    best = cells[i, j, k]
    least = (points[best, 0] - x) ** 2 + (points[best, 1] - y) ** 2 + (points[best, 2] - z) ** 2
    for _ in range(4):
        start = best
        for m in range(near.shape[1]):
            other = near[start, m]
            d2 = (points[other, 0] - x) ** 2 + (points[other, 1] - y) ** 2 + (points[other, 2] - z) ** 2
            if d2 < least:
                least, best = d2, other
        if best == start:
            break
    return best, least


@njit(cache=True, fastmath=True)
def _add(  # type: ignore[no-untyped-def]  # compiled
    A, b, q, n, e, w_plane, w_point
):
    """Add one correspondence to the normal equations; unknowns are turn, shift and log scale."""
    J = np.empty(7)
    J[0] = q[1] * n[2] - q[2] * n[1]
    J[1] = q[2] * n[0] - q[0] * n[2]
    J[2] = q[0] * n[1] - q[1] * n[0]
    J[3], J[4], J[5] = n[0], n[1], n[2]
    J[6] = q[0] * n[0] + q[1] * n[1] + q[2] * n[2]
    r = n[0] * e[0] + n[1] * e[1] + n[2] * e[2]
    for i in range(7):
        for j in range(i, 7):
            A[i, j] += w_plane * J[i] * J[j]
        b[i] -= w_plane * J[i] * r
    qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    for i in range(3):
        for j in range(i, 3):
            A[i, j] += w_point * ((qq if i == j else 0.0) - q[i] * q[j])
        A[i + 3, i + 3] += w_point
        A[i + 3, 6] += w_point * q[i]
        b[i + 3] -= w_point * e[i]
    A[0, 4] -= w_point * q[2]
    A[0, 5] += w_point * q[1]
    A[1, 3] += w_point * q[2]
    A[1, 5] -= w_point * q[0]
    A[2, 3] -= w_point * q[1]
    A[2, 4] += w_point * q[0]
    A[6, 6] += w_point * qq
    b[0] -= w_point * (q[1] * e[2] - q[2] * e[1])
    b[1] -= w_point * (q[2] * e[0] - q[0] * e[2])
    b[2] -= w_point * (q[0] * e[1] - q[1] * e[0])
    b[6] -= w_point * (q[0] * e[0] + q[1] * e[1] + q[2] * e[2])


@njit(cache=True)
def _turn(w):  # type: ignore[no-untyped-def]  # compiled
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    R = np.eye(3)
    if angle < 1e-12:
        return R
    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -w[2], w[1], -w[0]
    K[1, 0], K[2, 0], K[2, 1] = w[2], -w[1], w[0]
    return R + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * (K @ K)


@njit(cache=True, fastmath=True)
def _place(R, t, s, p, q):  # type: ignore[no-untyped-def]  # compiled
    for k in range(3):
        q[k] = s * (R[k, 0] * p[0] + R[k, 1] * p[1] + R[k, 2] * p[2]) + t[k]


@njit(cache=True, fastmath=True)
def _pair(  # type: ignore[no-untyped-def]  # compiled
    R, t, s, cloud, target, t_pts, t_cells, t_low, t_cell, t_near, c_pts, c_cells, c_low, c_cell, c_near,
    at_target, d2_cloud, at_cloud, d2_target,
):  # fmt: skip
    """Find the nearest sample both ways; squared distances in the target's units."""
    q, e = np.empty(3), np.empty(3)
    for i in range(len(cloud)):
        _place(R, t, s, cloud[i], q)
        at_target[i], d2_cloud[i] = _nearest(t_pts, t_cells, t_low, t_cell, t_near, q[0], q[1], q[2])
    for i in range(len(target)):
        for k in range(3):
            e[k] = target[i, k] - t[k]
        for k in range(3):
            q[k] = (R[0, k] * e[0] + R[1, k] * e[1] + R[2, k] * e[2]) / s
        at_cloud[i], d2_target[i] = _nearest(c_pts, c_cells, c_low, c_cell, c_near, q[0], q[1], q[2])
        d2_target[i] *= s * s


@njit(cache=True, fastmath=True)
def _solve(A, b, free_scale):  # type: ignore[no-untyped-def]  # compiled
    for i in range(7):
        if not free_scale:
            A[i, 6] = 0.0
        for j in range(i):
            A[i, j] = A[j, i]
        A[i, i] += 1e-6
    if not free_scale:
        A[6, 6] = 1.0
        b[6] = 0.0
    x = np.linalg.solve(A, b)
    turn = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    if turn > 0.5:
        x *= 0.5 / turn
    x[6] = min(max(x[6], -0.15), 0.15)
    return x


@njit(cache=True, fastmath=True)
def _held_rms(d2, cut):  # type: ignore[no-untyped-def]  # compiled
    total = 0.0
    for value in d2:
        total += min(value, cut)
    return np.sqrt(total / len(d2))


@njit(cache=True, nogil=True)
def _align(  # type: ignore[no-untyped-def]  # compiled
    R_all, t_all, s_all, score, cloud, target, t_pts, t_nrm, t_cells, t_low, t_cell, t_near,
    c_pts, c_cells, c_low, c_cell, c_near, keep_cloud, keep_target, steps, free_scale, point_start, point_end,
):  # fmt: skip
    """Improve every pose in place; the loop is plain, so that threads can take parts of the list."""
    nc, nt = len(cloud), len(target)
    d2c, d2t = np.empty(nc), np.empty(nt)
    ic, it = np.empty(nc, np.int64), np.empty(nt, np.int64)
    last_c, last_t = int(keep_cloud * (nc - 1)), int(keep_target * (nt - 1))
    q = np.empty(3)
    for a in range(len(s_all)):
        R, t, s = R_all[a].copy(), t_all[a].copy(), s_all[a]
        still = False
        for step in range(steps + 1):
            _pair(R, t, s, cloud, target, t_pts, t_cells, t_low, t_cell, t_near,
                  c_pts, c_cells, c_low, c_cell, c_near, ic, d2c, it, d2t)  # fmt: skip
            cut_c, cut_t = np.partition(d2c, last_c)[last_c], np.partition(d2t, last_t)[last_t]
            if step == steps or still:
                score[a, 0], score[a, 1] = _held_rms(d2c, cut_c), _held_rms(d2t, cut_t)
                break
            A, b = np.zeros((7, 7)), np.zeros(7)
            w_point = point_start + (point_end - point_start) * step / max(steps - 1, 1)
            for i in range(nc):
                if d2c[i] <= cut_c:
                    _place(R, t, s, cloud[i], q)
                    _add(A, b, q, t_nrm[ic[i]], q - t_pts[ic[i]], 1.0 / nc, w_point / nc)
            for i in range(nt):
                if d2t[i] <= cut_t:
                    _place(R, t, s, c_pts[it[i]], q)
                    _add(A, b, q, t_nrm[i], q - target[i], 1.0 / nt, w_point / nt)
            x = _solve(A, b, free_scale)
            grow = np.exp(x[6])
            Q = _turn(x[:3])
            R = Q @ R
            t = grow * (Q @ t) + x[3:6]
            s *= grow
            still = np.abs(x).max() < STILL
        R_all[a], t_all[a], s_all[a] = R, t, s


@dataclass(frozen=True, slots=True)
class Poses:
    """Candidate maps from cloud to target, both in the units of the search, with how well each fits."""

    rotation: Floats  # (k, 3, 3)
    shift: Floats  # (k, 3)
    scale_ratio: Floats  # (k,)
    cloud_rms: Floats  # (k,), of the cloud's samples to the target, the worst part held at its edge
    target_rms: Floats  # (k,), of the target's samples to the cloud, likewise

    def score(self) -> Floats:
        """Return one number for each pose; less is better."""
        return np.asarray(np.sqrt((self.cloud_rms**2 + self.target_rms**2) / 2))

    def take(self, which: NDArray[np.int64]) -> Poses:
        """Return some of the poses."""
        return Poses(
            self.rotation[which],
            self.shift[which],
            self.scale_ratio[which],
            self.cloud_rms[which],
            self.target_rms[which],
        )


@dataclass(frozen=True, slots=True)
class Effort:
    """How one round of alignment is done: samples asked, parts kept, steps, weight of the point distance."""

    cloud_count: int
    target_count: int
    steps: int
    keep_cloud_frac: float = 0.9
    keep_target_frac: float = 0.65
    point_start_ratio: float = 0.3
    point_end_ratio: float = 0.05


def align(
    start: Poses, cloud: NearestGrid, target: NearestGrid, normals: Floats, effort: Effort, free_scale: bool
) -> Poses:
    """Return the poses after `effort.steps` steps in both directions; samples are the first ones of each grid.

    Residuals in both directions keep the scale from collapsing: a cloud shrunk onto a spot leaves the rest of the
    target far from it.
    """
    R, t, s = start.rotation.copy(), start.shift.copy(), start.scale_ratio.copy()
    score = np.zeros((len(s), 2))
    asked = target.points[: effort.target_count]

    def run(part: slice) -> None:
        _align(
            R[part], t[part], s[part], score[part], cloud.points[: effort.cloud_count], asked,
            target.points, normals, target.cells, target.low, target.cell_frac, target.near,
            cloud.points, cloud.cells, cloud.low, cloud.cell_frac, cloud.near,
            effort.keep_cloud_frac, effort.keep_target_frac, effort.steps, free_scale,
            effort.point_start_ratio, effort.point_end_ratio,
        )  # fmt: skip

    parts = [slice(k, k + 8) for k in range(0, len(s), 8)]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        list(pool.map(run, parts))
    return Poses(R, t, s, score[:, 0], score[:, 1])


def poses(rotation: Floats, shift: Floats, scale_ratio: Floats) -> Poses:
    """Return poses that were not yet judged."""
    blank = np.full(len(scale_ratio), np.inf)
    return Poses(np.ascontiguousarray(rotation), np.ascontiguousarray(shift), scale_ratio, blank, blank)
