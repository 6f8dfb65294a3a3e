"""What is asked of a flattening, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from design.surface import Faces, Indices, Points, TriMesh

Boundary = Literal["isometric", "prescribed", "optimised"]
Laplacian = Literal["cotangent", "delaunay"]


@dataclass(frozen=True, slots=True)
class FlattenOptions:
    """How the surface is to be laid flat.

    `boundary`: `isometric` keeps the rim's length (u = 0, the published way), `prescribed` takes `boundary_u`,
    `optimised` chooses the rim so that the spread of expansions is least.
    """

    boundary: Boundary = "isometric"
    boundary_u: NDArray[np.float64] | None = None  # (n,) over the mesh's vertices, read on the boundary only
    laplacian: Laplacian = "cotangent"


@dataclass(frozen=True, slots=True)
class Seam:
    """Two chains of flat points that are one line on the target.

    `right = turn(left, rotation_rad) + translation_mm`, up to `gap_mm`. A tube's seam does not turn: its sheet repeats
    by `translation_mm`, so that a pattern whose period divides it runs on across the joint.
    """

    left: Indices
    right: Indices
    rotation_rad: float
    translation_mm: tuple[float, float]
    gap_mm: float


@dataclass(frozen=True, slots=True)
class Flattening:
    """A surface and its flat state. Flat points differ from vertices only where a seam doubles them."""

    mesh: TriMesh
    flat_mm: Points  # (n, 2)
    faces: Faces  # (m, 3) into flat points, the k-th lies on the k-th face of `mesh`
    target_index: Indices  # (n,) the vertex of `mesh` under each flat point
    expansion_ratio: NDArray[np.float64]  # (m,) deployed over flat, √(A3D/A2D)
    u: NDArray[np.float64]  # (n,) log of flat over deployed length, as the Yamabe equation gave it
    seams: tuple[Seam, ...] = ()
    findings: tuple[Finding, ...] = ()

    def spread_ratio(self) -> float:
        """Return the largest expansion over the smallest; the library must offer as much."""
        return float(self.expansion_ratio.max() / self.expansion_ratio.min())

    def diagonal_mm(self) -> float:
        """Return the diagonal of the flat's bounding box."""
        return float(np.linalg.norm(np.ptp(self.flat_mm, axis=0)))
