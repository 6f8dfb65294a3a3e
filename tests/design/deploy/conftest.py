"""Sheets to deploy whose answer is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from design.deploy.levels import Layout, sheet_layout
from design.deploy.shell import Ints, Reals
from design.surface import TriMesh


def triangular_lattice(columns: int, rows: int, edge_mm: float) -> tuple[Reals, Ints]:
    """Return vertices and units of a parallelogram-free lattice: rows of triangles, odd rows shifted by half."""
    height = edge_mm * np.sqrt(0.75)
    points = np.array(
        [[c * edge_mm + (r % 2) * edge_mm / 2, r * height] for r in range(rows + 1) for c in range(columns + 1)]
    )
    units = []
    for r in range(rows):
        for c in range(columns):
            a, b = r * (columns + 1) + c, r * (columns + 1) + c + 1
            d, e = a + columns + 1, b + columns + 1
            units += [[a, b, d], [b, e, d]] if r % 2 == 0 else [[a, b, e], [a, e, d]]
    return points - points.mean(axis=0), np.array(units, dtype=np.int64)


def within(points: Reals, units: Ints, keep: np.ndarray) -> tuple[Reals, Ints]:
    """Return the chosen units and their vertices, without units that hang by one vertex alone."""
    units = units[keep]
    count = np.bincount(units.ravel(), minlength=len(points))
    units = units[~np.any(count[units] == 1, axis=1)]
    used, cells = np.unique(units, return_inverse=True)
    return points[used], cells.reshape(-1, 3).astype(np.int64)


@dataclass(frozen=True)
class Cap:
    """A spherical cap's sheet, where its vertices belong, and the sphere."""

    layout: Layout
    design_mm: Reals
    target: TriMesh
    radius_mm: float


def make_cap(edge_mm: float = 10.0, apex_ratio: float = 1.505, D_mJ: float = 0.15, radius_mm: float = 80.0) -> Cap:
    """Return the cap of half-angle 60°, flattened stereographically: λ falls from `apex_ratio` to ¾ of it."""
    reach = 2 * radius_mm / apex_ratio
    flat_radius = reach * np.tan(np.pi / 6)
    n = int(2 * flat_radius / edge_mm) + 6
    points, units = triangular_lattice(n, n, edge_mm)
    centre = points[units].mean(axis=1)
    flat, cells = within(points, units, np.hypot(*centre.T) < flat_radius)
    lam = apex_ratio / (1 + np.sum((flat[cells].mean(axis=1) / reach) ** 2, axis=1))
    layout = sheet_layout(flat, cells, lam, np.array(0.2), np.array(0.3), np.array(D_mJ))
    ring, turn = np.meshgrid(np.linspace(0, np.pi / 2.7, 40), np.linspace(0, 2 * np.pi, 97)[:-1], indexing="ij")
    fine = radius_mm * np.stack([np.sin(ring) * np.cos(turn), np.sin(ring) * np.sin(turn), np.cos(ring)], axis=-1)
    k = np.arange(39)[:, None] * 96 + np.arange(96)
    right = np.arange(39)[:, None] * 96 + (np.arange(96) + 1) % 96
    quads = np.stack([k, k + 96, right + 96, right], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[96:, [0, 1, 3]], quads[:, [1, 2, 3]]])
    return Cap(layout, on_sphere(flat, reach, radius_mm), TriMesh(fine.reshape(-1, 3), faces), radius_mm)


def on_sphere(flat_mm: Reals, reach_mm: float, radius_mm: float) -> Reals:
    """Return the stereographic image of flat points, apex up."""
    polar, turn = 2 * np.arctan(np.hypot(*flat_mm.T) / reach_mm), np.arctan2(flat_mm[:, 1], flat_mm[:, 0])
    return radius_mm * np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=1)


@pytest.fixture(scope="session")
def cap_of() -> Callable[..., Cap]:
    """Return the maker of caps."""
    return make_cap


@pytest.fixture(scope="session")
def lattice() -> Callable[[int, int, float], tuple[Reals, Ints]]:
    """Return the maker of plain lattices."""
    return triangular_lattice
