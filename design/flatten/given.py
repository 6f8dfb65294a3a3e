"""A flat that comes with the target (an OBJ's texture coordinates), checked as if it were our own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError
from design.findings import Finding, errors
from design.flatten.quality import check_flat, signed_areas_mm2
from design.flatten.result import Flattening
from design.surface import TriMesh, boundary_loops


def given_flat(mesh: TriMesh, corners_mm: NDArray[np.float64]) -> Flattening:
    """Return the flat whose face corners are `corners_mm`, `(m, 3, 2)`, in the order of the mesh's faces.

    A vertex whose corners lie in several places is doubled, as along a seam. Raises `FlattenError` with all findings
    where faces are flipped or the flat overlaps itself.
    """
    if corners_mm.shape != (len(mesh.faces), 3, 2):
        raise FlattenError(f"the given flat has {len(corners_mm)} faces, the surface {len(mesh.faces)}")
    keys = np.column_stack([mesh.faces.ravel(), corners_mm.reshape(-1, 2)])
    points, inverse = np.unique(keys, axis=0, return_inverse=True)
    index, faces = points[:, 0].astype(np.int64), inverse.reshape(-1, 3).astype(np.int64)
    flat_mm = points[:, 1:].astype(np.float64)
    opened = TriMesh(mesh.vertices_mm[index], faces)
    found = check_flat(opened, flat_mm, faces, boundary_loops(opened))
    if errors(found):
        raise FlattenError("the flat that the target's file gives cannot be used", found)
    areas_mm2 = signed_areas_mm2(flat_mm, faces)
    expansion_ratio = np.sqrt(mesh.face_areas_mm2() / areas_mm2)
    weight = np.bincount(faces.ravel(), np.repeat(areas_mm2, 3), len(flat_mm))
    u = -np.bincount(faces.ravel(), np.repeat(areas_mm2 * np.log(expansion_ratio), 3), len(flat_mm)) / weight
    doubled = len(flat_mm) - len(mesh.vertices_mm)
    if doubled:
        text = f"the given flat is cut open at {doubled} places; its seams are not known, so nothing is labelled"
        found.append(Finding("FLAT-GIVEN-SEAM", text, "warning", hint="let the program cut the seam"))
    return Flattening(mesh, flat_mm, faces, index, expansion_ratio, u, (), tuple(found))
