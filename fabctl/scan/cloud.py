"""Clouds and scanned meshes in and out of files; the only place of the scan comparison that reads them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.errors import RefusedError, UnreadableInput, UsageError
from fabctl.files import text_of
from fabctl.scan.foreign import open3d
from fabctl.scan.stream import Piece, draw, las_pieces, ply_header, ply_pieces, text_pieces

Floats = NDArray[np.float64]

FORMATS = (".ply", ".obj", ".stl", ".pcd", ".xyz", ".txt", ".csv", ".las", ".laz")
LEAST_POINTS = 500
MESH_SAMPLES = 300_000
MOST_POINTS = 5_000_000
RGB = ("red", "green", "blue")


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points as a file gave them, with normals and colours where it did."""

    points: Floats  # (n, 3), in the file's own units
    normals: Floats | None  # (n, 3)
    colours: NDArray[np.uint8] | None  # (n, 3)
    source: Path
    findings: tuple[Finding, ...] = ()

    def take(self, which: Any) -> Cloud:
        """Return some of the points."""
        return replace(
            self,
            points=self.points[which],
            normals=None if self.normals is None else self.normals[which],
            colours=None if self.colours is None else self.colours[which],
        )


def read_cloud(path: Path, seed: int = 0, most: int = MOST_POINTS) -> Cloud:
    """Return the cloud in the file: PLY, OBJ, STL, PCD, XYZ text or LAS; meshes are sampled evenly.

    Raises `UsageError` for a file that is not there or not of these kinds, `RefusedError` with all findings for one
    that holds nothing usable. More than `most` points are thinned at random, and a finding says so; files of points are
    thinned while they are read.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise UsageError(f"{path}: not a cloud this program reads (known: {', '.join(FORMATS)})")
    if path.stat().st_size == 0:
        raise UnreadableInput(
            f"{path}: cannot be compared", [Finding("SCAN-FILE", "the file is empty", where=str(path))]
        )
    if kind == ".ply":
        _must_be_ply(path)
    header = ply_header(path) if kind == ".ply" else None
    skipped: list[int] = []
    said: list[Finding] = []
    if kind in (".las", ".laz"):
        found = _drawn(path, las_pieces(path), seed, most)
    elif kind in (".xyz", ".txt", ".csv"):
        found = _drawn(path, text_pieces(path, skipped, said), seed, most)
        found = replace(found, findings=(*said, *found.findings))
        if len(found.points) == 0 and len(found.findings) == len(said):
            none = Finding("SCAN-TEXT", "no line holds three numbers", where=str(path), hint="one point a line: x y z")
            raise UnreadableInput(f"{path}: cannot be compared", [none])
        if sum(skipped) > 1:
            lines = Finding("SCAN-LINES", f"{sum(skipped)} lines hold no point", level="warning")
            found = replace(found, findings=(*found.findings, lines))
    elif header is not None:
        found = _drawn(path, ply_pieces(path, header), seed, most)
    else:
        found = _thinned(_read_open3d(path, kind, seed), seed, most)
    return _checked(found)


def _must_be_ply(path: Path) -> None:
    """Raise `UnreadableInput` where the file does not begin as PLY does; Open3D answers with chatter of its own."""
    with path.open("rb") as stream:
        if stream.read(3) != b"ply":
            said = Finding("SCAN-FILE", "not a PLY file, whatever its name says", where=str(path))
            raise UnreadableInput(f"{path}: cannot be compared", [said])


def _drawn(path: Path, pieces: Iterator[Piece], seed: int, most: int) -> Cloud:
    """Return the cloud read a piece at a time, with what was left out of it."""
    made = draw(pieces, most, seed)
    findings = []
    if made.not_numbers_count:
        findings.append(_not_numbers(made.not_numbers_count))
    usable = made.total_count - made.not_numbers_count
    if len(made.points) < usable:
        findings.append(_said_thinned(usable, len(made.points), seed, "while reading"))
    return Cloud(made.points, made.normals, made.colours, path, tuple(findings))


def _not_numbers(count: int) -> Finding:
    return Finding("SCAN-NAN", f"{count} points are not numbers and were left out", level="warning")


def _said_thinned(count: int, kept: int, seed: int, when: str) -> Finding:
    said = f"{count} points were thinned to {kept} at random, evenly over the file, {when} (seed {seed})"
    return Finding("SCAN-THINNED", said, level="info")


def _thinned(cloud: Cloud, seed: int, most: int) -> Cloud:
    """Return the cloud without what is no number, and with at most `most` points, with a finding for either."""
    findings = list(cloud.findings)
    finite = np.isfinite(cloud.points).all(axis=1)
    if not finite.all():
        findings.append(_not_numbers(int((~finite).sum())))
        cloud = cloud.take(finite)
    if len(cloud.points) > most:
        findings.append(_said_thinned(len(cloud.points), most, seed, "after reading"))
        cloud = cloud.take(np.sort(np.random.default_rng(seed).permutation(len(cloud.points))[:most]))
    return replace(cloud, findings=tuple(findings))


def _checked(cloud: Cloud) -> Cloud:
    """Return the cloud; raises `RefusedError` where nothing can be compared."""
    findings = list(cloud.findings)
    if len(cloud.points) < LEAST_POINTS:
        count = len(cloud.points)
        findings.append(Finding("SCAN-FEW", f"{count} usable points; at least {LEAST_POINTS} are needed"))
    elif float(np.ptp(cloud.points, axis=0).max()) <= 0:
        findings.append(Finding("SCAN-POINT", "all points are the same"))
    if any(f.level == "error" for f in findings):
        kind = RefusedError if len(cloud.points) else UnreadableInput
        raise kind(f"{cloud.source}: cannot be compared", findings)
    return cloud


def _read_open3d(path: Path, kind: str, seed: int) -> Cloud:
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path)) if kind in (".obj", ".stl", ".ply") else None
        if mesh is not None and len(mesh.triangles) > 0:
            return _sampled(mesh, path, seed)
        if kind == ".obj" and mesh is not None:
            return Cloud(_obj_vertices(path), None, None, path)
        read = o3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    points = np.array(read.points, dtype=np.float64)
    normals = np.array(read.normals) if read.has_normals() else None
    colours = np.round(255 * np.array(read.colors)).astype(np.uint8) if read.has_colors() else None
    return Cloud(points, normals, colours, path)


def _obj_vertices(path: Path) -> Floats:
    """Return the `v` lines of an OBJ file that has no faces; open3d reads none of those."""
    rows = [line.split()[1:4] for line in path.read_bytes().splitlines() if line.startswith(b"v ")]
    try:
        return np.array([[float(x) for x in row] for row in rows], dtype=np.float64).reshape(-1, 3)
    except ValueError as fault:
        said = Finding("SCAN-TEXT", "a vertex is not three numbers", where=str(path))
        raise UnreadableInput(f"{path}: cannot be compared", [said]) from fault


def _sampled(mesh: Any, path: Path, seed: int) -> Cloud:
    """Return points spread evenly over a scanned mesh: vertices stand close where the mesh is fine, not where it is."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.triangles)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    area = np.where(np.isfinite(area), area, 0.0)
    if area.sum() <= 0:
        return Cloud(vertices, None, None, path)
    count = max(MESH_SAMPLES, min(len(vertices), 2_000_000))
    rng = np.random.default_rng(seed)
    face = rng.choice(len(faces), count, p=area / area.sum())
    r1, r2 = np.sqrt(rng.random(count)), rng.random(count)
    weight = np.stack([1 - r1, r1 * (1 - r2), r1 * r2], axis=1)
    points = np.einsum("nk,nkd->nd", weight, vertices[faces[face]])
    colours = None
    if mesh.has_vertex_colors():
        mixed = np.einsum("nk,nkd->nd", weight, np.asarray(mesh.vertex_colors)[faces[face]])
        colours = np.round(255 * mixed).astype(np.uint8)
    said = Finding("SCAN-MESH", f"a mesh of {len(faces)} triangles, sampled evenly by {count} points", level="info")
    return Cloud(points, cross[face] / area[face, None], colours, path, (said,))


