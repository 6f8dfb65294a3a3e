"""A triangle mesh in space, and what speaks against using it as a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding

Points = NDArray[np.float64]
Faces = NDArray[np.int64]
Indices = NDArray[np.int64]

METRES_BELOW_mm = 2.0  # no bistable sheet is that small: such a file is in metres
INCHES_BELOW_mm = 30.0  # three cells of the usual size: probably inches or centimetres
LARGE_ABOVE_mm = 3000.0  # larger than any laser bed by far: probably micrometres
FLAT_AREA_ratio = 1e-12  # of the squared diagonal; below it a face has no usable angle
NAMED_count = 6  # so many culprits are named in a message, the others counted


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


def boundary_halfedges(faces: Faces, count: int) -> NDArray[np.int64]:
    """Return the directed edges `(b, 2)` that no face runs the other way, over `count` vertices."""
    tail, head = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    code = low * count + high
    order = np.argsort(code)
    sorted_code = code[order]
    differs = sorted_code[1:] != sorted_code[:-1]
    alone = np.concatenate([[True], differs]) & np.concatenate([differs, [True]])
    single = np.sort(order[alone])
    return np.column_stack([tail[single], head[single]])


def boundary_loops(mesh: TriMesh) -> list[Indices]:
    """Return the boundary loops, the longest first, each in the direction of its faces.

    Holds for an oriented manifold mesh: every boundary vertex has one edge in and one edge out.
    """
    edges = boundary_halfedges(mesh.faces, len(mesh.vertices_mm))
    following = dict(edges.tolist())
    loops = []
    while following:
        start, here = following.popitem()
        loop = [start]
        while here != start:
            loop.append(here)
            here = following.pop(here)
        loops.append(np.roll(loop, -int(np.argmin(loop))).astype(np.int64))
    return sorted(loops, key=lambda loop: -loop_length_mm(mesh, loop))


def loop_length_mm(mesh: TriMesh, loop: Indices) -> float:
    """Return the length of a closed chain of vertices."""
    points = mesh.vertices_mm[loop]
    return float(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum())


def tidy(mesh: TriMesh) -> tuple[TriMesh, list[Finding]]:
    """Return the mesh without what harms nobody by leaving, and what was left out.

    Faces that name a vertex twice, second copies of a face, and vertices no face uses.
    """
    found = []
    faces = mesh.faces
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if collapsed.any():
        hint = "they were left out"
        found.append(_fault("MESH-COLLAPSED", "face(s) name a vertex twice", np.flatnonzero(collapsed), hint, True))
        faces = faces[~collapsed]
    first = _first_of_each(np.sort(faces, axis=1), len(mesh.vertices_mm))
    if len(first) < len(faces):
        second = np.setdiff1d(np.arange(len(faces)), first)
        found.append(_fault("MESH-DUPLICATE", "face(s) are there twice", second, "one of each was kept", True))
        faces = faces[np.sort(first)]
    used = np.zeros(len(mesh.vertices_mm), dtype=bool)
    used[faces] = True
    if not used.all():
        found.append(Finding("MESH-UNUSED", f"{np.count_nonzero(~used)} vertices belong to no face; left out", "info"))
    renumbered = np.cumsum(used) - 1
    return TriMesh(mesh.vertices_mm[used], renumbered[faces].astype(np.int64)), found


def _first_of_each(rows: Indices, count: int) -> Indices:
    """Return where each distinct row of vertex numbers below `count` comes first."""
    if count < 2**20:  # three of them in one number sort much faster than rows do
        code = (rows[:, 0] * count + rows[:, 1]) * count + rows[:, 2]
        return np.asarray(np.unique(code, return_index=True)[1])
    return np.asarray(np.unique(rows, axis=0, return_index=True)[1])


def check_target(mesh: TriMesh) -> list[Finding]:
    """Return everything that speaks against flattening the mesh; shape, size and topology together."""
    if len(mesh.faces) == 0:
        return [Finding("MESH-EMPTY", "there is no face in the mesh")]
    bad = ~np.isfinite(mesh.vertices_mm).all(axis=1)
    found = []
    if bad.any():
        found.append(_fault("MESH-NAN", "vertices are not finite numbers", np.flatnonzero(bad), "export it again"))
    else:
        found += _check_size(mesh)
    return found + _check_topology(mesh)


def _check_size(mesh: TriMesh) -> list[Finding]:
    diagonal_mm = mesh.diagonal_mm()
    areas_mm2 = mesh.face_areas_mm2()
    if areas_mm2.sum() <= FLAT_AREA_ratio * diagonal_mm**2:
        return [Finding("MESH-AREA", "the surface has no area", hint="its points lie on a line or in one point")]
    found = []
    flat = areas_mm2 <= FLAT_AREA_ratio * diagonal_mm**2
    if flat.any():
        found.append(_fault("MESH-FLAT-FACE", "face(s) have no area", np.flatnonzero(flat), "remesh or weld them"))
    if diagonal_mm < METRES_BELOW_mm:
        hint = f"it looks like metres; scaled by 1000 it measures {diagonal_mm * 1000:.4g} mm"
        found.append(Finding("MESH-UNITS", f"the whole target measures {diagonal_mm:.4g} mm", hint=hint))
    elif diagonal_mm < INCHES_BELOW_mm:
        hint = f"inches would be {diagonal_mm * 25.4:.4g} mm, centimetres {diagonal_mm * 10:.4g} mm"
        found.append(Finding("MESH-UNITS", f"the whole target measures {diagonal_mm:.4g} mm", "warning", hint=hint))
    elif diagonal_mm > LARGE_ABOVE_mm:
        hint = "is the file in micrometres?"
        found.append(Finding("MESH-UNITS", f"the whole target measures {diagonal_mm:.5g} mm", "warning", hint=hint))
    return found


def _check_topology(mesh: TriMesh) -> list[Finding]:
    count = len(mesh.vertices_mm)
    tail, head = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    directed = tail * count + head
    undirected = np.minimum(tail, head) * count + np.maximum(tail, head)
    edges, uses = np.unique(undirected, return_counts=True)
    found = []
    crowded = edges[uses > 2]
    if len(crowded):
        text = "edge(s) belong to more than two faces"
        found.append(_fault("MESH-EDGE", text, crowded, "remove the extra faces", edges=count))
    _, first, repeats = np.unique(directed, return_index=True, return_counts=True)
    twisted = np.setdiff1d(undirected[first[repeats > 1]], crowded)
    if len(twisted):
        found.append(_twist(mesh, twisted))
    pieces = _component_count(mesh)
    if pieces > 1:
        hint = "keep one, or join them"
        found.append(Finding("MESH-COMPONENTS", f"the surface is in {pieces} separate pieces", hint=hint))
    if not (uses == 1).any():
        hint = "cut it open: a sheet has an edge"
        return [*found, Finding("MESH-CLOSED", "the surface is closed, it has no boundary", hint=hint)]
    pinched = _pinched_vertices(mesh)
    if len(pinched):
        text = "vertices join fans of faces in a single point"
        found.append(_fault("MESH-VERTEX", text, pinched, "split them or add the missing faces"))
    if not found:
        found += _check_genus(mesh, len(edges))
    return found


def _twist(mesh: TriMesh, twisted: Indices) -> Finding:
    """Return what is wrong at edges whose faces look to opposite sides: flipped ones, or a surface of one side."""
    count = len(mesh.vertices_mm)
    if _has_two_sides(mesh):
        text = "edge(s) lie between faces that look to opposite sides (flipped faces)"
        return _fault("MESH-FLIPPED", text, twisted, "orient the faces alike", edges=count)
    text = "edge(s) lie between faces that look to opposite sides, and no turning of faces helps: it has one side only"
    hint = "like a Moebius band: cut it across once, so that it is a strip with two sides"
    return _fault("MESH-ONE-SIDED", text, twisted, hint, edges=count)


def _has_two_sides(mesh: TriMesh) -> bool:
    """Say whether the faces can be turned so that all look to one side: no walk over edges comes back upside down."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count, m = len(mesh.vertices_mm), len(mesh.faces)
    tail, head = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    code = np.minimum(tail, head) * count + np.maximum(tail, head)
    order = np.argsort(code, kind="stable")
    _, first, uses = np.unique(code[order], return_index=True, return_counts=True)
    one, two = order[first[uses == 2]], order[first[uses == 2] + 1]
    alike = tail[one] != tail[two]  # faces that look to one side run their edge in opposite directions
    a, b = one // 3, two // 3
    # Each face stands twice, with either side up; a step to a neighbour keeps the side or changes it.
    up, down = np.where(alike, b, b + m), np.where(alike, b + m, b)
    steps = np.concatenate([a, a + m]), np.concatenate([up, down])
    graph = coo_array((np.ones(2 * len(a), dtype=np.int8), steps), shape=(2 * m, 2 * m))
    label = connected_components(graph.tocsr(), directed=False)[1]
    return not (label[:m] == label[m:]).any()


