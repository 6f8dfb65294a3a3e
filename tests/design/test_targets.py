"""The project's own targets are sound surfaces of the size and shape they promise."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from design.surface import TriMesh, boundary_loops, check_target
from design.targets import TARGETS, cap, cylinder, pierced_cap
from fabctl.cli.target import command

LOOPS = {"pierced-cap": 2, "cylinder": 2, "vase": 2}


@pytest.mark.parametrize("name", TARGETS)
def test_every_target_is_a_sound_surface(name: str) -> None:
    mesh = TARGETS[name]()
    assert check_target(mesh) == []
    assert len(boundary_loops(mesh)) == LOOPS.get(name, 1)


@pytest.mark.parametrize("name", sorted(set(TARGETS) - {"pierced-cap"}))
def test_every_target_has_faces_near_the_edge_length_asked_for(name: str) -> None:
    mesh = TARGETS[name](edge_mm=5.0)
    equilateral_mm2 = math.sqrt(3) / 4 * 5.0**2
    assert 0.3 < np.median(mesh.face_areas_mm2()) / equilateral_mm2 < 2.2


def volume_below_mm3(mesh: TriMesh) -> float:
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("name", ["cylinder", "vase", "cap"])
def test_faces_look_outward(name: str) -> None:
    assert volume_below_mm3(TARGETS[name]()) > 0


def test_the_cap_is_a_quarter_of_its_sphere() -> None:
    area_mm2 = cap(radius_mm=80, edge_mm=2).face_areas_mm2().sum()
    assert area_mm2 == pytest.approx(math.pi * 80**2, rel=1e-3)


def test_cap_and_pierced_cap_lie_on_their_sphere() -> None:
    for mesh in (cap(radius_mm=70), pierced_cap(radius_mm=70)):
        centre_mm = np.array([0, 0, -70 * math.cos(math.pi / 3)])
        assert np.linalg.norm(mesh.vertices_mm - centre_mm, axis=1) == pytest.approx(70, abs=1e-9)


def test_the_cylinder_has_its_radius_and_height() -> None:
    mesh = cylinder(radius_mm=25, height_mm=70)
    assert np.linalg.norm(mesh.vertices_mm[:, :2], axis=1) == pytest.approx(25)
    assert np.ptp(mesh.vertices_mm[:, 2]) == pytest.approx(70)


def test_make_writes_the_target_and_says_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "new" / "dome.obj"
    result = CliRunner().invoke(command, ["make", "cap", "-o", str(path), "--radius-mm", "50", "--json"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["size_mm"][2] == pytest.approx(25, abs=0.01)
    checked = CliRunner().invoke(command, ["check", str(path), "--json"])
    assert json.loads(checked.stdout)["findings"] == []


@pytest.mark.parametrize("words", [["make", "teapot"], ["make", "cap", "--height-mm", "9"]])
def test_what_no_target_has_is_refused_with_what_there_is(tmp_path: Path, words: list[str]) -> None:
    result = CliRunner().invoke(command, [*words, "-o", str(tmp_path / "a.ply")])
    assert result.exit_code != 0
    assert not (tmp_path / "a.ply").exists()


def test_list_names_every_target() -> None:
    result = CliRunner().invoke(command, ["list", "--json"])
    assert set(json.loads(result.stdout)["targets"]) == set(TARGETS)
