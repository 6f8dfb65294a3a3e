"""The simulated surface away from its apex: its height and lean are those of the deployed mesh."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from design.meshfiles import write_ply
from design.surface import TriMesh
from simulators.rig.controller import Controller, Machine
from simulators.specimens.analytic import linear
from simulators.specimens.curve import Place, Specimen
from simulators.specimens.relief import ReliefError, read_relief

HEAD = "# fabctl response 1; indenter_radius_mm=8; point_mm=0,0,80; direction=0,0,-1\ndepth_mm,load_N,unload_N\n"


def dome(folder: Path, radius_mm: float = 80.0) -> tuple[Path, Path]:
    """Write a sphere's cap, finely meshed, with its apex at (0, 0, radius)."""
    count = 81
    axis = np.linspace(-50, 50, count)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    corners = np.column_stack([x, y, np.sqrt(np.maximum(radius_mm**2 - x**2 - y**2, 0))])
    k = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    write_ply(folder / "deployed.ply", TriMesh(corners, faces))
    (folder / "response.csv").write_text(HEAD + "0,0,0\n1,1,1\n")
    return folder / "deployed.ply", folder / "response.csv"


@pytest.mark.parametrize(("x_mm", "y_mm"), [(0.0, 0.0), (15.0, 0.0), (0.0, -15.0), (20.0, 20.0)])
def test_a_sphere_on_a_dome_meets_it_where_two_spheres_meet(tmp_path: Path, x_mm: float, y_mm: float) -> None:
    place = read_relief(*dome(tmp_path)).at(x_mm, y_mm)
    assert place is not None
    aside = math.hypot(x_mm, y_mm)
    assert place.drop_mm == pytest.approx(88 - math.sqrt(88**2 - aside**2), abs=0.02)
    assert place.lean_ratio == pytest.approx(math.sqrt(1 - (aside / 88) ** 2), abs=0.01)


def test_beside_the_specimen_there_is_nothing(tmp_path: Path) -> None:
    assert read_relief(*dome(tmp_path)).at(70.0, 0.0) is None


def test_a_mesh_that_is_none_is_said(tmp_path: Path) -> None:
    mesh, response = dome(tmp_path)
    mesh.write_text("ply\n")
    with pytest.raises(ReliefError):
        read_relief(mesh, response)


def test_a_leaning_spring_is_softer_upwards_by_the_square_of_the_cosine() -> None:
    device = Controller(Machine(noise_N=0.0, zero_N=0.0, backlash_mm=0.0, contact_mm=2.0), Specimen(linear(0.5)))
    device.place = lambda _x, _y: Place(1.0, 0.8)
    device.look_under()
    device.axis.position_mm = 5.0
    device.advance(1)
    assert device.depth_mm == pytest.approx(2.0)
    assert device.true_N == pytest.approx(0.5 * 2.0 * 0.8**2, rel=1e-6)
