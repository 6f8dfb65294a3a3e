"""A rim whose scale factors are given at a few places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError
from design.findings import Finding
from design.flatten.cut import near_mm
from design.surface import TriMesh, boundary_loops

Values = NDArray[np.float64]


def rim_u_through(mesh: TriMesh, places_mm: Values, u: Values) -> Values:
    """Return log scale factors `(n,)` over the vertices that take `u` `(k,)` at places `(k, 3)` on the rims.

    Between its places a rim changes in proportion to the way along it; a rim without a place keeps its length (u = 0).
    Raises `FlattenError` with every place that lies off the rims.
    """
    loops = boundary_loops(mesh)
    rim = np.concatenate(loops)
    gaps_mm = np.linalg.norm(mesh.vertices_mm[rim] - places_mm[:, None], axis=2)
    vertices, off_mm = rim[gaps_mm.argmin(axis=1)], gaps_mm.min(axis=1)
    near = near_mm(mesh)
    faults = [
        Finding("RIM-PLACE", f"lies {off:.1f} mm from the rim, farther than {near:.1f} mm", where=f"({place})")
        for off, place in zip(off_mm, (", ".join(f"{x:g}" for x in row) for row in places_mm), strict=True)
        if off > near
    ]
    if faults:
        raise FlattenError("the boundary's values are not on the boundary", faults)
    found = np.zeros(len(mesh.vertices_mm))
    for loop in loops:
        mine = np.isin(vertices, loop)
        if mine.any():
            corners_mm = mesh.vertices_mm[loop]
            steps_mm = np.linalg.norm(np.roll(corners_mm, -1, axis=0) - corners_mm, axis=1)
            along_mm = np.cumsum(steps_mm) - steps_mm
            at = np.array([int(np.flatnonzero(loop == vertex)[0]) for vertex in vertices[mine]])
            found[loop] = np.interp(along_mm, along_mm[at], u[mine], period=float(steps_mm.sum()))
    return found
