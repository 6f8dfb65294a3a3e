"""A triangle mesh in space, and what speaks against using it as a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Faces = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TriMesh:
    """Triangles over points; counter-clockwise seen from the side the surface pops towards."""

    vertices_mm: Points  # (n, 3)
    faces: Faces  # (m, 3)

    def diagonal_mm(self) -> float:
        """Return the length of the bounding box's diagonal, the yardstick of every relative deviation."""
        return float(np.linalg.norm(np.ptp(self.vertices_mm, axis=0)))

    def face_areas_mm2(self) -> NDArray[np.float64]:
        """Return the area of every face, `(m,)`."""
        a, b, c = (self.vertices_mm[self.faces[:, k]] for k in range(3))
        return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
