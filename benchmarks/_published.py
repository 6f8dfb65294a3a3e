"""Readers of the published data, for the figures and tests that compare with them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.meshfiles import read_corner_uv

Array = NDArray[np.float64]
SHEET_OFFSET_MM = np.array([-96.949, -96.948])  # published pattern = published flat + this


@dataclass(frozen=True, slots=True)
class PublishedMap:
    """Every second column of the published cell library; energies in its own units."""

    t_mm: Array
    theta_rad: Array
    expansion_ratio: Array
    barrier_mJ: Array
    stiffness_mJ: Array


def table(path: Path) -> Any:
    """Return a CSV with a header as a structured array."""
    return np.genfromtxt(path, delimiter=",", names=True)


def half_map(shared: Path) -> PublishedMap:
    """Return the published half map, for cells of 10 mm."""
    rows = table(shared / "published" / "cell_library_half.csv")
    return PublishedMap(
        t_mm=10 * rows["t_over_l0"],
        theta_rad=rows["theta_rad"],
        expansion_ratio=rows["expansion_ratio"],
        barrier_mJ=rows["energy_barrier"],
        stiffness_mJ=rows["stiffness"],
    )


def flat(shared: Path, name: str) -> tuple[Array, NDArray[np.int64], Array]:
    """Return flat points, faces and area ratio (target over flat) of a published flattening."""
    corners, uv = read_corner_uv(shared / "published" / "targets" / f"{name}_flat.obj")
    points, faces = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    u, v = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return points, faces.reshape(-1, 3), areas / np.abs(0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]))
