"""Turn, shift and scale: how a cloud is carried into the target's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Similarity:
    """The map `x -> scale_ratio * rotation @ x + shift`; a negative determinant of `rotation` is a mirror image."""

    rotation: Floats  # (3, 3)
    shift: Floats  # (3,), in the units of the image
    scale_ratio: float = 1.0

    def __call__(self, points: Floats) -> Floats:
        """Return the images of the points, `(n, 3)`."""
        return np.asarray(self.scale_ratio * (points @ self.rotation.T) + self.shift)

    def after(self, first: Similarity) -> Similarity:
        """Return the map that does `first`, then this one."""
        return Similarity(
            self.rotation @ first.rotation, self(first.shift[None])[0], self.scale_ratio * first.scale_ratio
        )

    def inverse(self) -> Similarity:
        """Return the map back."""
        back = self.rotation.T
        return Similarity(back, -(back @ self.shift) / self.scale_ratio, 1.0 / self.scale_ratio)

    def matrix(self) -> list[list[float]]:
        """Return the map as a 4 by 4 matrix, rows first, for records."""
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = self.scale_ratio * self.rotation, self.shift
        return [[float(x) for x in row] for row in found]


IDENTITY = Similarity(np.eye(3), np.zeros(3))


def rotation_of(turn_rad: Floats) -> Floats:
    """Return the rotation by `|turn_rad|` about the direction of `turn_rad`, `(3,)`."""
    angle = float(np.linalg.norm(turn_rad))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = turn_rad / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


def jacobian(places: Floats, directions: Floats) -> Floats:
    """Return how a residual along `directions` at `places` (about the centroid, in diagonals) changes with x."""
    return np.concatenate(
        [np.cross(places, directions), directions, np.sum(places * directions, axis=1)[:, None]], axis=1
    )


def axis_and_angle(rotation: Floats) -> tuple[Floats, float]:
    """Return the unit axis and the angle in radians (0 to pi) of a proper rotation."""
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2)))
    # The symmetric part keeps the axis also at half a turn, where the skew part vanishes.
    values, vectors = np.linalg.eigh((rotation + rotation.T) / 2)
    axis = vectors[:, int(np.argmax(values))]
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return np.asarray(axis if axis @ skew >= 0 else -axis), angle


def best_similarity(source: Floats, image: Floats, *, scale_ratio: float | None = None) -> Similarity:
    """Return the least-squares map from `source` to `image`, `(n, 3)` each, n at least 3.

    Umeyama 1991; with `scale_ratio` given only turn and shift are sought.
    """
    a, b = source.mean(axis=0), image.mean(axis=0)
    u, values, vt = np.linalg.svd((image - b).T @ (source - a))
    handed = np.array([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    rotation = (u * handed) @ vt
    spread = float(((source - a) ** 2).sum())
    scale = float((values * handed).sum()) / spread if scale_ratio is None else scale_ratio
    return Similarity(rotation, b - scale * rotation @ a, scale)


def spread_rotations(count: int) -> Floats:
    """Return `(count, 3, 3)` rotations spread evenly over all, always the same ones.

    Alexa 2022, super-Fibonacci spirals.
    """
    i = np.arange(count) + 0.5
    phi, psi = math.sqrt(2.0), 1.533751168755204288118041
    r, big = np.sqrt(i / count), np.sqrt(1 - i / count)
    alpha, beta = 2 * np.pi * i / phi, 2 * np.pi * i / psi
    x, y, z, w = r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=-1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=-1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=1,
    )
