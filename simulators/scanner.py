"""The scanner as a program: a deployed mesh in, a cloud out, and the answer key in a folder that only tests open."""

from __future__ import annotations

import argparse
import importlib
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.photogrammetry import LABELS, Floats, Scan, ScanPlan, scan

DEFAULTS = ScanPlan()


def read_mesh(path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """Return vertices in mm and triangles of the file, read by open3d."""
    o3d: Any = importlib.import_module("open3d")
    found = o3d.io.read_triangle_mesh(str(path))
    vertices, faces = np.asarray(found.vertices, dtype=np.float64), np.asarray(found.triangles, dtype=np.int64)
    if len(faces) == 0:
        raise SystemExit(f"{path}: no triangles in it")
    return vertices, faces


def write_cloud(path: Path, cloud: Scan) -> None:
    """Write positions (double), normals and colours as binary PLY."""
    fields = [(k, "<f8") for k in "xyz"] + [(f"n{k}", "<f4") for k in "xyz"]
    table = np.zeros(len(cloud.points), dtype=[*fields, *((k, "u1") for k in ("red", "green", "blue"))])
    for k, axis in enumerate("xyz"):
        table[axis], table[f"n{axis}"] = cloud.points[:, k], cloud.normals[:, k]
        table[("red", "green", "blue")[k]] = np.round(255 * cloud.colours[:, k]).astype(np.uint8)
    names = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    kinds = [(name, names[table.dtype[name].str]) for name in table.dtype.names or ()]
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0", "comment photogrammetry", f"element vertex {len(table)}"]
        + [f"property {kind} {name}" for name, kind in kinds]
        + ["end_header\n"]
    )
    path.write_bytes(header.encode() + table.tobytes())


def marker_rows(cloud: Scan, places_mm: dict[str, Floats], sigma_mm: float, seed: int) -> list[str]:
    """Return `label,x,y,z` of places given in the mesh's frame, as the cloud shows them, in cloud units."""
    rng = np.random.default_rng([seed, 1])
    rows = ["label,x,y,z"]
    for label, place in places_mm.items():
        shown = cloud.scale_ratio * cloud.rotation @ (place + rng.normal(0, sigma_mm, 3)) + cloud.translation
        rows.append(",".join([label, *(repr(float(x)) for x in shown)]))
    return rows


def board_mm(vertices_mm: Floats) -> dict[str, Floats]:
    """Return the four coded markers that lie on the table round the specimen, in the mesh's frame."""
    low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
    edge = 0.1 * float(np.linalg.norm(high - low))
    corners = [(low[0] - edge, low[1] - edge), (high[0] + edge, low[1] - edge)]
    corners += [(high[0] + edge, high[1] + edge), (low[0] - edge, high[1] + edge)]
    return {f"B{k + 1}": np.array([x, y, low[2]]) for k, (x, y) in enumerate(corners)}


def datums_mm(vertices_mm: Floats) -> dict[str, Floats]:
    """Return three pen marks on the specimen: its ends along x and y."""
    ends = [np.argmin(vertices_mm[:, 0]), np.argmax(vertices_mm[:, 0]), np.argmax(vertices_mm[:, 1])]
    return {f"D{k + 1}": vertices_mm[end] for k, end in enumerate(ends)}


def write_truth(folder: Path, cloud: Scan, plan: ScanPlan, mesh: Path) -> None:
    """Write the answer key."""
    folder.mkdir(parents=True, exist_ok=True)
    facts: dict[str, Any] = {
        "mesh": str(mesh),
        "plan": asdict(plan),
        "rotation": cloud.rotation.tolist(),
        "translation": cloud.translation.tolist(),
        "scale_ratio": cloud.scale_ratio,
        "unseen_frac": cloud.unseen_frac,
        "points_count": {name: int((cloud.labels == k).sum()) for k, name in enumerate(LABELS)},
    }
    (folder / "scan-truth.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    np.savez_compressed(
        folder / "scan-truth.npz",
        labels=cloud.labels,
        displacement_mm=cloud.displacement_mm.astype(np.float32),
        source_mm=cloud.source_mm.astype(np.float32),
    )


