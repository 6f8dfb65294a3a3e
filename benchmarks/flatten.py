"""Flattening: the published flats, conformality, spread, infeasible surfaces, time and memory.

`python -m benchmarks flatten [--quick]`; the published data are looked for beside the project or in `FABCTL_SHARED`.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import Figure
from design.flatten import FlattenOptions, Limits, feasibility, flatten
from design.flatten.quality import distortion, signed_areas_mm2
from design.meshfiles import read_corner_uv, read_mesh, weld
from design.surface import TriMesh
from design.targets import TARGETS, double_bump, hemisphere, pierced_cap

LIBRARY = Limits(1.129, 1.775)  # the published range of expansions
SPREADS = {"double_dome": 1.41, "lilium_tower": 1.32, "vase": 1.22}
SIZES = {3_000: (31, 0.03), 50_000: (129, 0.6), 500_000: (408, 18.0)}  # vertices: rings of the mesh, seconds asked for


def measure(words: list[str]) -> list[Figure]:
    """Return every figure; `--quick` leaves out half a million vertices, `--size N` measures one size alone."""
    if words[:1] == ["--size"]:
        return _one_size(int(words[1]))
    figures = [figure for name in SPREADS for figure in _published(name)] + _whole_vase()
    figures += _own_targets() + _infeasible()
    sizes = [size for size in SIZES if size < 100_000 or "--quick" not in words]
    timed = {size: _size_in_its_own_process(size) for size in sizes}
    return figures + [figure for size in sizes for figure in timed[size]] + _growth(timed)


def _growth(timed: dict[int, list[Figure]]) -> list[Figure]:
    """Return the power of the vertex count that the time grows with, from the smallest mesh to the largest."""
    least, most = (timed[size][0] for size in (min(timed), max(timed)))
    power = float(np.log(most.value / least.value) / np.log(most.n / least.n))
    return [
        Figure(
            "time grows with this power of the vertices", power, "", "near linear (taken as < 1.3)", power < 1.3, most.n
        )
    ]


def targets_folder() -> Path | None:
    """Return the folder of published targets, if it is there."""
    shared = Path(os.environ.get("FABCTL_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    folder = shared / "published" / "targets"
    return folder if folder.is_dir() else None


def similarity_residual_ratio(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    """Return the largest distance after the best similarity, over the diagonal of `theirs`."""
    a, b = ours @ [1, 1j], theirs @ [1, 1j]
    a, b = a - a.mean(), b - b.mean()
    return float(np.abs(a * np.vdot(a, b) / np.vdot(a, a) - b).max() / np.linalg.norm(np.ptp(theirs, axis=0)))


def published_corners(folder: Path, name: str, mesh: TriMesh) -> NDArray[np.float64]:
    """Return the published flat at the corners of the mesh's faces, `(3m, 2)`; faces pair up by their centroids."""
    from scipy.spatial import cKDTree

    corners_mm, uv = read_corner_uv(folder / f"{name}_flat.obj")
    pair = cKDTree(corners_mm.mean(axis=1)).query(mesh.vertices_mm[mesh.faces].mean(axis=1))[1]
    return np.asarray(uv[pair].reshape(-1, 2))


def _published(name: str) -> list[Figure]:
    folder = targets_folder()
    if folder is None:
        return [Figure(f"{name}: published data are missing", None, "", "", None, 0)]
    mesh, _ = read_mesh(folder / f"{name}.obj")
    flat = flatten(mesh)
    away = similarity_residual_ratio(flat.flat_mm[flat.faces].reshape(-1, 2), published_corners(folder, name, mesh))
    mean = distortion(mesh, flat.flat_mm, flat.faces).mean_ratio
    best = flatten(mesh, FlattenOptions(boundary="optimised"))
    flips = int(np.count_nonzero(signed_areas_mm2(best.flat_mm, best.faces) <= 0))
    limit, n = SPREADS[name], len(mesh.vertices_mm)
    return [
        Figure(f"{name}: flat against the published one", away, "diagonal", "≤ 2e-4", away <= 2e-4, n),
        Figure(f"{name}: mean quasi-conformal distortion", mean, "ratio", "≤ 1.02", mean <= 1.02, n),
        Figure(f"{name}: spread with u = 0", flat.spread_ratio(), "ratio", "", None, n),
        Figure(
            f"{name}: spread with the boundary programme",
            best.spread_ratio(),
            "ratio",
            f"≤ {limit}, no flips",
            best.spread_ratio() <= limit and flips == 0,
            n,
        ),
    ]


