"""Is a flat usable? Flipped faces, overlap, distortion, and the expansions it asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from design.surface import Faces, Indices, Points, TriMesh

DISTORTION_MEAN_ratio = 1.05  # above it a unit is visibly not an equilateral triangle any more
NAMED_count = 6


@dataclass(frozen=True, slots=True)
class Distortion:
    """How far each face is from a scaled copy of itself: larger over smaller singular value of its map."""

    mean_ratio: float  # weighted by area on the target
    max_ratio: float
    flipped: Indices  # faces


def reference_triangles(mesh: TriMesh) -> NDArray[np.float64]:
    """Return each face laid in a plane, its first edge along x: columns are its two edges, `(m, 2, 2)`."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    edge, other = b - a, c - a
    length = np.sqrt(np.einsum("ij,ij->i", edge, edge))
    along = np.einsum("ij,ij->i", edge, other) / length
    across = np.sqrt(np.maximum(np.einsum("ij,ij->i", other, other) - along**2, 0))
    out = np.zeros((len(mesh.faces), 2, 2))
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 1] = length, along, across
    return out


def signed_areas_mm2(flat_mm: Points, faces: Faces) -> NDArray[np.float64]:
    """Return the area of each flat face, negative where it is flipped."""
    a, b, c = (flat_mm[faces[:, k]] for k in range(3))
    return np.asarray(0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))


def distortion(mesh: TriMesh, flat_mm: Points, faces: Faces) -> Distortion:
    """Measure the map from the target to the flat, face by face."""
    rest = reference_triangles(mesh)
    p, q, w = rest[:, 0, 0], rest[:, 0, 1], rest[:, 1, 1]
    a, b, c = (flat_mm[faces[:, k]] for k in range(3))
    # J = E D⁻¹ with D = [[p, q], [0, w]]; its similar and anti-similar parts give σ1 ± σ2.
    Jx = (b - a) / p[:, None]
    Jy = ((c - a) - Jx * q[:, None]) / w[:, None]
    similar = np.hypot(Jx[:, 0] + Jy[:, 1], Jx[:, 1] - Jy[:, 0])
    mirrored = np.hypot(Jx[:, 0] - Jy[:, 1], Jx[:, 1] + Jy[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (similar + mirrored) / np.abs(similar - mirrored)
    areas_mm2 = 0.5 * p * w
    flipped = np.flatnonzero(similar <= mirrored)
    return Distortion(float(np.average(ratio, weights=areas_mm2)), float(ratio.max()), flipped)


def crossings(flat_mm: Points, loop: Indices) -> int:
    """Return how many pairs of the rim's edges cross (0: with no flipped face the flat covers nothing twice)."""
    from shapely import STRtree, linestrings

    here, then = flat_mm[loop], flat_mm[np.roll(loop, -1)]
    lines: Any = linestrings(np.stack([here, then], axis=1))
    one, two = STRtree(lines).query(lines, predicate="crosses")
    return int(np.count_nonzero(one < two))


def check_flat(mesh: TriMesh, flat_mm: Points, faces: Faces, loops: list[Indices]) -> list[Finding]:
    """Return everything that speaks against using the flat; `loops` are its boundary loops."""
    from shapely import is_simple, linearrings

    found = []
    measured = distortion(mesh, flat_mm, faces)
    if len(measured.flipped):
        named = ", ".join(map(str, measured.flipped[:NAMED_count].tolist()))
        text = f"{len(measured.flipped)} faces are flipped in the flat: {named}"
        found.append(Finding("FLAT-FLIPPED", text, hint="remesh the target more evenly or finer"))
    for number, loop in enumerate(loops):
        # `is_simple` is quick; only a rim that fails is searched for its crossings.
        if not is_simple(linearrings(flat_mm[loop])):
            text = f"the flat overlaps itself: loop {number} crosses itself {crossings(flat_mm, loop)} times"
            found.append(Finding("FLAT-OVERLAP", text, hint="optimise the boundary, cut a seam or add cones"))
    if measured.mean_ratio > DISTORTION_MEAN_ratio:
        text = f"the flat is distorted: mean {measured.mean_ratio:.3f}, largest {measured.max_ratio:.2f}"
        found.append(Finding("FLAT-DISTORTED", text, "warning", hint="a finer, more even mesh flattens better"))
    return found
