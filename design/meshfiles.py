"""Target surfaces on disk: OBJ, PLY and STL in millimetres. Reads, checks, writes."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.errors import MeshError, UnreadableMesh
from design.findings import Finding, errors
from design.meshformats import BadFile, Soup, parse_obj, parse_ply, parse_stl
from design.surface import Faces, Points, TriMesh, check_target, tidy

WELD_ratio = 1e-6  # of the diagonal: well above single precision, well below any cell
_PARSERS: dict[str, Callable[[bytes], Soup]] = {".obj": parse_obj, ".ply": parse_ply, ".stl": parse_stl}
_UNREADABLE = ("FILE-MISSING", "FILE-EMPTY", "FILE-FORMAT", "FILE-BINARY", "FILE-TRUNCATED", "FILE-LINE")


def read_mesh(path: Path | str) -> tuple[TriMesh, list[Finding]]:
    """Return the target in the file and what is doubtful about it.

    Polygons become fans of triangles; STL triangles, and pieces that touch all along, are welded.
    Raises `UnreadableMesh` where the bytes are not a mesh, `MeshError` where the mesh cannot be flattened; either
    carries every fault that could be found.
    """
    path = Path(path)
    soup = _read_soup(path)
    found = list(soup.findings)
    faces = _triangles(soup, found)
    mesh, left_out = tidy(_weld_where_needed(TriMesh(soup.points, faces), path, found))
    found += left_out + check_target(mesh)
    return mesh, _or_raise(path, found)


def read_triangles(path: Path | str) -> tuple[TriMesh, list[Finding]]:
    """Return any triangles a file holds, whatever their topology: a scan, a closed solid; faults as in `read_mesh`."""
    path = Path(path)
    soup = _read_soup(path)
    found = list(soup.findings)
    faces = _triangles(soup, found)
    mesh = TriMesh(soup.points, faces)
    if not np.isfinite(mesh.vertices_mm).all():
        found.append(Finding("MESH-NAN", "vertices are not finite numbers"))
    return mesh, _or_raise(path, found)


def read_corner_uv(path: Path | str) -> tuple[Points, Points]:
    """Return an OBJ file's corners in space `(m, 3, 3)` and in its texture plane `(m, 3, 2)`, its flat."""
    soup = parse_obj(Path(path).read_bytes())
    if soup.texture is None:
        raise UnreadableMesh(f"{path}: no texture coordinates", [Finding("FILE-TEXTURE", "faces have no `vt` indices")])
    faces, texture_faces = np.array(soup.polygons), np.array(soup.texture_polygons)
    return soup.points[faces], soup.texture[texture_faces]


def read_given_flat(path: Path | str, mesh: TriMesh) -> Points:
    """Return the flat that an OBJ gives for `mesh`, which was read from it, by face corners `(m, 3, 2)`.

    Raises `MeshError` where the file's faces are not those of the mesh: some were left out or divided.
    """
    try:
        corners_mm, flat_mm = read_corner_uv(path)
    except (ValueError, IndexError):  # polygons of several sizes, or corners without texture
        corners_mm = flat_mm = np.zeros((0, 3, 3))
    if corners_mm.shape[1:] != (3, 3) or len(corners_mm) != len(mesh.faces):
        told = Finding("FILE-TEXTURE", "its texture coordinates are not one for every corner of its triangles")
        raise MeshError(f"{path}: gives no flat of this surface", [told])
    if np.abs(mesh.vertices_mm[mesh.faces] - corners_mm).max() > WELD_ratio * mesh.diagonal_mm():
        told = Finding("FILE-TEXTURE", "its faces were put in another order when it was read")
        raise MeshError(f"{path}: gives no flat of this surface", [told])
    return flat_mm


def _read_soup(path: Path) -> Soup:
    parse = _PARSERS.get(path.suffix.lower())
    try:
        if parse is None:
            kind = f"not `{path.suffix}`" if path.suffix else "and this has no ending at all"
            raise BadFile("FILE-FORMAT", f"meshes are .obj, .ply or .stl, {kind}")
        data = path.read_bytes()
        if not data.strip():
            raise BadFile("FILE-EMPTY", "the file is empty")
        return parse(data)
    except BadFile as fault:
        raise UnreadableMesh(f"{path}: {fault}", [fault.finding]) from fault
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError) as fault:
        finding = Finding("FILE-MISSING", f"cannot be opened: {fault.strerror}")
        raise UnreadableMesh(f"{path}: cannot be opened", [finding]) from fault


def _or_raise(path: Path, found: list[Finding]) -> list[Finding]:
    """Return the findings where none forbids going on."""
    found = [replace(f, where=f.where or path.name) for f in found]
    wrong = errors(found)
    if not wrong:
        return found
    kind = UnreadableMesh if any(fault.code in _UNREADABLE for fault in wrong) else MeshError
    raise kind(f"{path} cannot be used as a target: {len(wrong)} fault{'s' * (len(wrong) > 1)}", found)


