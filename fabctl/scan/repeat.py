"""Two scans of one target against each other: what of a deviation comes back when one scans again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.errors import RefusedError, UsageError
from fabctl.records.folder import RunFolder

Floats = NDArray[np.float64]

LEAST_COMMON = 20


@dataclass(frozen=True, slots=True)
class Repeatability:
    """How the deviations of two scans differ, vertex by vertex of their common target."""

    vertices_count: int
    common_frac: float  # of the target's vertices, seen by both
    bias_mm: float  # mean of the second minus the first
    rms_mm: float
    repeatability_mm: float  # standard deviation of one scan: that of the difference, bias removed, by root two
    p95_abs_mm: float
    correlation_ratio: float  # 1: the second scan shows the same deviations as the first


def repeatability(first_mm: Floats, second_mm: Floats) -> Repeatability:
    """Return the comparison of two deviation maps `(n,)` on the same vertices; NaN where a scan saw nothing."""
    both = np.isfinite(first_mm) & np.isfinite(second_mm)
    if both.sum() < LEAST_COMMON:
        raise RefusedError(
            "the scans cannot be compared",
            [Finding("SCAN-COMMON", f"only {int(both.sum())} places were seen by both; {LEAST_COMMON} are needed")],
        )
    a, b = first_mm[both], second_mm[both]
    off = b - a
    spread = float(np.std(a) * np.std(b))
    return Repeatability(
        int(both.sum()),
        float(both.mean()),
        float(off.mean()),
        float(np.sqrt((off**2).mean())),
        float(np.std(off) / np.sqrt(2)),
        float(np.quantile(np.abs(off), 0.95)),
        float(((a - a.mean()) * (b - b.mean())).mean() / spread) if spread > 0 else 0.0,
    )


def compare_runs(first: RunFolder, second: RunFolder) -> Repeatability:
    """Return the repeatability of two scan runs; raises `UsageError` where they are not of the same target."""
    (places, one), (others, two) = _map(first.path), _map(second.path)
    if places.shape != others.shape or not np.allclose(places, others):
        raise UsageError(f"{first.run_id} and {second.run_id} are not scans against the same target")
    return repeatability(one, two)


def _map(run: Path) -> tuple[Floats, Floats]:
    path = run / "artefacts" / "map.npz"
    if not path.is_file():
        raise UsageError(f"{run.name}: no deviation map in it (is it a scan that found its pose?)")
    with np.load(path) as made:
        return np.array(made["vertices_mm"]), np.array(made["deviation_mm"])
