"""From a designed pattern to the shell: which units, made of what, and where each corner belongs on the target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from design.deploy.levels import Layout, sheet_layout, weld
from design.deploy.shell import Ints, Reals


def designed_layout(
    vertices_mm: Reals,
    cells: Ints,
    expansion_ratio: ArrayLike,
    Y_N_mm: ArrayLike,
    nu_ratio: ArrayLike,
    D_mJ: ArrayLike,
    welds: Ints | None = None,
) -> tuple[Layout, Ints]:
    """Return the layout of a tiling's cells, and for each of its vertices the tiling vertex it came from.

    Cells may run either way round and need not use every vertex `(n, 2)`; properties are `(m,)` or scalars. `welds`
    `(k, 2)` are pairs of tiling vertices that a re-joined seam makes one.
    """
    a, b, c = (vertices_mm[cells[:, k]] for k in range(3))
    u, v = b - a, c - a
    clockwise = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0
    turned = np.where(clockwise[:, None], cells[:, ::-1], cells)
    used, compact = np.unique(turned, return_inverse=True)
    layout = sheet_layout(
        vertices_mm[used],
        compact.reshape(-1, 3).astype(np.int64),
        *(np.asarray(p, float) for p in (expansion_ratio, Y_N_mm, nu_ratio, D_mJ)),
    )
    if welds is None or not len(welds):
        return layout, used
    place = {int(old): new for new, old in enumerate(used)}
    pairs = np.array([(place[int(p)], place[int(q)]) for p, q in welds if int(p) in place and int(q) in place])
    joined = weld(layout, pairs.reshape(-1, 2))
    came_from = np.empty(joined.vertex_count, dtype=np.int64)
    came_from[joined.cells[::-1].ravel()] = used[layout.cells[::-1].ravel()]
    return joined, came_from


def lift(points_mm: Reals, flat_mm: Reals, faces: Ints, space_mm: Reals, space_faces: Ints | None = None) -> Reals:
    """Return where points of the flat `(k, 2)` lie on the surface that was flattened, `(k, 3)`.

    `flat_mm` `(n, 2)` and `space_mm` are the same mesh's vertices in the flat and in space; where cuts gave the flat
    more vertices, `space_faces` are the same faces in space. Points beside the flat continue its nearest face.
    """
    import igl

    level = np.column_stack([flat_mm, np.zeros(len(flat_mm))])
    wanted = np.column_stack([points_mm, np.zeros(len(points_mm))])
    face = np.asarray(igl.point_mesh_squared_distance(wanted, level, np.ascontiguousarray(faces))[1])
    a, b, c = (flat_mm[faces[face, k]] for k in range(3))
    return np.asarray(
        np.einsum(
            "nk,nkd->nd",
            _barycentric(points_mm, a, b, c),
            space_mm[(faces if space_faces is None else space_faces)[face]],
        )
    )


def _barycentric(p: Reals, a: Reals, b: Reals, c: Reals) -> Reals:
    u, v, w = b - a, c - a, p - a
    det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / det
    t = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / det
    return np.column_stack([1 - s - t, s, t])
