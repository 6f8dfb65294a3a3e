"""The target as the comparison needs it: exact closest points, even samples, its border."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from design.surface import TriMesh
from fabctl.scan.foreign import open3d
from fabctl.scan.nearest import NearestGrid, farthest_order, nearest_grid

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SEARCH_SAMPLES = 4000
CHUNK = 200_000  # points a closest-point query takes at once; bounds the memory
ON_EDGE = 1e-6  # barycentric weight below which a closest point counts as lying on the opposite edge


@dataclass(frozen=True, slots=True)
class Closest:
    """For each asked point: where on the surface, on which face, with which weights, and the normal there."""

    points_mm: Floats  # (n, 3)
    faces: Ints  # (n,)
    weights: Floats  # (n, 3), barycentric
    normals: Floats  # (n, 3), interpolated, unit
    on_border: NDArray[np.bool_]  # (n,)


@dataclass(frozen=True)
class Target:
    """A surface to compare with. Everything derived is worked out once, when first asked for."""

    mesh: TriMesh
    name: str = "target"

    @cached_property
    def diagonal_mm(self) -> float:
        """Return the length of the bounding box's diagonal."""
        return self.mesh.diagonal_mm()

    @cached_property
    def centre_mm(self) -> Floats:
        """Return the centroid of the area."""
        area = self.mesh.face_areas_mm2()
        middle = self.mesh.vertices_mm[self.mesh.faces].mean(axis=1)
        return np.asarray((area[:, None] * middle).sum(axis=0) / area.sum())

    @cached_property
    def vertex_normals(self) -> Floats:
        """Return area-weighted unit normals, `(n, 3)`; they point to the side the surface pops towards."""
        v, f = self.mesh.vertices_mm, self.mesh.faces
        a, b, c = (v[f[:, k]] for k in range(3))
        face_normals = np.cross(b - a, c - a)
        found = np.zeros_like(v)
        for k in range(3):
            np.add.at(found, f[:, k], face_normals)
        length = np.linalg.norm(found, axis=1, keepdims=True)
        return np.asarray(found / np.where(length > 0, length, 1.0))

    @cached_property
    def border_edges(self) -> NDArray[np.bool_]:
        """Return for every face which of its edges (opposite corner k) only it has, `(m, 3)`."""
        f = self.mesh.faces
        ends = np.sort(np.stack([f[:, [1, 2]], f[:, [2, 0]], f[:, [0, 1]]], axis=1).reshape(-1, 2), axis=1)
        _, where, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
        return np.asarray((count[where.ravel()] == 1).reshape(-1, 3))

    @cached_property
    def border_vertices(self) -> NDArray[np.bool_]:
        """Return which vertices lie on the border, `(n,)`."""
        found = np.zeros(len(self.mesh.vertices_mm), dtype=bool)
        for k in range(3):
            for end in ((k + 1) % 3, (k + 2) % 3):
                found[self.mesh.faces[self.border_edges[:, k], end]] = True
        return found

    @cached_property
    def _scene(self) -> Any:
        o3d = open3d()
        scene: Any = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(self.mesh.vertices_mm - self.centre_mm, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(self.mesh.faces, dtype=np.uint32)),
        )
        return scene

    def closest(self, points_mm: Floats) -> Closest:
        """Return the closest points of the surface to `points_mm`, `(n, 3)`.

        The place is worked out again in double from the face and its weights, so that the float queries of the ray
        caster do not show in the residuals.
        """
        tensor = open3d().core.Tensor
        faces, uv = np.empty(len(points_mm), dtype=np.int64), np.empty((len(points_mm), 2))
        for start in range(0, len(points_mm), CHUNK):
            part = slice(start, start + CHUNK)
            asked = tensor(np.ascontiguousarray(points_mm[part] - self.centre_mm, dtype=np.float32))
            answer = self._scene.compute_closest_points(asked)
            faces[part] = answer["primitive_ids"].numpy()
            uv[part] = answer["primitive_uvs"].numpy()
        weights = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        weights[weights < ON_EDGE] = 0.0
        weights /= weights.sum(axis=1, keepdims=True)
        corners = self.mesh.faces[faces]
        points = np.einsum("nk,nkd->nd", weights, self.mesh.vertices_mm[corners])
        normals = np.einsum("nk,nkd->nd", weights, self.vertex_normals[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        on_border = np.any((weights == 0.0) & self.border_edges[faces], axis=1)
        # A corner on the border may belong to a face whose own edges are all inner ones.
        at_corner = weights.max(axis=1) > 1 - ON_EDGE
        on_border |= at_corner & self.border_vertices[corners[np.arange(len(faces)), np.argmax(weights, axis=1)]]
        return Closest(points, faces, weights, normals, on_border)

    def even_samples(self, count: int) -> tuple[Floats, Floats, Ints]:
        """Return about `count` points spread evenly over the area, their normals, and their faces; always the same.

        Farthest-point order over a denser random draw: any leading part of it is spread evenly too.
        """
        return even_samples(self.mesh, self.vertex_normals, count)

    @cached_property
    def search(self) -> SearchTarget:
        """Return the samples for the global search, centred and with the diagonal as unit."""
        points, normals, _ = self.even_samples(SEARCH_SAMPLES)
        return SearchTarget(nearest_grid((points - self.centre_mm) / self.diagonal_mm), normals)

    @cached_property
    def border(self) -> Border | None:
        """Return the border, sampled evenly, or None for a closed surface."""
        return _border(self)


@dataclass(frozen=True, slots=True)
class SearchTarget:
    """Samples of the target in units of its diagonal, about its centroid, in farthest-point order."""

    grid: NearestGrid
    normals: Floats


@dataclass(frozen=True, slots=True)
class Border:
    """Samples along the border with a frame at each: outwards in the surface, along the border, and the normal."""

    points_mm: Floats  # (k, 3)
    outward: Floats  # (k, 3)
    along: Floats  # (k, 3)
    normals: Floats  # (k, 3)
    loop: Ints  # (k,), which closed loop of the border
    length_mm: Floats  # (k,), of border that each sample stands for


def even_samples(mesh: TriMesh, vertex_normals: Floats, count: int, seed: int = 7) -> tuple[Floats, Floats, Ints]:
    """Return `count` points over the mesh in farthest-point order, with normals and faces."""
    rng = np.random.default_rng(seed)
    area = mesh.face_areas_mm2()
    drawn = 3 * count
    face = rng.choice(len(area), drawn, p=area / area.sum())
    r1, r2 = np.sqrt(rng.random(drawn)), rng.random(drawn)
    weights = np.stack([1 - r1, r1 * (1 - r2), r1 * r2], axis=1)
    points = np.einsum("nk,nkd->nd", weights, mesh.vertices_mm[mesh.faces[face]])
    order = farthest_order(points, count)
    normals = np.einsum("nk,nkd->nd", weights[order], vertex_normals[mesh.faces[face[order]]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return np.ascontiguousarray(points[order]), normals, face[order]


def _border(target: Target) -> Border | None:
    face, corner = np.nonzero(target.border_edges)
    if len(face) == 0:
        return None
    v, f = target.mesh.vertices_mm, target.mesh.faces
    a, b = v[f[face, (corner + 1) % 3]], v[f[face, (corner + 2) % 3]]
    length = np.linalg.norm(b - a, axis=1)
    spacing = max(float(length.sum()) / 400, 1e-12)
    share = np.maximum(1, np.ceil(length / spacing).astype(int))
    which = np.repeat(np.arange(len(face)), share)
    step = np.concatenate([(np.arange(n) + 0.5) / n for n in share])[:, None]
    along = (b - a) / np.maximum(length, 1e-300)[:, None]
    opposite = v[f[face, corner]]
    normal = np.cross(b - a, opposite - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    outward = np.cross(along, normal)
    return Border(
        a[which] + step * (b - a)[which],
        outward[which],
        along[which],
        normal[which],
        _loops(target, face, corner)[which],
        (length / share)[which],
    )


def _loops(target: Target, face: Ints, corner: Ints) -> Ints:
    """Return for each border edge the number of the closed loop it belongs to."""
    f, n = target.mesh.faces, len(target.mesh.vertices_mm)
    a, b = f[face, (corner + 1) % 3], f[face, (corner + 2) % 3]
    _, label = connected_components(coo_array((np.ones(len(a), dtype=bool), (a, b)), shape=(n, n)), directed=False)
    return np.asarray(np.unique(label[a], return_inverse=True)[1], dtype=np.int64)
