"""What is asked of a flattening, and what comes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from design.surface import Faces, Indices, Points, TriMesh

Boundary = Literal["isometric", "prescribed", "optimised"]
Laplacian = Literal["cotangent", "delaunay"]
HoleChoice = Literal["auto", "filled", "free"]
SeamChoice = Literal["auto", "tube", "none"]


@dataclass(frozen=True, slots=True)
class FlattenOptions:
    """How the surface is to be laid flat.

    `boundary`: `isometric` keeps the rim's length (u = 0, the published way), `prescribed` takes `boundary_u`,
    `optimised` chooses the rim so that the spread of expansions is least.

    `holes`: `filled` closes them by a fan for the computation (the published way), `free` gives their rims scale
    factors of their own; `auto` frees them where the boundary is optimised.

    `seam`: a surface with two ends is laid flat as a strip with one seam (`tube`), or with its smaller end as a hole
    (`none`); `auto` takes the seam where a hole would ask for more than any library has.

    `cut_path` is a chain of vertices to cut along: the seam of a tube, or a dart from the rim inwards.

    `cones_count` cones are placed where they help most, the rim optimised with them.

    `given_mm` is a flat that is there already, by the corners of each face; it is checked, and nothing is computed.
    """

    boundary: Boundary = "isometric"
    boundary_u: NDArray[np.float64] | None = None  # (n,) over the mesh's vertices, read on the boundary only
    modes_count: int = 24  # waves along the rim that an optimised boundary may use
    holes: HoleChoice = "auto"
    seam: SeamChoice = "auto"
    cut_path: Indices | None = None
    cones_count: int = 0
    laplacian: Laplacian = "cotangent"
    given_mm: NDArray[np.float64] | None = None  # (m, 3, 2)


@dataclass(frozen=True, slots=True)
class Seam:
    """Two chains of flat points that are one line on the target.

    `right = turn(left, rotation_rad) + translation_mm`, up to `gap_mm`. The seam that closes a tube does not turn: its
    sheet repeats by `translation_mm` (along x), so that a pattern whose period divides it runs on across the joint. A
    cone's seam begins in the cone, where both chains share their first point.
    """

    left: Indices
    right: Indices
    rotation_rad: float
    translation_mm: tuple[float, float]
    gap_mm: float
    closes_tube: bool = False

    def measured(self, flat_mm: Points) -> Seam:
        """Return the seam with the motion that carries its left side onto its right one in `flat_mm`, and the gap left.

        A tube's seam is carried by a translation alone, whatever is measured.
        """
        a, b = flat_mm[self.left] @ [1, 1j], flat_mm[self.right] @ [1, 1j]
        turn = 1.0 + 0j
        if not self.closes_tube:
            inner = np.vdot(a - a.mean(), b - b.mean())
            turn = inner / abs(inner)
        shift = b.mean() - turn * a.mean()
        gap_mm = float(np.abs(turn * a + shift - b).max())
        return replace(
            self,
            rotation_rad=float(np.angle(turn)),
            translation_mm=(float(shift.real), float(shift.imag)),
            gap_mm=gap_mm,
        )


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

    def moved_to(self, flat_mm: Points) -> Flattening:
        """Return the same with the flat turned and shifted to `flat_mm`, its seams with it."""
        return replace(self, flat_mm=flat_mm, seams=tuple(seam.measured(flat_mm) for seam in self.seams))

    def scaled(self, factor_ratio: float) -> Flattening:
        """Return the same with the flat `factor_ratio` times as large, and so the expansions that much smaller."""
        seams = tuple(
            replace(
                seam,
                translation_mm=(seam.translation_mm[0] * factor_ratio, seam.translation_mm[1] * factor_ratio),
                gap_mm=seam.gap_mm * factor_ratio,
            )
            for seam in self.seams
        )
        return replace(
            self,
            flat_mm=self.flat_mm * factor_ratio,
            expansion_ratio=self.expansion_ratio / factor_ratio,
            u=self.u + math.log(factor_ratio),
            seams=seams,
        )

    def unrolled(self) -> tuple[Points, Faces, Indices]:
        """Return a tube's flat three times side by side: points, faces, and which face each is a copy of.

        Whatever lies in one period around the middle copy is covered, wherever the seam runs; so a pattern may choose
        its own straight joint, and cells on it still lie on faces. Without a tube's seam it is the flat itself.
        """
        seam = next((seam for seam in self.seams if seam.closes_tube), None)
        if seam is None:
            return self.flat_mm, self.faces, np.arange(len(self.faces))
        shifts = [np.multiply(seam.translation_mm, step) for step in (-1, 0, 1)]
        points_mm = np.vstack([self.flat_mm + shift for shift in shifts])
        faces = np.vstack([self.faces + step * len(self.flat_mm) for step in range(3)])
        return points_mm, faces, np.tile(np.arange(len(self.faces)), 3)

    def whole_cell_scales(self, cell_mm: float, low_ratio: float, high_ratio: float) -> list[tuple[int, float]]:
        """Return `(cells around, scale of the flat)` for which the tube's period is a whole number of cells.

        All scales from `low_ratio` to `high_ratio` are listed. The period lies along x, as the lattice's rows do, so
        any whole number repeats the tiling with its inverted units; across the rows an even number would be needed.
        """
        seam = next((seam for seam in self.seams if seam.closes_tube), None)
        if seam is None:
            return []
        period_mm = math.hypot(*seam.translation_mm)
        first, last = math.ceil(low_ratio * period_mm / cell_mm), math.floor(high_ratio * period_mm / cell_mm)
        return [(count, count * cell_mm / period_mm) for count in range(max(first, 1), last + 1)]