def _triangles(soup: Soup, found: list[Finding]) -> Faces:
    """Return the polygons as triangles over existing points; what cannot be is left out and reported."""
    rows = soup.polygons
    if not (isinstance(rows, np.ndarray) and rows.dtype != object and rows.ndim == 2 and rows.shape[1] == 3):
        sizes = {len(row) for row in rows}
        if sizes - {3}:
            if min(sizes, default=3) < 3:
                found.append(Finding("MESH-CORNERS", "face(s) have fewer than three corners"))
            if max(sizes, default=3) > 3:
                found.append(Finding("MESH-POLYGONS", "polygons were divided into triangles", "info"))
            rows = [[row[0], row[k], row[k + 1]] for row in rows for k in range(1, len(row) - 1)]
    faces = np.array(rows, dtype=np.int64).reshape(-1, 3)
    outside = ((faces < 0) | (faces >= len(soup.points))).any(axis=1)
    if outside.any():
        text = f"{np.count_nonzero(outside)} face(s) name vertices that are not there; there are {len(soup.points)}"
        found.append(Finding("MESH-INDEX", text, hint="the file was cut short or edited"))
    return faces[~outside]


def _weld_where_needed(mesh: TriMesh, path: Path, found: list[Finding]) -> TriMesh:
    """Weld STL always; others where every face stands alone or separate pieces lie edge on edge."""
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices_mm).all():
        return mesh
    is_stl = path.suffix.lower() == ".stl"
    if not is_stl and not any(fault.code == "MESH-COMPONENTS" for fault in check_target(mesh)):
        return mesh
    welded = weld(mesh, WELD_ratio * mesh.diagonal_mm())
    merged = len(mesh.vertices_mm) - len(welded.vertices_mm)
    if merged and not is_stl:
        text = f"{merged} vertices lay on others; they were welded"
        found.append(Finding("MESH-WELDED", text, "warning", hint="a slit in the target is closed by this"))
    return welded


def weld(mesh: TriMesh, distance_mm: float) -> TriMesh:
    """Return the mesh with points nearer than `distance_mm` made one (the first of them)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    exact, back = np.unique(mesh.vertices_mm, axis=0, return_inverse=True)
    pairs = cKDTree(exact).query_pairs(distance_mm, output_type="ndarray")
    ties = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(exact), len(exact)))
    label = connected_components(ties.tocsr(), directed=False)[1]
    _, first = np.unique(label, return_index=True)
    return TriMesh(exact[first], label[back.ravel()][mesh.faces].astype(np.int64))


def write_ply(path: Path | str, mesh: TriMesh, colors: NDArray[np.uint8] | None = None) -> None:
    """Write a binary PLY in mm, double precision; `colors` is `(n, 3)`, red green blue per vertex."""
    columns = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    if colors is not None:
        columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(mesh.vertices_mm), dtype=columns)
    for k, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices_mm[:, k] if k < mesh.vertices_mm.shape[1] else 0.0
    for k, name in enumerate(("red", "green", "blue") if colors is not None else ()):
        vertices[name] = colors[:, k]  # type: ignore[index]
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.faces
    names = {"<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment millimetres", f"element vertex {len(vertices)}"]
    header += [f"property {names[kind]} {name}" for name, kind in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    Path(path).write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def write_obj(path: Path | str, mesh: TriMesh) -> None:
    """Write an OBJ in mm; coordinates as short as they can be and still read back the same."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices_mm.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    Path(path).write_text("\n".join(lines) + "\n")


def write_stl(path: Path | str, mesh: TriMesh) -> None:
    """Write a binary STL in mm (single precision, as the format is)."""
    corners = mesh.vertices_mm[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(mesh.faces), dtype=[("floats", "<f4", (4, 3)), ("extra", "<u2")])
    rows["floats"][:, 0] = normals / np.where(lengths > 0, lengths, 1)
    rows["floats"][:, 1:] = corners
    Path(path).write_bytes(b"fabctl, millimetres".ljust(80) + np.uint32(len(rows)).tobytes() + rows.tobytes())


def write_mesh(path: Path | str, mesh: TriMesh) -> None:
    """Write the mesh in the format its name asks for, whole or not at all."""
    writers: dict[str, Callable[[Path, TriMesh], None]] = {".ply": write_ply, ".obj": write_obj, ".stl": write_stl}
    path = Path(path)
    if path.suffix.lower() not in writers:
        text = f"meshes are OBJ, PLY or STL, not `{path.suffix}`"
        raise UnreadableMesh(f"{path}: {text}", [Finding("FILE-FORMAT", text)])
    draft = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        writers[path.suffix.lower()](draft, mesh)
        draft.replace(path)
    except OSError as fault:  # a full disk: what is there cannot be told from a mesh
        draft.unlink(missing_ok=True)
        raise OSError(fault.errno, fault.strerror, str(path)) from fault
