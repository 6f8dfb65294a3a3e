"""Units with two wells snap as the library's own curve says, and take the sheet with them."""

from __future__ import annotations

import numpy as np
import pytest

from design.cells.homogenise import CURVE_SHARES
from design.cells.library import hexagon_mm2, load_library
from design.deploy.cascade import Wells, cascade, cascade_csv, share_of, with_wells
from design.deploy.compare import kabsch
from design.deploy.levels import sheet_layout
from design.deploy.newton import System, solve


@pytest.fixture(scope="module")
def cell():
    library = load_library()
    fair = np.flatnonzero(library.barrier_mJ > np.median(library.barrier_mJ))
    k = int(fair[len(fair) // 2])
    curve = library.energy_curve(float(library.t_mm[k]), float(library.theta_rad[k]))
    energy = curve.energy_mJ / hexagon_mm2(library.sheet)
    return library, k, energy


def sheet_of(lattice, cell, columns: int, rows: int):
    library, k, energy = cell
    flat, cells = lattice(columns, rows, 10.0)
    lam, Y, nu = (float(v[k]) for v in (library.expansion_ratio, library.Y_N_mm, library.nu_tangent_ratio))
    layout = sheet_layout(flat, cells, lam, Y, nu, np.array(0.1))
    saddle = CURVE_SHARES[int(np.argmax(energy[CURVE_SHARES < 1]))]
    many = np.tile(energy, (len(cells), 1))
    return layout, Wells(CURVE_SHARES, many, np.full(len(cells), saddle))


def test_a_single_cell_follows_the_librarys_own_curve(lattice, cell) -> None:
    layout, wells = sheet_of(lattice, cell, 1, 1)
    shell = with_wells(layout.shell(), wells)
    flat = np.column_stack([layout.flat_mm(), np.zeros(layout.vertex_count)])
    energies = [System(shell).energy((1 + s * (shell.expansion_ratio[0] - 1)) * flat) for s in CURVE_SHARES]
    assert np.array(energies) == pytest.approx(wells.energy_mJ_mm2[0] * shell.area_mm2.sum(), rel=1e-9, abs=1e-12)
    saddle = float(wells.saddle_ratio[0])
    for share, end in ((saddle - 0.1, 0.0), (saddle + 0.1, 1.0)):
        rest = solve(System(shell), (1 + share * (shell.expansion_ratio[0] - 1)) * flat)
        assert share_of(shell, rest.x_mm) == pytest.approx(end, abs=0.02)


def test_two_wells_are_differentiated_without_error(lattice, cell) -> None:
    layout, wells = sheet_of(lattice, cell, 3, 2)
    system = System(with_wells(layout.shell(), wells))
    rng = np.random.default_rng(4)
    lam = float(layout.expansion_ratio[0])
    for share in (-0.1, 0.3, 0.7, 1.3):
        x = np.column_stack([(1 + share * (lam - 1)) * layout.flat_mm(), np.zeros(layout.vertex_count)])
        x += 0.2 * rng.normal(size=x.shape)
        way, h = rng.normal(size=x.shape), 1e-5
        slope = (system.energy(x + h * way) - system.energy(x - h * way)) / (2 * h)
        force = (system.gradient(x + h * way)[1] - system.gradient(x - h * way)[1]) / (2 * h)
        assert np.sum(system.gradient(x)[1] * way) == pytest.approx(slope, rel=1e-6)
        found = (system.linearise(x)[2] @ way.ravel()).reshape(x.shape)
        assert np.abs(found - force).max() < 1e-5 * np.abs(force).max()


def test_an_even_sheet_ends_flat_and_expanded(lattice, cell) -> None:
    layout, wells = sheet_of(lattice, cell, 4, 3)
    found = cascade(layout, wells)
    assert found.is_open.all()
    assert found.stable
    assert found.smallest_eigenvalue_N_mm > 0
    assert found.iterations_count > 0
    assert found.residual_ratio < 1e-8
    spread = np.linalg.svd(found.x_mm - found.x_mm.mean(axis=0), compute_uv=False)
    assert spread[2] < 1e-3 * spread[0]
    lam = float(layout.expansion_ratio[0])
    assert share_of(with_wells(layout.shell(), wells), found.x_mm) == pytest.approx(1.0, abs=0.02)
    side = np.linalg.norm(found.x_mm[layout.cells[:, 0]] - found.x_mm[layout.cells[:, 1]], axis=1)
    assert side == pytest.approx(10 * lam, rel=0.01)
    end_mJ = wells.energy_mJ_mm2[0][np.argmin(np.abs(CURVE_SHARES - 1))] * len(layout.cells) * np.sqrt(0.1875) * 100
    assert found.energy_mJ == pytest.approx(end_mJ, rel=1e-3)
    assert len(cascade_csv(found).splitlines()) == len(found.steps) + 1


def test_the_sheet_bulges_to_the_side_it_is_meant_to(cap_of, cell) -> None:
    _, _, energy = cell
    cap = cap_of(edge_mm=20.0)
    many = np.tile(energy, (len(cap.layout.cells), 1))
    wells = Wells(CURVE_SHARES, many, np.full(len(many), CURVE_SHARES[int(np.argmax(energy[CURVE_SHARES < 1]))]))
    for sign in (1.0, -1.0):
        found = cascade(cap.layout, wells, intended_mm=cap.design_mm * [1, 1, sign])
        assert found.is_open.mean() > 0.5
        rotation, shift = kabsch(found.x_mm, cap.design_mm * [1, 1, sign])
        same = np.sqrt(np.mean(np.sum((found.x_mm @ rotation.T + shift - cap.design_mm * [1, 1, sign]) ** 2, axis=1)))
        assert same < 5.0


def test_a_unit_pulled_alone_is_closed_again_by_its_neighbours(lattice, cell) -> None:
    layout, wells = sheet_of(lattice, cell, 4, 3)
    found = cascade(layout, wells, order=[12], hold=False)
    (step,) = found.steps
    assert not step.stays
    assert step.rest_mJ < step.held_mJ  # let go, the sheet only loses energy
    assert found.energy_mJ == pytest.approx(0.0, abs=1e-6)