def _check_genus(mesh: TriMesh, edge_count: int) -> list[Finding]:
    euler = len(mesh.vertices_mm) - edge_count + len(mesh.faces)
    handles = (2 - len(boundary_loops(mesh)) - euler) // 2
    if handles == 0:
        return []
    return [Finding("MESH-HANDLE", f"the surface has {handles} handle(s)", hint="cut them open")]


def _component_count(mesh: TriMesh) -> int:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices_mm)
    tail, head = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    graph = coo_array((np.ones(len(tail), dtype=np.int8), (tail, head)), shape=(count, count))
    labels = connected_components(graph.tocsr(), directed=False)[1]
    return len(np.unique(labels[mesh.faces[:, 0]]))


def _pinched_vertices(mesh: TriMesh) -> Indices:
    """Return the vertices whose faces do not form one fan: their corners, joined over shared edges, fall apart."""
    count = len(mesh.vertices_mm)
    fans = corner_fans(mesh.faces, count).ravel()
    vertex_of_fan = np.zeros(fans.max() + 1, dtype=np.int64)
    vertex_of_fan[fans] = mesh.faces.ravel()  # a fan turns around one vertex
    return np.flatnonzero(np.bincount(vertex_of_fan, minlength=count) > 1)


def corner_fans(faces: Faces, count: int, cut: Indices | None = None) -> Indices:
    """Return `(m, 3)` labels: corners at a vertex share one where a walk over edges around it joins them.

    `cut` holds edges `(k, 2)` that join nothing.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(faces.size).reshape(faces.shape)
    tail, head = faces, np.roll(faces, -1, axis=1)
    code = (np.minimum(tail, head) * count + np.maximum(tail, head)).ravel()
    order = np.argsort(code, kind="stable")
    same = code[order[1:]] == code[order[:-1]]
    if cut is not None:
        same &= ~np.isin(code[order[1:]], cut.min(axis=1) * count + cut.max(axis=1))
    one, two = order[:-1][same], order[1:][same]
    # Each shared edge ties the corners at either end; which end is which follows from the vertex.
    following = np.roll(corner, -1, axis=1).ravel()
    ends_one = np.stack([corner.ravel()[one], following[one]])
    ends_two = np.stack([corner.ravel()[two], following[two]])
    vertex = faces.ravel()
    ends_two = np.where(vertex[ends_one[0]] != vertex[ends_two[0]], ends_two[::-1], ends_two)
    ones = np.ones(ends_one.size, dtype=np.int8)
    ties = coo_array((ones, (ends_one.ravel(), ends_two.ravel())), shape=(faces.size, faces.size))
    labels: Indices = connected_components(ties.tocsr(), directed=False)[1].astype(np.int64)
    return labels.reshape(faces.shape)


def _fault(code: str, text: str, which: Indices, hint: str, warns: bool = False, edges: int = 0) -> Finding:
    """Return a finding that names the first culprits; `edges` is the vertex count that codes edges as numbers."""
    names = [f"{k // edges}-{k % edges}" if edges else str(k) for k in which[:NAMED_count].tolist()]
    more = f" and {len(which) - NAMED_count} more" if len(which) > NAMED_count else ""
    return Finding(code, f"{len(which)} {text}: {', '.join(names)}{more}", "warning" if warns else "error", hint=hint)
