"""The target's own symmetries: ways to lay it on itself. A scan cannot tell poses that differ by one of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fabctl.scan.coarse import distinct, search, search_cloud
from fabctl.scan.nearest import poses
from fabctl.scan.similarity import IDENTITY, Similarity, axis_and_angle, jacobian, rotation_of
from fabctl.scan.target import Target

Floats = NDArray[np.float64]

NEAR_FRAC = 0.005  # of the diagonal, rms: inside what a scan and a cut sheet scatter by
PROBES = 1000
SELF_ROTATIONS = 300  # nothing is unseen here: fewer starts find all
POLISH_STEPS = 8
SAME_FRAC = 0.02  # two symmetries nearer than this are one
AXIS_TEST_RAD = (
    0.29,
    0.83,
    1.57,
    2.4,
    3.7,
    5.1,
)  # a surface of revolution bears any turn; these have no common divisor


@dataclass(frozen=True, slots=True)
class Symmetry:
    """One way to lay the target on itself."""

    motion: Similarity  # target -> target, mm
    misfit_frac: float  # rms distance to itself, of the diagonal
    mirror: bool

    def describe(self) -> str:
        """Return the symmetry in words."""
        rotation = self.motion.rotation * (-1.0 if self.mirror else 1.0)
        axis, angle = axis_and_angle(rotation)
        direction = ", ".join(f"{x:+.2f}" for x in axis)
        if self.mirror and abs(angle - math.pi) < 0.02:
            return f"mirror image in the plane across ({direction})"
        kind = "mirror image and turn" if self.mirror else "turn"
        return f"{kind} by {math.degrees(angle):.1f}° about ({direction})"


@dataclass(frozen=True, slots=True)
class Symmetries:
    """All symmetries found: single ones, and the axis where every turn is one."""

    turns: tuple[Symmetry, ...]  # proper ones, without the identity
    axis_point_mm: Floats | None  # a surface of revolution turns about this point and direction
    axis_direction: Floats | None
    axis_misfit_frac: float = 0.0

    @property
    def continuous(self) -> bool:
        """Return whether every turn about one axis is a symmetry."""
        return self.axis_direction is not None

    def spin(self, angle_rad: float) -> Similarity:
        """Return the turn about the axis of a surface of revolution."""
        assert self.axis_point_mm is not None and self.axis_direction is not None
        turn = rotation_of(angle_rad * self.axis_direction)
        return Similarity(turn, self.axis_point_mm - turn @ self.axis_point_mm)

    def still(self, target: Target) -> Floats | None:
        """Return the motion (turn, shift, log scale; see `refine`) that no scan can tell, or None."""
        if self.axis_point_mm is None or self.axis_direction is None:
            return None
        arm = (self.axis_point_mm - target.centre_mm) / target.diagonal_mm
        found = np.concatenate([self.axis_direction, np.cross(arm, self.axis_direction), [0.0]])
        return np.asarray(found / np.linalg.norm(found))

    def describe(self) -> list[str]:
        """Return every symmetry in words, with how exactly it holds."""
        lines = []
        if self.axis_direction is not None:
            axis = ", ".join(f"{round(float(x), 2) + 0.0:.2f}" for x in self.axis_direction)  # no -0.00
            lines.append(f"any turn about ({axis}), to {self.axis_misfit_frac:.3%} of the diagonal")
        lines += [f"{s.describe()}, to {s.misfit_frac:.3%} of the diagonal" for s in self.turns]
        return lines

    def apart_frac(self, one: Similarity, other: Similarity, target: Target) -> float:
        """Return how far two poses are apart, modulo the symmetries: rms over the target, of the diagonal."""
        samples = target.search.grid.points[:400] * target.diagonal_mm + target.centre_mm
        between = other.after(one.inverse())
        return min(self._off(between, g, samples, target) for g in (IDENTITY, *(s.motion for s in self.turns)))

    def _off(self, between: Similarity, symmetry: Similarity, samples: Floats, target: Target) -> float:
        rest = between.after(symmetry.inverse())
        image = rest(samples)
        if self.axis_point_mm is not None and self.axis_direction is not None:
            image = self.spin(-spin_angle(samples, image, self.axis_point_mm, self.axis_direction))(image)
        return float(np.sqrt(((image - samples) ** 2).sum(axis=1).mean())) / target.diagonal_mm


def spin_angle(before: Floats, after: Floats, point: Floats, axis: Floats) -> float:
    """Return the turn about the axis that best carries `before` onto `after`."""
    a, b = before - point, after - point
    a, b = a - np.outer(a @ axis, axis), b - np.outer(b @ axis, axis)
    return math.atan2(float(np.sum(np.cross(a, b) @ axis)), float(np.sum(a * b)))


def find_symmetries(target: Target) -> Symmetries:
    """Return the symmetries of the target to within `NEAR_FRAC` of its diagonal, found by laying it on itself."""
    turns = _self_fits(target, mirror=False)
    axis = _axis_of_revolution(target, turns)
    if axis is None:
        return Symmetries(tuple(turns), None, None)
    found = Symmetries((), *axis)
    return Symmetries(tuple(_off_axis(found, turns, target)), *axis)


def find_mirrors(target: Target, symmetries: Symmetries) -> tuple[Symmetry, ...]:
    """Return the ways to lay the target's mirror image on it; asked only where a scan may be a mirror image."""
    mirrors = _self_fits(target, mirror=True)
    return tuple(_off_axis(symmetries, mirrors, target) if symmetries.continuous else mirrors)


