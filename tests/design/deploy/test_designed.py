"""A pattern's cells become a shell with corners where the target wants them."""

from __future__ import annotations

import numpy as np
import pytest

from design.deploy.designed import designed_layout, lift
from design.deploy.equilibrium import from_flat, rolled


def test_cells_may_run_either_way_round_and_leave_vertices_unused(lattice) -> None:
    flat, cells = lattice(4, 3, 10.0)
    mixed = cells[2:].copy()
    mixed[::2] = mixed[::2, ::-1]
    layout, came_from = designed_layout(flat, mixed, np.full(len(mixed), 1.3), 0.2, 0.3, 0.1)
    assert layout.vertex_count == len(np.unique(mixed))
    assert np.allclose(layout.flat_mm(), flat[came_from])
    a, b, c = (layout.corners_mm[:, k] for k in range(3))
    assert np.all(np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2] > 0)
    assert layout.edge_mm == pytest.approx(10.0)


def test_lifting_follows_the_mesh_and_continues_it_outside(lattice) -> None:
    flat, faces = lattice(6, 6, 5.0)
    space = np.column_stack([2 * flat, flat @ [0.3, -0.2]])
    points = np.array([[0.3, 1.2], [-7.1, 4.4], [25.0, 0.0]])
    assert np.allclose(lift(points, flat, faces, space), np.column_stack([2 * points, points @ [0.3, -0.2]]))


@pytest.mark.parametrize("columns", [24, 25])  # an odd number around: larger units do not meet at the seam
def test_a_sheet_welded_along_its_seam_becomes_a_tube(lattice, columns: int) -> None:
    rows = 8
    flat, cells = lattice(columns, rows, 10.0)
    welds = np.array([[r * (columns + 1), r * (columns + 1) + columns] for r in range(rows + 1)])
    layout, came_from = designed_layout(flat, cells, np.full(len(cells), 1.4), 0.2, 0.3, 0.1, welds)
    assert layout.vertex_count == columns * (rows + 1)
    assert len(came_from) == layout.vertex_count
    found = from_flat(layout, rolled)
    assert found.stable
    radius_mm = np.linalg.norm(found.x_mm[:, :2] - found.x_mm[:, :2].mean(axis=0), axis=1)
    assert radius_mm == pytest.approx(1.4 * columns * 10 / (2 * np.pi), rel=0.02)
