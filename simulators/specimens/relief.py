"""How deep the deployed surface lies under the sphere at other places than the apex, and how it leans there.

From the two files of the slot: the mesh of `deployed.ply`, and of `response.csv` the indenter's radius, the point of
first contact and the direction of pressing. The response itself is known at that one point only. Elsewhere the
surface answers along its own normal as it does there, the geometry being the true one: with the normal leaning by α, a
frictionless sphere pressed down by d goes d cos α into the surface and is pushed up by F cos α.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.specimens.curve import Place

Reals = NDArray[np.float64]

SPACING_MM = 0.5  # of the points that stand for a triangle: the sphere then sits at most 4 µm too deep at 8 mm radius


class ReliefError(Exception):
    """The slot's mesh or the first line of its response cannot be read."""


@dataclass(frozen=True)
class Relief:
    """The surface as triangles `(n, 3, 3)`: across, across, down; from the point of first contact."""

    triangles_mm: Reals
    radius_mm: float

    def at(self, x_mm: float, y_mm: float) -> Place | None:
        """Return where a sphere over (x, y) meets the surface, or None where it would pass beside it."""
        if x_mm == y_mm == 0.0:
            return Place(0.0, 1.0)
        here, apex = self._touched(x_mm, y_mm), self._touched(0.0, 0.0)
        if here is None:
            return None
        return Place(here.drop_mm - (apex.drop_mm if apex else 0.0), here.lean_ratio)

    def _touched(self, x_mm: float, y_mm: float) -> Place | None:
        at = np.array([x_mm, y_mm])
        low, high = self.triangles_mm[:, :, :2].min(axis=1), self.triangles_mm[:, :, :2].max(axis=1)
        close = ((low - self.radius_mm < at) & (at < high + self.radius_mm)).all(axis=1)
        if not close.any():
            return None
        points = _filled(self.triangles_mm[close])
        away = np.linalg.norm(points[:, :2] - at, axis=1)
        near = away < self.radius_mm
        if not near.any():
            return None
        rise = np.sqrt(self.radius_mm**2 - away[near] ** 2)  # of the sphere's centre above the point it touches
        down = points[near, 2] + self.radius_mm - rise
        first = int(np.argmin(down))
        return Place(float(down[first]), float(rise[first] / self.radius_mm))


def read_relief(mesh: Path, response: Path) -> Relief:
    """Return the relief that a slot's two files describe."""
    try:
        vertices, faces = _read_ply(mesh)
        facts = _facts(response)
        radius = float(facts["indenter_radius_mm"])
        point, down = (np.array([float(v) for v in facts[name].split(",")]) for name in ("point_mm", "direction"))
        axes = _axes(down)
    except (OSError, KeyError, ValueError, IndexError) as fault:
        raise ReliefError(f"{mesh.name}: no relief: {fault!r}") from fault
    return Relief(((vertices - point) @ axes.T)[faces], radius)


def _facts(response: Path) -> dict[str, str]:
    with response.open(encoding="utf-8") as stream:
        line = stream.readline()
    return dict(part.strip().split("=", 1) for part in line.split(";")[1:] if "=" in part)


def _axes(down: Reals) -> Reals:
    """Return across, across, down as rows; x stays x where the pressing is along z."""
    down = down / np.linalg.norm(down)
    start = np.array([1.0, 0.0, 0.0]) if abs(down[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = start - (start @ down) * down
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(across, down), down])


def _filled(triangles_mm: Reals) -> Reals:
    """Return points all over the triangles."""
    a, b, c = (triangles_mm[:, k] for k in range(3))
    longest = max(float(np.linalg.norm(one - two, axis=1).max()) for one, two in ((a, b), (b, c), (c, a)))
    parts = max(1, int(np.ceil(longest / SPACING_MM)))
    steps = [(i / parts, j / parts) for i in range(parts + 1) for j in range(parts + 1 - i)]
    return np.concatenate([a + u * (b - a) + v * (c - a) for u, v in steps])


def _read_ply(path: Path) -> tuple[Reals, NDArray[np.int64]]:
    """Return vertices and triangles of a binary PLY as a design folder holds it."""
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    head = raw[:end].decode("ascii").split("\n")
    if head[1] != "format binary_little_endian 1.0":
        raise ValueError(head[1])
    count = {line.split()[1]: int(line.split()[2]) for line in head if line.startswith("element ")}
    kinds = {"double": "<f8", "float": "<f4", "uchar": "u1"}
    columns = [
        (line.split()[2], kinds[line.split()[1]])
        for line in head
        if line.startswith(("property double", "property float", "property uchar"))
    ]
    vertices: Any = np.frombuffer(raw, np.dtype(columns), count["vertex"], end)
    faces: Any = np.frombuffer(
        raw, np.dtype([("n", "u1"), ("corners", "<i4", (3,))]), count["face"], end + vertices.nbytes
    )
    if not (faces["n"] == 3).all():
        raise ValueError("faces that are no triangles")
    return np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64), faces["corners"].astype(np.int64)