def read_painted(path: Path) -> tuple[Floats, NDArray[np.uint8] | None]:
    """Return points and colours of a PLY file, its vertices where it is a mesh; no colours where it has none."""
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    if path.suffix.lower() == ".ply":
        _must_be_ply(path)
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        read = o3d.io.read_point_cloud(str(path))
    colours = np.round(255 * np.array(read.colors)).astype(np.uint8) if read.has_colors() else None
    return np.array(read.points, dtype=np.float64).reshape(-1, 3), colours


def write_painted(path: Path, points_mm: Floats, colours: NDArray[np.uint8]) -> None:
    """Write points with the colours they were scanned in as binary PLY."""
    table = np.zeros(len(points_mm), dtype=[(k, "<f4") for k in "xyz"] + [(k, "u1") for k in RGB])
    table["x"], table["y"], table["z"] = points_mm.T
    table["red"], table["green"], table["blue"] = colours.T
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {k}" for k in "xyz"] + [f"property uchar {k}" for k in RGB]
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + table.tobytes())


def read_labelled(path: Path) -> dict[str, Floats]:
    """Return labelled points `label,x,y,z` of a CSV file; raises `RefusedError` naming every bad line."""
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    found: dict[str, Floats] = {}
    bad: list[Finding] = []
    for number, line in enumerate(text_of(path, "labelled points: label,x,y,z").splitlines(), 1):
        words = [w.strip() for w in line.split(",")]
        if not line.strip() or line.startswith("#") or (number == 1 and words[1:4] == ["x", "y", "z"]):
            continue
        try:
            label, place = words[0], np.array([float(w) for w in words[1:4]])
            if len(place) != 3 or not np.isfinite(place).all() or label in found:
                raise ValueError
        except (ValueError, IndexError):
            bad.append(Finding("SCAN-LABEL", f"not a new label and three numbers: {line!r}", where=f"{path}:{number}"))
        else:
            found[label] = place
    if bad:
        raise (RefusedError if found else UnreadableInput)(f"{path}: cannot be used", bad)
    return found


def write_ply(path: Path, points: Floats, value_mm: Floats, colours: NDArray[np.uint8]) -> None:
    """Write points with their deviation (`deviation_mm`) and its colour as binary PLY."""
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("deviation_mm", "<f4")]
    table = np.zeros(len(points), dtype=[*kinds, ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    table["x"], table["y"], table["z"], table["deviation_mm"] = *points.T, value_mm
    table["red"], table["green"], table["blue"] = colours.T
    names = ["float"] * 4 + ["uchar"] * 3
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {kind} {name}" for kind, name in zip(names, table.dtype.names or (), strict=True)]
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + table.tobytes())


def write_csv(path: Path, points: Floats, value_mm: Floats, area_weight: Floats, counts: NDArray[np.bool_]) -> None:
    """Write one row a point: place in the target's frame, deviation, weight, and whether it counts."""
    import pyarrow as pa
    import pyarrow.csv as pa_csv

    columns = {"x_mm": points[:, 0], "y_mm": points[:, 1], "z_mm": points[:, 2], "deviation_mm": value_mm}
    table = pa.table({**{k: np.round(v, 5) for k, v in columns.items()}, "weight_frac": area_weight, "counts": counts})
    pa_csv.write_csv(table, path)
