"""The fine alignment: a real deviation must not drag the fit and hide itself.

Residuals are averaged over patches of the target first. A patch of a hundred points is ten times less noisy than a
point, so a weight that gives up a patch can be as narrow as a tenth of the noise: what truly deviates is left out
almost whole, and not only what sticks out of the noise. Patches weigh by area, not by how many points they caught.
Pairs on the border say nothing about the surface and are left out; where the border is, is its own set of equations,
with one common offset (a cloud's edge is always a little inside the true one), so that a surface that can slide in
itself (a cap) is held by its rim alone and the rest is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fabctl.scan.foreign import nearest
from fabctl.scan.rim import REACH_FIRST_FRAC, REACH_FRAC, Rest, Rim, rim_rows
from fabctl.scan.similarity import Similarity, jacobian, rotation_of
from fabctl.scan.target import Target

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

PATCHES = 800
LEAST_IN_PATCH = 6
TUKEY = 4.685  # 95 % efficient for normal noise
FLOOR_FRAC = 2e-5  # of the diagonal; below it a patch's residual is rounding, not shape
SLID_FRAC = 1e-3  # of the diagonal; a step this small ends the sliding
SLIDING_SIGMA_FRAC = 2e-3  # while sliding, patches hold no tighter than this and the rim pulls with its median
GROW_LIMIT_RATIO = 0.05
UNDONE_RATIO = 0.2  # a step that undoes the one before it up to this part ends the work

Weighting = Literal["robust", "least-squares"]


@dataclass(frozen=True, slots=True)
class Rows:
    """Linear equations `residual + jacobian @ x = 0` with an area weight; x = turn, shift, log scale.

    Turn is in rad about the target's centroid; shift and residual are in diagonals.
    """

    jacobian: Floats  # (k, 7)
    residual: Floats  # (k,)
    area: Floats  # (k,), sums to 1 over the whole target
    spread: Floats  # (k,), standard deviation expected from noise alone


@dataclass(frozen=True, slots=True)
class Fit:
    """A refined pose and what it rests on."""

    pose: Similarity  # cloud as read -> target, mm
    patches: Rows
    rim: Rim | None
    weight: Floats  # of each patch, 0 to 1
    rim_weight: Floats
    patch_sigma_frac: float  # robust spread of patch residuals, of the diagonal
    steps_count: int
    last_step_frac: float  # motion of the last step, of the diagonal


@dataclass(frozen=True, slots=True)
class Options:
    """How to refine: which unknowns are free and what is used."""

    free_scale: bool = True
    weighting: Weighting = "robust"
    use_patches: bool = True
    use_rim: bool = True
    slides: bool = True  # False: the start is a refined pose, its rim is where it should be
    steps_count: int = 25
    still_frac: float = 1e-5  # of the diagonal; a smaller step ends the work
    band_frac: float = 0.05  # of the diagonal; farther points are not compared at first
    free: tuple[bool, bool, bool, bool, bool, bool] = (True,) * 6  # turn and shift about/along the target's axes
    rest: Rest | None = None  # the table, where there is one
    still: Floats | None = None  # (7,), a motion that nothing can tell: the turn of a surface of revolution


def refine(points: Floats, start: Similarity, target: Target, options: Options = Options()) -> Fit:
    """Return the fit of the cloud's `points` (n, 3), as read, from the pose `start`, which must be near."""
    pose, band, reach = start, options.band_frac, REACH_FIRST_FRAC if options.slides else REACH_FRAC
    patch_tree = _patch_tree(target)
    moved, before = np.inf, np.zeros(7)
    steps_count = 0
    while steps_count < options.steps_count:
        steps_count += 1
        rows = patch_rows(points, pose, target, patch_tree, band) if options.use_patches else _no_rows()
        rim = rim_rows(points, pose, target, reach, options.rest) if options.use_rim else None
        sliding = reach > REACH_FRAC
        x, weight, rim_weight, sigma = solve(rows, rim, options, sliding=sliding)
        moved = float(np.linalg.norm(x[:3]) * 0.5 + np.linalg.norm(x[3:6]) + 0.5 * abs(x[6]))
        pose = moved_by(pose, x, target)
        band = max(0.6 * band, 0.02, 12 * sigma)
        if sliding and (moved < SLID_FRAC or steps_count >= options.steps_count // 2):
            reach = REACH_FRAC
        elif moved < options.still_frac or _undone(x, before):
            break
        before = x
    rows = patch_rows(points, pose, target, patch_tree, band) if options.use_patches else _no_rows()
    rim = rim_rows(points, pose, target, REACH_FRAC, options.rest) if options.use_rim else None
    _, weight, rim_weight, sigma = solve(rows, rim, options, sliding=False)
    return Fit(pose, rows, rim, weight, rim_weight, sigma, steps_count, moved)


def _undone(x: Floats, before: Floats) -> bool:
    """Return whether the step undoes the one before it: two sets of pairs take turns, and will for ever."""
    return bool(np.linalg.norm(x + before) < UNDONE_RATIO * np.linalg.norm(x))


def moved_by(pose: Similarity, x: Floats, target: Target) -> Similarity:
    """Return `pose` followed by the small motion `x` (turn, shift, log scale) about the target's centroid."""
    grow = float(np.exp(np.clip(x[6], -GROW_LIMIT_RATIO, GROW_LIMIT_RATIO)))
    turn = rotation_of(x[:3])
    centre = target.centre_mm
    motion = Similarity(turn, centre - grow * turn @ centre + x[3:6] * target.diagonal_mm, grow)
    return motion.after(pose)


def _patch_tree(target: Target) -> cKDTree:
    return cKDTree(target.even_samples(PATCHES)[0])


def _no_rows() -> Rows:
    return Rows(np.zeros((0, 7)), np.zeros(0), np.zeros(0), np.zeros(0))


def patch_rows(points: Floats, pose: Similarity, target: Target, patches: cKDTree, band_frac: float) -> Rows:
    """Return one equation for each patch of the target that enough points fall on.

    Within a patch points far from its median by the noise's measure are given up (floaters, wrong matches).
    """
    placed = pose(points)
    found = target.closest(placed)
    size = target.diagonal_mm
    gap = placed - found.points_mm
    residual = np.sum(gap * found.normals, axis=1) / size
    good = ~found.on_border & (np.abs(residual) < band_frac)
    feet, normals, residual = found.points_mm[good], found.normals[good], residual[good]
    _, patch = nearest(patches, feet)
    middle = patch_medians(residual, patch, patches.n)
    off = residual - middle[patch]
    noise = max(1.4826 * float(np.median(np.abs(off))) if len(off) else 0.0, 1e-9)
    weight = np.clip(1 - (off / (TUKEY * noise)) ** 2, 0, None) ** 2
    total = np.bincount(patch, weight, minlength=patches.n)
    count = np.bincount(patch, minlength=patches.n)
    used = (count >= LEAST_IN_PATCH) & (total > 0.25 * count)
    # At the feet, not at the points: the points' noise would go with the residual's and shrink the scale.
    J = jacobian((feet - target.centre_mm) / size, normals)
    mean = np.stack([np.bincount(patch, weight * J[:, k], minlength=patches.n) for k in range(7)], axis=1)
    mean_residual = np.bincount(patch, weight * residual, minlength=patches.n)
    share = np.full(patches.n, 1.0 / patches.n)
    return Rows(
        mean[used] / total[used, None],
        mean_residual[used] / total[used],
        share[used],
        np.sqrt(noise**2 / total[used] + FLOOR_FRAC**2),
    )


def patch_medians(values: Floats, patch: Ints, count: int) -> Floats:
    """Return the median of the values of each patch; NaN where there are none."""
    order = np.lexsort((values, patch))
    ends = np.searchsorted(patch[order], np.arange(count + 1))
    held = ends[1:] > ends[:-1]
    middle = np.full(count, np.nan)
    middle[held] = values[order][((ends[:-1] + ends[1:] - 1) // 2)[held]]
    return middle


def solve(rows: Rows, rim: Rim | None, options: Options, *, sliding: bool) -> tuple[Floats, Floats, Floats, float]:
    """Return the motion, the weights of patches and of rim stretches, and the patches' robust spread.

    Weights begin with the median fit (1/|r|) and narrow to Tukey's about the spread found, which is re-estimated, so
    that a broad misfit keeps all patches and a local one loses its own.
    """
    weight, rim_weight = np.ones(len(rows.residual)), np.ones(0 if rim is None else len(rim.residual))
    sigma = rim_sigma = 0.0
    x = np.zeros(7)
    rounds = 1 if options.weighting == "least-squares" else 25
    for k in range(rounds + 1):
        x = _least_squares(rows, rim, weight, rim_weight, max(sigma, 1e-6), max(rim_sigma, 1e-4), options)
        r = rows.residual + rows.jacobian @ x[:7]
        sigma = _spread(r) if len(r) else 0.0
        if rim is not None:
            e = rim.residual + rim.jacobian @ x[:7] - x[7:][rim.loop]
            rim_weight, rim_sigma = _rim_weights(e, rim.reach_frac / 8, sliding)
            sigma = max(sigma, SLIDING_SIGMA_FRAC) if sliding else sigma
        if options.weighting == "least-squares" or k == rounds:
            break
        width = np.maximum(sigma, rows.spread)
        narrow = TUKEY * width * (1.5 if k < 15 else 1.0)
        weight = width / np.maximum(np.abs(r), width) if k < 10 else _tukey(r, narrow)
    return x[:7], weight, rim_weight, sigma


def _rim_weights(e: Floats, limit_frac: float, sliding: bool) -> tuple[Floats, float]:
    """Return the weights of the rim's stretches and their spread.

    What sticks out over the border always speaks against the pose; what is missing may just not have been seen.
    """
    if sliding:
        return SLIDING_SIGMA_FRAC / np.maximum(np.abs(e), SLIDING_SIGMA_FRAC), SLIDING_SIGMA_FRAC
    close = np.abs(e) < 3 * limit_frac
    sigma = min(max(_spread(e[close]) if close.sum() > 5 else 1.0, 5e-4), limit_frac)
    return np.where(e > 0, sigma / np.maximum(e, sigma), _tukey(e, 3.0 * sigma)), sigma


def weak_motions(fit: Fit, target: Target, options: Options, limit_frac: float) -> list[Floats]:
    """Return the motions (7,) that the surface itself does not hold to `limit_frac` of the diagonal, each of unit size.

    The size of a motion is its rms displacement of the target. What is weak here is held by the rim alone, if at all.
    Patches share errors with their neighbours, so their information is taken three times less sure than it looks.
    """
    D, H = _displacement(target), _information(fit)
    basis = np.eye(7)[:, [k for k in range(7) if k < 6 or options.free_scale]]
    if options.still is not None:
        kept = basis - np.outer(options.still, options.still @ basis)
        u, values, _ = np.linalg.svd(kept, full_matrices=False)
        basis = u[:, values > 1e-6]
    metric = basis.T @ D.T @ D @ basis
    root = np.linalg.inv(np.linalg.cholesky(metric + 1e-12 * np.eye(len(metric)))).T
    values, vectors = np.linalg.eigh(root.T @ basis.T @ H @ basis @ root)
    return [np.asarray(basis @ root @ vectors[:, k]) for k in np.flatnonzero(values < 1 / limit_frac**2)]


def is_weak(motion: Floats, fit: Fit, target: Target, limit_frac: float) -> bool:
    """Return whether the surface does not hold the motion (7,) to `limit_frac` of the diagonal."""
    moved = float(np.sum((_displacement(target) @ motion) ** 2))
    return float(motion @ _information(fit) @ motion) < moved / limit_frac**2


def _displacement(target: Target) -> Floats:
    """Return what carries a motion (7,) to the displacement of the target, so that its norm is the rms."""
    arms = target.search.grid.points[:400]
    moves = np.stack([np.concatenate([np.cross(np.eye(3)[k], a) for a in arms]) for k in range(3)], axis=1)
    shifts = np.tile(np.eye(3), (len(arms), 1))
    return np.asarray(np.concatenate([moves, shifts, arms.reshape(-1, 1)], axis=1) / np.sqrt(len(arms)))


def _information(fit: Fit) -> Floats:
    sigma = max(fit.patch_sigma_frac, 3e-4)
    return np.asarray((fit.patches.jacobian * fit.weight[:, None]).T @ fit.patches.jacobian / (3 * sigma) ** 2)


def _spread(residual: Floats) -> float:
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))


def _tukey(residual: Floats, width: Floats | float) -> Floats:
    return np.asarray(np.clip(1 - (residual / width) ** 2, 0, None) ** 2)


def _least_squares(
    rows: Rows, rim: Rim | None, weight: Floats, rim_weight: Floats, sigma: float, rim_sigma: float, options: Options
) -> Floats:
    """Return the unknowns: motion, log scale, and the offset of each loop of the rim."""
    w = weight * rows.area * max(len(rows.area), 1) / sigma**2
    n = 7 if rim is None else 7 + len(rim.slack_frac)
    A, b = np.zeros((n, n)), np.zeros(n)
    A[:7, :7] = (rows.jacobian * w[:, None]).T @ rows.jacobian
    b[:7] = -(rows.jacobian * w[:, None]).T @ rows.residual
    if rim is not None:
        J = np.concatenate([rim.jacobian, -np.eye(n - 7)[rim.loop]], axis=1)
        v = rim_weight / rim_sigma**2
        A += (J * v[:, None]).T @ J
        b -= (J * v[:, None]).T @ rim.residual
        A[range(7, n), range(7, n)] += 1 / rim.slack_frac**2
    fixed = [k for k in range(6) if not options.free[k]] + ([] if options.free_scale else [6])
    A[fixed, :], A[:, fixed], b[fixed] = 0.0, 0.0, 0.0
    A[fixed, fixed] = 1.0
    if options.still is not None:
        A[:7, :7] += 1e3 * np.trace(A[:7, :7]) * np.outer(options.still, options.still)
    # What the data do not hold at all (a turn about the axis of a cap) stays where it is.
    A[range(7), range(7)] += 1e-7 * np.trace(A[:7, :7]) + 1.0
    return np.asarray(np.linalg.solve(A, b))