def _off_axis(found: Symmetries, listed: list[Symmetry], target: Target) -> list[Symmetry]:
    """Return those that differ from the identity and from each other by more than a turn about the axis."""
    kept: list[Symmetry] = []
    samples = target.search.grid.points[:400] * target.diagonal_mm + target.centre_mm
    for one in listed:
        known = [k.motion for k in kept] + ([] if one.mirror else [IDENTITY])
        if all(found._off(one.motion, k, samples, target) > SAME_FRAC for k in known):
            kept.append(one)
    return kept


def _self_fits(target: Target, *, mirror: bool) -> list[Symmetry]:
    """Return the distinct ways to lay the target (or its mirror image) on itself, the identity left out."""
    frame = Similarity(np.eye(3), -target.centre_mm / target.diagonal_mm, 1 / target.diagonal_mm)
    cloud = search_cloud(target.search.grid.points, mirrored=mirror)
    found = search(cloud, target.search, 1.0 / cloud.entering.scale_ratio, SELF_ROTATIONS)
    probes, _, _ = target.even_samples(PROBES)
    listed = []
    for k in np.flatnonzero(found.score() < 0.02):
        turn = Similarity(found.rotation[k], found.shift[k], float(found.scale_ratio[k]))
        motion = _polished(frame.inverse().after(turn).after(cloud.entering).after(frame), target, probes)
        misfit = _misfit_frac(motion, target, probes)
        if misfit < NEAR_FRAC:
            listed.append(Symmetry(motion, misfit, mirror))
    if not listed:
        return []
    stacked = poses(
        np.stack([s.motion.rotation for s in listed]),
        np.stack([s.motion.shift for s in listed]),
        np.ones(len(listed)),
    )
    judged = type(stacked)(
        stacked.rotation, stacked.shift, stacked.scale_ratio, *(np.array([s.misfit_frac for s in listed]),) * 2
    )
    kept = distinct(judged, probes[:300], SAME_FRAC * target.diagonal_mm, len(listed))
    samples = probes[:300]
    moved = [float(np.sqrt(((listed[k].motion(samples) - samples) ** 2).sum(axis=1).mean())) for k in kept]
    return [listed[k] for k, d in zip(kept, moved, strict=True) if mirror or d > SAME_FRAC * target.diagonal_mm]


