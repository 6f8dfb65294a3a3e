"""Clouds and scanned meshes in and out of files; the only place of the scan comparison that reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.errors import RefusedError, UsageError
from fabctl.scan.foreign import open3d

Floats = NDArray[np.float64]

FORMATS = (".ply", ".obj", ".stl", ".pcd", ".xyz", ".txt", ".csv", ".las", ".laz")
LEAST_POINTS = 500
MESH_SAMPLES = 300_000
MOST_POINTS = 5_000_000


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
    that holds nothing usable. More than `most` points are thinned at random, and a finding says so.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise UsageError(f"{path}: not a cloud this program reads (known: {', '.join(FORMATS)})")
    if path.stat().st_size == 0:
        raise RefusedError(f"{path}: cannot be compared", [Finding("SCAN-FILE", "the file is empty", where=str(path))])
    if kind in (".las", ".laz"):
        found = _read_las(path)
    elif kind in (".xyz", ".txt", ".csv"):
        found = _read_text(path)
    else:
        found = _read_open3d(path, kind, seed)
    return _checked(found, seed, most)


def _checked(cloud: Cloud, seed: int, most: int) -> Cloud:
    findings = list(cloud.findings)
    finite = np.isfinite(cloud.points).all(axis=1)
    if not finite.all():
        lost = int((~finite).sum())
        findings.append(Finding("SCAN-NAN", f"{lost} points are not numbers and were left out", level="warning"))
        cloud = cloud.take(finite)
    if len(cloud.points) > most:
        findings.append(
            Finding(
                "SCAN-THINNED",
                f"{len(cloud.points)} points were thinned to {most} at random (seed {seed})",
                level="info",
            )
        )
        cloud = cloud.take(np.sort(np.random.default_rng(seed).permutation(len(cloud.points))[:most]))
    if len(cloud.points) < LEAST_POINTS:
        count = len(cloud.points)
        findings.append(Finding("SCAN-FEW", f"{count} usable points; at least {LEAST_POINTS} are needed"))
    elif float(np.ptp(cloud.points, axis=0).max()) <= 0:
        findings.append(Finding("SCAN-POINT", "all points are the same"))
    if any(f.level == "error" for f in findings):
        raise RefusedError(f"{cloud.source}: cannot be compared", findings)
    return replace(cloud, findings=tuple(findings))


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
        raise RefusedError(
            f"{path}: cannot be compared", [Finding("SCAN-TEXT", f"a vertex is not three numbers: {fault}")]
        ) from fault


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


def _read_text(path: Path) -> Cloud:
    rows, skipped = [], 0
    with path.open("rb") as stream:
        for line in stream:
            words = line.replace(b",", b" ").replace(b";", b" ").split()
            try:
                rows.append([float(w) for w in words[:6]])
            except ValueError:
                skipped += 1
            else:
                if len(rows[-1]) < 3:
                    rows.pop()
                    skipped += 1
    if not rows:
        raise RefusedError(
            f"{path}: cannot be compared",
            [Finding("SCAN-TEXT", "no line holds three numbers", where=str(path), hint="one point a line: x y z")],
        )
    points = np.array([row[:3] for row in rows])
    findings = () if skipped <= 1 else (Finding("SCAN-LINES", f"{skipped} lines hold no point", level="warning"),)
    return Cloud(points, None, None, path, findings)


def _read_las(path: Path) -> Cloud:
    import laspy

    try:
        read = laspy.read(path)
    except (laspy.errors.LaspyException, OSError, ValueError) as fault:
        raise RefusedError(
            f"{path}: cannot be compared", [Finding("SCAN-LAS", f"not a LAS file: {fault}", where=str(path))]
        ) from fault
    points = np.array(read.xyz, dtype=np.float64)
    colours = None
    if "red" in read.point_format.dimension_names:
        full = np.stack([np.asarray(read[k], dtype=np.int64) for k in ("red", "green", "blue")], axis=1)
        colours = (full // 256 if len(full) and full.max() > 255 else full).astype(np.uint8)
    return Cloud(points, None, colours, path)


def read_labelled(path: Path) -> dict[str, Floats]:
    """Return labelled points `label,x,y,z` of a CSV file; raises `RefusedError` naming every bad line."""
    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    found: dict[str, Floats] = {}
    bad: list[Finding] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
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
        raise RefusedError(f"{path}: cannot be used", bad)
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
