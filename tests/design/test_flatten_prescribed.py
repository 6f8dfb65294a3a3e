"""A rim whose scale factors a specification gives at a few places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from design.errors import FlattenError
from design.flatten.prescribed import rim_u_through
from design.meshfiles import write_obj
from design.pipeline import lay_flat
from design.surface import TriMesh, boundary_loops
from design.targets import cap
from fabctl.designing import read_inputs
from fabctl.errors import ConfigError

MESH = cap(radius_mm=60, edge_mm=6)
RIM = boundary_loops(MESH)[0]


def spec(folder: Path, flatten: str) -> str:
    write_obj(folder / "cap.obj", MESH)
    (folder / "spec.yaml").write_text(f"name: x\ntarget: cap.obj\nresponse: null\nflatten: {flatten}\n")
    return str(folder / "spec.yaml")


def test_values_at_places_are_met_and_change_evenly_along_the_rim() -> None:
    half = len(RIM) // 2
    u = rim_u_through(MESH, MESH.vertices_mm[RIM[[0, half]]], np.array([0.0, 0.1]))
    assert u[RIM[0]] == 0 and u[RIM[half]] == pytest.approx(0.1)
    corners = MESH.vertices_mm[RIM[: half + 1]]
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    assert u[RIM[: half + 1]] == pytest.approx(0.1 * along / along[-1])
    assert not u[np.setdiff1d(np.arange(len(u)), RIM)].any()


def test_a_rim_without_a_place_keeps_its_length() -> None:
    hole = np.linalg.norm(MESH.vertices_mm[MESH.faces].mean(axis=1)[:, :2], axis=1) > 15
    open_mesh = TriMesh(MESH.vertices_mm, MESH.faces[hole])
    outer, inner = boundary_loops(open_mesh)
    u = rim_u_through(open_mesh, open_mesh.vertices_mm[inner[:1]], np.array([0.2]))
    assert (u[inner] == 0.2).all() and not u[outer].any()


def test_every_place_off_the_rim_is_told() -> None:
    places = np.array([[0, 0, 60.0], MESH.vertices_mm[RIM[0]], [0, 0, -300]])
    with pytest.raises(FlattenError) as fault:
        rim_u_through(MESH, places, np.zeros(3))
    assert [finding.where for finding in fault.value.findings] == ["(0, 0, 60)", "(0, 0, -300)"]


def test_a_specification_prescribes_the_rim_and_the_flat_takes_it(tmp_path: Path) -> None:
    rows = [[*map(float, MESH.vertices_mm[RIM[k]]), u] for k, u in ((0, 0.0), (len(RIM) // 2, 0.06))]
    inputs = read_inputs(spec(tmp_path, f"{{boundary: prescribed, rim_u: {rows}}}"), tmp_path)
    flat = lay_flat(inputs.spec, inputs.mesh, None, [])
    shift = flat.u[RIM] - inputs.spec.flatten.boundary_u[RIM]
    assert np.ptp(flat.u[RIM]) == pytest.approx(0.06)
    assert np.ptp(shift) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    "flatten",
    [
        "{boundary: prescribed}",
        "{rim_u: [[0, 0, 0, 0.1]]}",
        "{boundary: prescribed, rim_u: [[0, 0, 0, 0.1]], cones_count: 1}",
        "{boundary: prescribed, rim_u: [[0, 0, 0, 9]]}",
        "{boundary: prescribed, rim_u: []}",
    ],
)
def test_a_prescription_that_says_nothing_or_too_much_is_refused(flatten: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="rim_u"):
        read_inputs(spec(tmp_path, flatten), tmp_path)