def _polished(motion: Similarity, target: Target, probes: Floats) -> Similarity:
    """Return the motion after exact point-to-plane steps in both directions."""
    size, centre = target.diagonal_mm, target.centre_mm
    for _ in range(POLISH_STEPS):
        rows, rest = [], []
        image = motion(probes)
        found = target.closest(image)
        inner = ~found.on_border
        rows.append(jacobian((image[inner] - centre) / size, found.normals[inner])[:, :6])
        rest.append(np.sum((image - found.points_mm) * found.normals, axis=1)[inner] / size)
        # Border points hold the rest: their whole distance counts.
        edge = image[~inner] - found.points_mm[~inner]
        length = np.linalg.norm(edge, axis=1)
        far = length > 1e-9 * size
        direction = edge[far] / length[far, None]
        rows.append(jacobian((image[~inner][far] - centre) / size, direction)[:, :6])
        rest.append(length[far] / size)
        J, r = np.concatenate(rows), np.concatenate(rest)
        A = J.T @ J
        x = np.linalg.solve(A + 1e-7 * np.trace(A) * np.eye(6), -J.T @ r)
        turn = rotation_of(x[:3])
        motion = Similarity(turn, centre - turn @ centre + x[3:] * size).after(motion)
    return motion


def _misfit_frac(motion: Similarity, target: Target, probes: Floats) -> float:
    """Return the rms distance between the target and its image, both ways, of the diagonal."""
    there, back = motion(probes), motion.inverse()(probes)
    total = sum(float(((p - target.closest(p).points_mm) ** 2).sum(axis=1).mean()) for p in (there, back))
    return math.sqrt(total / 2) / target.diagonal_mm


def _axis_of_revolution(target: Target, turns: list[Symmetry]) -> tuple[Floats, Floats, float] | None:
    """Return point, direction and misfit of the axis about which every turn fits, if there is one."""
    probes, _, _ = target.even_samples(PROBES)
    for direction in _candidate_axes(target, turns):
        trial = Symmetries((), target.centre_mm, direction)
        worst = max(_misfit_frac(trial.spin(angle), target, probes) for angle in AXIS_TEST_RAD)
        if worst < NEAR_FRAC:
            return _best_axis(trial, worst, target, probes)
    return None


def _best_axis(found: Symmetries, worst: float, target: Target, probes: Floats) -> tuple[Floats, Floats, float]:
    """Return point, direction and misfit of the axis that turns fitted in their own right agree on.

    A surface that is round to a tenth of a percent only has its centroid and main directions a little beside its axis.
    """
    assert found.axis_direction is not None
    motions = [_polished(found.spin(angle), target, probes) for angle in AXIS_TEST_RAD]
    axes = [axis_and_angle(m.rotation)[0] for m in motions]
    direction = np.sum([a * np.sign(a @ found.axis_direction) for a in axes], axis=0)
    direction /= np.linalg.norm(direction)
    # The points that no motion moves: (1 - R) p = shift; along the axis p stays that of the centroid.
    still = np.concatenate([np.eye(3) - m.rotation for m in motions] + [direction[None]])
    shifts = np.concatenate([m.shift for m in motions] + [[float(direction @ target.centre_mm)]])
    point = np.linalg.lstsq(still, shifts, rcond=None)[0]
    better = Symmetries((), point, direction)
    misfit = max(_misfit_frac(better.spin(angle), target, probes) for angle in AXIS_TEST_RAD)
    if misfit >= worst:
        assert found.axis_point_mm is not None
        return found.axis_point_mm, found.axis_direction, worst
    return np.asarray(point), np.asarray(direction), misfit


def _candidate_axes(target: Target, turns: list[Symmetry]) -> list[Floats]:
    found: list[Floats] = []
    if len(turns) >= 2:  # a surface of revolution shows as many turns as the search keeps
        found += [axis_and_angle(s.motion.rotation)[0] for s in turns[:4]]
    points = target.search.grid.points
    values, vectors = np.linalg.eigh(np.cov(points.T))
    for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1))):
        if abs(values[i] - values[j]) < 0.03 * values[2]:
            found.insert(0, np.asarray(vectors[:, k]))
    return found
