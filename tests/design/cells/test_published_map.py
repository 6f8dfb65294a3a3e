"""A published map is a library like any other, and what it does not hold is not made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks._published import table
from design.cells.library import LibraryError, load_library
from design.cells.select import SelectionOptions, select
from design.cells.sheet import Sheet
from design.hinged import hinged
from design.pattern.slits import HingeOptions
from fabctl.designing import build_folder

ROOT = Path(__file__).resolve().parents[3]
HEAD = "t_over_l0,theta_rad,expansion_ratio,energy_barrier,stiffness\n"


def map_text(t_step: float = 0.004, theta_step: float = 0.02) -> str:
    """Return a map of the shipped library on another grid, of one mesh as a published one is, in its unit of energy."""
    library, sheet = load_library().firm(), Sheet()
    t, theta = np.meshgrid(np.arange(0.05, 0.29, t_step), np.arange(-0.3, 0.5, theta_step), indexing="ij")
    cells = library.at(10 * t, theta)
    per_mJ = 800 / (sheet.E_MPa * sheet.thickness_mm * sheet.edge_mm**2)
    columns = (t, theta, cells.expansion_ratio, cells.barrier_mJ * per_mJ, cells.stiffness_mJ * per_mJ)
    rows = np.column_stack([column[cells.inside] for column in columns])
    return HEAD + "\n".join(",".join(f"{value:.9g}" for value in row) for row in rows) + "\n"


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.csv"
    path.write_text(map_text())
    return path


def test_a_map_of_our_own_cells_gives_them_back(map_file: Path) -> None:
    ours, theirs = load_library(), load_library(map_file)
    wanted = np.linspace(1.25, 1.7, 40)
    a, b = (select(one, wanted, SelectionOptions("stiffest")) for one in (ours, theirs))
    assert a.stiffness_mJ == pytest.approx(b.stiffness_mJ, rel=0.01)
    at = ours.at(b.t_mm, b.theta_rad)
    assert at.expansion_ratio == pytest.approx(wanted, abs=5e-4)
    assert np.isfinite(theirs.nu_tangent_ratio).all()
    assert theirs.counts()["not in the map"] > theirs.counts()["not converged"] == 0
    assert theirs.at(b.t_mm, b.theta_rad).nu_tangent_ratio == pytest.approx(at.nu_tangent_ratio, abs=0.01)


def test_a_map_scales_with_the_sheet_and_takes_other_hinges(map_file: Path) -> None:
    theirs = load_library(map_file)
    small = theirs.scaled(Sheet(edge_mm=5, slit_mm=0.0625, hinge_mm=0.125))
    assert small.t_mm == pytest.approx(theirs.t_mm / 2)
    with pytest.raises(LibraryError):
        theirs.scaled(Sheet(slit_mm=0.2))
    wide = HingeOptions(width_mm=0.35)
    at = [hinged(one, wide).at(1.0, 0.2).expansion_ratio for one in (load_library(), theirs)]
    assert at[1] == pytest.approx(at[0], abs=5e-4)


def test_a_map_has_no_energy_curves_and_says_so(map_file: Path) -> None:
    with pytest.raises(LibraryError, match="no energy curves"):
        load_library(map_file).energy_curve(1.0, 0.2)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a,b\n1,2\n",
        HEAD,
        HEAD + "0.1,0.2,1.5,1,1\n",
        map_text().replace("0.054,", "0.0553,"),  # a row off the grid
        map_text() + map_text().splitlines()[-1] + "\n",  # an entry twice
    ],
    ids=["empty", "columns", "rows", "too few", "uneven", "twice"],
)
def test_what_is_no_map_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "none.csv"
    path.write_text(text)
    with pytest.raises(LibraryError, match="not a published map"):
        load_library(path)
    with pytest.raises(LibraryError):
        load_library(tmp_path / "missing.csv")


def test_the_published_sheet_comes_out_of_one_command(shared: Path, tmp_path: Path) -> None:
    published = shared / "published"
    half = published / "cell_library_half.csv"
    target = published / "targets" / "double_dome_flat.obj"
    design, bundle = build_folder("published", tmp_path / "out", ROOT, target, library=half)
    cells = table(published / "double_dome_pattern_cells.csv")
    theirs = np.column_stack([cells["cx_mm"], cells["cy_mm"]])
    ours = np.array([[float(row["cx_mm"]), float(row["cy_mm"])] for row in bundle.cells()])
    ours += theirs.mean(axis=0) - ours.mean(axis=0)
    away = np.linalg.norm(ours[:, None] - theirs, axis=2)
    row = away.argmin(axis=1)
    assert away.min(axis=1).max() < 0.001 and len(np.unique(row)) == len(cells) == len(ours)
    same = np.isclose(design.cells.choice.t_mm, 10 * cells["t_over_l0_lib"][row])
    same &= np.isclose(design.cells.choice.theta_rad, cells["theta_rad_lib"][row])
    assert same.sum() == 157  # of 332: those whose entry lies in the half map
    assert design.cells.hinge_mm[same] == pytest.approx(cells["hinge_width_mm"][row][same], abs=1e-4)
    kept = (bundle.path / "spec.yaml").read_text()
    assert f'library: "{half.resolve()}"' in kept
