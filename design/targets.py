"""The project's own target surfaces, as triangle meshes of a chosen edge length; in mm, popping up or outward."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from design.surface import Faces, Points, TriMesh

Height = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def cap(radius_mm: float = 80.0, half_angle_rad: float = math.pi / 3, edge_mm: float = 4.0) -> TriMesh:
    """Return a spherical cap, its apex at +z; a half-angle of 60° is a quarter of the sphere."""
    polar, faces = _rings(max(2, round(radius_mm * half_angle_rad / edge_mm)))
    angle = polar[:, 0] * half_angle_rad
    ring = radius_mm * np.sin(angle)
    top = radius_mm * (np.cos(angle) - math.cos(half_angle_rad))
    return TriMesh(np.column_stack([ring * np.cos(polar[:, 1]), ring * np.sin(polar[:, 1]), top]), faces)


def hemisphere(radius_mm: float = 60.0, edge_mm: float = 4.0) -> TriMesh:
    """Return half a sphere: it asks for a spread of 2, more than the published cells give without cones."""
    return cap(radius_mm, math.pi / 2, edge_mm)


def pierced_cap(
    radius_mm: float = 80.0, half_angle_rad: float = math.pi / 3, edge_mm: float = 4.0, hole_ratio: float = 0.2
) -> TriMesh:
    """Return a spherical cap with a round hole beside its apex, `hole_ratio` of the rim's size in the plane.

    `edge_mm` is the mesh's edge on the rim's far side; towards the hole it grows finer.
    """
    rim = 2 * math.tan(half_angle_rad / 2)
    columns = max(12, round(2 * math.pi * radius_mm * math.sin(half_angle_rad) / edge_mm))
    rows = max(3, round(columns * math.log(1 / hole_ratio) / (2 * math.pi) * 2 / math.sqrt(3)))
    log_radius, angle, faces = _tube(columns, rows)
    z = np.exp(math.log(hole_ratio) * (1 - log_radius)) * np.exp(1j * angle)
    # A Möbius map keeps the rim where it is and moves the hole off the middle.
    plane = (z - 0.3) / (1 - 0.3 * z) * rim
    square = np.abs(plane) ** 2
    points = np.column_stack([plane.real, plane.imag, (4 - square) / 4]) * (4 / (4 + square))[:, None]
    points[:, 2] -= math.cos(half_angle_rad)
    return TriMesh(points * radius_mm, faces[:, ::-1])


def double_bump(radius_mm: float = 75.0, height_mm: float = 38.0, edge_mm: float = 4.0) -> TriMesh:
    """Return two unequal hills on a round sheet, `radius_mm` its radius seen from above."""

    def height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        wide = (0.5 * radius_mm) ** 2
        one = np.exp(-((x - 0.42 * radius_mm) ** 2 + y**2) / wide)
        other = 0.8 * np.exp(-((x + 0.45 * radius_mm) ** 2 + (y - 0.1 * radius_mm) ** 2) / wide)
        return np.asarray(height_mm * (one + other))

    return _field(radius_mm, edge_mm, height)


def saddle(radius_mm: float = 75.0, height_mm: float = 30.0, edge_mm: float = 4.0) -> TriMesh:
    """Return z = h(x² − y²)/r² over a disk."""
    return _field(radius_mm, edge_mm, lambda x, y: height_mm * (x**2 - y**2) / radius_mm**2)


def freeform(radius_mm: float = 80.0, height_mm: float = 26.0, edge_mm: float = 4.0) -> TriMesh:
    """Return a smooth surface of hills and a valley that no symmetry helps to flatten."""

    def height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        p, q = x / radius_mm, y / radius_mm
        waves = np.sin(2.3 * p + 0.4) * np.cos(1.9 * q - 0.3) + 0.5 * np.sin(1.1 * p * q + 2.0 * q)
        return np.asarray(height_mm * (waves + 0.6 * np.exp(-4 * ((p - 0.3) ** 2 + (q + 0.2) ** 2))))

    return _field(radius_mm, edge_mm, height)


def spike(radius_mm: float = 70.0, height_mm: float = 110.0, edge_mm: float = 3.0) -> TriMesh:
    """Return a steep round hill that no sheet without cones can become."""
    return _field(radius_mm, edge_mm, lambda x, y: height_mm * np.exp(-6 * (x**2 + y**2) / radius_mm**2))


def cylinder(radius_mm: float = 30.0, height_mm: float = 90.0, edge_mm: float = 4.0) -> TriMesh:
    """Return an open tube around z; it needs one seam and no expansion at all."""
    return revolve(lambda part: np.full_like(part, radius_mm), height_mm, radius_mm, edge_mm)


def vase(radius_mm: float = 30.0, height_mm: float = 100.0, edge_mm: float = 4.0) -> TriMesh:
    """Return a whole vase, open above and below: foot, belly, neck and a flared lip; it needs one seam."""

    def profile(part: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(radius_mm * (1 + 0.16 * np.sin(2 * math.pi * part - 0.5) + 0.06 * part**3))

    return revolve(profile, height_mm, radius_mm, edge_mm)


def revolve(
    profile: Callable[[NDArray[np.float64]], NDArray[np.float64]], height_mm: float, radius_mm: float, edge_mm: float
) -> TriMesh:
    """Return the surface that `profile` (height from 0 to 1 → radius in mm) sweeps around z, faces looking out."""
    columns = max(12, round(2 * math.pi * radius_mm / edge_mm))
    rows = max(2, round(height_mm / (edge_mm * math.sqrt(3) / 2)))
    part, angle, faces = _tube(columns, rows)
    ring = profile(part)
    return TriMesh(np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height_mm * part]), faces)


TARGETS: dict[str, Callable[..., TriMesh]] = {
    "cap": cap,
    "hemisphere": hemisphere,
    "pierced-cap": pierced_cap,
    "double-bump": double_bump,
    "saddle": saddle,
    "freeform": freeform,
    "spike": spike,
    "cylinder": cylinder,
    "vase": vase,
}


def _field(radius_mm: float, edge_mm: float, height: Height) -> TriMesh:
    """Return the surface over a disk, its lowest point at z = 0."""
    polar, faces = _rings(max(2, round(radius_mm / edge_mm)))
    x, y = radius_mm * polar[:, 0] * np.cos(polar[:, 1]), radius_mm * polar[:, 0] * np.sin(polar[:, 1])
    z = height(x, y)
    return TriMesh(np.column_stack([x, y, z - z.min()]), faces)


def _rings(count: int) -> tuple[Points, Faces]:
    """Return a disk of `count` rings, ring k of 6k points: `(radius 0 to 1, angle)` per point, and the faces."""
    polar = [(0.0, 0.0)]
    faces: list[tuple[int, int, int]] = []
    for ring in range(1, count + 1):
        start, inner = len(polar), len(polar) - 6 * (ring - 1) if ring > 1 else 0
        polar += [(ring / count, 2 * math.pi * k / (6 * ring)) for k in range(6 * ring)]
        for k in range(6 * ring):
            side, step = divmod(k, ring)
            # The inner ring has one point less on each of the six sides.
            below = [inner + (side * (ring - 1) + step + d) % max(1, 6 * (ring - 1)) for d in (-1, 0)]
            here, then = start + k, start + (k + 1) % (6 * ring)
            faces.append((here, then, below[1]))
            if step > 0:
                faces.append((here, below[1], below[0]))
    return np.array(polar), np.array(faces, dtype=np.int64)


def _tube(columns: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.float64], Faces]:
    """Return a tube of staggered rows: `(part of the height, angle)` per point, and faces that look outward."""
    row, column = np.divmod(np.arange((rows + 1) * columns), columns)
    angle = 2 * math.pi * (column + 0.5 * (row % 2)) / columns
    r, k = np.divmod(np.arange(rows * columns), columns)
    here, right = r * columns + k, r * columns + (k + 1) % columns
    above, above_right = here + columns, right + columns
    even = (r % 2 == 0)[:, None]
    low = np.where(even, np.column_stack([here, right, above]), np.column_stack([here, right, above_right]))
    high = np.where(even, np.column_stack([right, above_right, above]), np.column_stack([here, above_right, above]))
    return row / rows, angle, np.vstack([low, high]).astype(np.int64)