def _whole_vase() -> list[Figure]:
    folder = targets_folder()
    if folder is None:
        return []
    half, _ = read_mesh(folder / "vase.obj")
    vertices_mm = np.vstack([half.vertices_mm, half.vertices_mm * [-1, 1, 1]])
    mesh = weld(TriMesh(vertices_mm, np.vstack([half.faces, half.faces[:, ::-1] + len(half.vertices_mm)])), 1e-3)
    flat = flatten(mesh, FlattenOptions(boundary="optimised"))
    seam = flat.seams[0]
    gap_mm = float(np.abs(flat.flat_mm[seam.left] + seam.translation_mm - flat.flat_mm[seam.right]).max())
    target = "≤ 0.01 after the translation"
    return [
        Figure("whole vase: seam edges apart", gap_mm, "mm", target, gap_mm <= 0.01, len(seam.left)),
        Figure("whole vase: spread", flat.spread_ratio(), "ratio", "", None, len(mesh.vertices_mm)),
    ]


def _own_targets() -> list[Figure]:
    figures = []
    for name in ("cap", "double-bump", "saddle", "freeform", "pierced-cap", "vase"):
        mesh = TARGETS[name]()
        flat = flatten(mesh, FlattenOptions(boundary="optimised"))
        opened = TriMesh(mesh.vertices_mm[flat.target_index], flat.faces)
        mean = distortion(opened, flat.flat_mm, flat.faces).mean_ratio
        n = len(mesh.vertices_mm)
        figures.append(Figure(f"{name}: mean quasi-conformal distortion", mean, "ratio", "≤ 1.02", mean <= 1.02, n))
        figures.append(Figure(f"{name}: spread with the boundary programme", flat.spread_ratio(), "ratio", "", None, n))
    return figures


def _infeasible() -> list[Figure]:
    figures = []
    for name, mesh in {"hemisphere": hemisphere(), "hill 75 mm high": double_bump(height_mm=75)}.items():
        start_s = time.process_time()
        report = feasibility(mesh, LIBRARY, remedy="both")
        spent_s, n = time.process_time() - start_s, len(mesh.vertices_mm)
        cones = [step for step in report.steps if step.rung == "cones"]
        away = report.nearest.rms_ratio if report.nearest else None
        figures += [
            Figure(f"{name}: spread with the best rim", report.steps[1].spread_ratio, "ratio", "", None, n),
            Figure(f"{name}: detected", report.steps[1].fits is False, "", "detected", not report.steps[1].fits, n),
            Figure(f"{name}: proven lower bound", report.bound_ratio, "ratio", "proven", report.proven_infeasible, n),
            Figure(f"{name}: nearest surface", away, "diagonal", "≤ 1 % RMS", away is not None and away <= 0.01, n),
            Figure(f"{name}: cones that make it fit", len(cones), "cones", "on request", bool(cones[-1].fits), n),
            Figure(f"{name}: whole ladder", spent_s, "s CPU", "", None, n),
        ]
    return figures


def _size_in_its_own_process(size: int) -> list[Figure]:
    """Measure in a fresh process, so that the memory is this size's own."""
    import json

    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "flatten", "--json", "--size", str(size)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).resolve().parents[1],
    )
    return [Figure(**figure) for figure in json.loads(done.stdout)["figures"]]


def _one_size(size: int) -> list[Figure]:
    rings, limit_s = SIZES[size]
    mesh = double_bump(edge_mm=75 / rings)
    flatten(pierced_cap(edge_mm=12))  # imports, once
    before_MB = _peak_MB()
    wall_s, cpu_s = _fastest(lambda: flatten(mesh), 5 if size < 10_000 else 1)
    n = len(mesh.vertices_mm)
    return [
        # One thread throughout, so processor time is the wall time of a core that has nothing else to do.
        Figure(f"{size} vertices: time of one core", cpu_s, "s", f"≤ {limit_s} with SciPy alone", cpu_s <= limit_s, n),
        Figure(f"{size} vertices: wall time here and now", wall_s, "s", "", None, n),
        Figure(f"{size} vertices: memory on top of the mesh", _peak_MB() - before_MB, "MB", "given", None, n),
        Figure(f"{size} vertices: memory of the whole process", _peak_MB(), "MB", "given", None, n),
    ]


def _fastest(work: Callable[[], object], tries: int) -> tuple[float, float]:
    times = []
    for _ in range(tries):
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        work()
        times.append((time.perf_counter() - wall_s, time.process_time() - cpu_s))
    return min(times, key=lambda pair: pair[1])


def _peak_MB() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