def parser() -> argparse.ArgumentParser:
    """Return the command line of the scanner."""
    made = argparse.ArgumentParser(prog="python -m simulators scanner", description=__doc__)
    source = made.add_mutually_exclusive_group(required=True)
    source.add_argument("--slot", type=Path, help="folder in which the specimen's deployed.ply lies")
    source.add_argument("--mesh", type=Path, help="the deployed mesh itself (PLY, OBJ, STL; mm)")
    made.add_argument("--out", type=Path, required=True, help="the cloud to write (PLY)")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--truth", type=Path, help="folder for the answer key")
    made.add_argument("--scale", default="free", help="free, known (mm), or cloud units per mm")
    made.add_argument("--points", type=int, default=DEFAULTS.points_count, help="points on the specimen")
    made.add_argument("--unseen-frac", type=float, default=DEFAULTS.unseen_frac)
    made.add_argument("--outliers-frac", type=float, default=DEFAULTS.outliers_frac)
    made.add_argument("--noise-frac", type=float, default=DEFAULTS.noise_frac)
    made.add_argument("--smoothing-frac", type=float, default=DEFAULTS.smoothing_frac)
    made.add_argument("--bump-frac", type=float, default=0.0, help="height of a local bump, of the diagonal")
    made.add_argument("--bump-width-frac", type=float, default=DEFAULTS.bump_width_frac)
    made.add_argument("--cameras", type=int, default=DEFAULTS.cameras_count)
    made.add_argument("--background", type=int, default=DEFAULTS.background_count, help="stray things")
    made.add_argument("--no-table", action="store_true")
    made.add_argument("--not-turned", action="store_true", help="keep the mesh's own frame")
    made.add_argument("--mirrored", action="store_true", help="scan the mirror image")
    made.add_argument("--other-side", action="store_true", help="scan the specimen popped to the other side")
    made.add_argument("--markers", type=Path, help="also write the table's coded markers, label,x,y,z")
    made.add_argument("--board", type=Path, help="also write the measured board, label,x,y,z in mm")
    made.add_argument("--shots", type=Path, help="also write the scan's pictures and their COLMAP text model here")
    made.add_argument("--sheet-mm", type=float, nargs=2, default=(300.0, 200.0), help="of the marks in these pictures")
    made.add_argument("--labels", type=Path, help="also write three pen marks on the specimen, label,x,y,z")
    made.add_argument("--datums", type=Path, help="also write where these marks are on the mesh, in mm")
    return made


def plan_from(asked: argparse.Namespace) -> ScanPlan:
    """Return the plan that the command line asks for."""
    scale = {"free": None, "known": 1.0}.get(asked.scale, asked.scale)
    return ScanPlan(
        seed=asked.seed,
        points_count=asked.points,
        unseen_frac=asked.unseen_frac,
        outliers_frac=asked.outliers_frac,
        noise_frac=asked.noise_frac,
        smoothing_frac=asked.smoothing_frac,
        scale_ratio=None if scale is None else float(scale),
        turned=not asked.not_turned,
        table=not asked.no_table,
        background_count=asked.background,
        cameras_count=asked.cameras,
        bump_frac=asked.bump_frac,
        bump_width_frac=asked.bump_width_frac,
        other_side=asked.other_side,
        mirrored=asked.mirrored,
    )


def main(words: list[str]) -> int:
    """Scan once and leave."""
    asked = parser().parse_args(words)
    mesh = asked.mesh or asked.slot / "deployed.ply"
    if not mesh.is_file():
        print(f"scanner: nothing to scan: {mesh} is missing", file=sys.stderr)
        return 2
    plan = plan_from(asked)
    vertices_mm, faces = read_mesh(mesh)
    cloud = scan(vertices_mm, faces, plan)
    write_cloud(asked.out, cloud)
    diagonal_mm = math.dist(vertices_mm.min(axis=0), vertices_mm.max(axis=0))
    for path, places, frame in (
        (asked.markers, board_mm(vertices_mm), "cloud"),
        (asked.board, board_mm(vertices_mm), "mesh"),
        (asked.labels, datums_mm(vertices_mm), "cloud"),
        (asked.datums, datums_mm(vertices_mm), "mesh"),
    ):
        if path is not None and frame == "cloud":
            path.write_text("\n".join(marker_rows(cloud, places, 5e-5 * diagonal_mm, plan.seed)) + "\n")
        elif path is not None:
            rows = [",".join([name, *(repr(float(x)) for x in place)]) for name, place in places.items()]
            path.write_text("\n".join(["label,x,y,z", *rows]) + "\n")
    if asked.shots is not None:
        from simulators.scanshots import write_shots

        write_shots(asked.shots, cloud, vertices_mm, faces, tuple(asked.sheet_mm), plan.seed)
    if asked.truth is not None:
        write_truth(asked.truth, cloud, plan, mesh)
    print(f"scanner: {len(cloud.points)} points to {asked.out}", file=sys.stderr)
    return 0
