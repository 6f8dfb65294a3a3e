"""A target mesh is judged before it is used: every fault, all at once."""

from __future__ import annotations

import numpy as np
import pytest

from design.findings import errors
from design.surface import TriMesh, boundary_loops, check_target, tidy
from design.targets import cap, cylinder, pierced_cap

CAP = cap(edge_mm=10)
SIDEWAYS_mm = np.array([[20.0, 0, 5], [20, 10, 5]])


def codes(mesh: TriMesh) -> set[str]:
    return {finding.code for finding in check_target(mesh)}


def with_faces(*rows: list[int]) -> TriMesh:
    return TriMesh(CAP.vertices_mm, np.vstack([CAP.faces, np.array(rows)]))


def test_a_sound_surface_has_no_findings() -> None:
    assert check_target(CAP) == []


def test_no_face_is_an_error() -> None:
    assert codes(TriMesh(CAP.vertices_mm, np.empty((0, 3), dtype=np.int64))) == {"MESH-EMPTY"}


def test_vertices_that_are_not_numbers_are_counted_and_named() -> None:
    vertices_mm = CAP.vertices_mm.copy()
    vertices_mm[[3, 7], 1] = np.nan, np.inf
    (finding,) = check_target(TriMesh(vertices_mm, CAP.faces))
    assert finding.code == "MESH-NAN"
    assert "3, 7" in finding.message


def test_three_faces_at_an_edge_are_found() -> None:
    extra = TriMesh(np.vstack([CAP.vertices_mm, [[0, 0, 90.0]]]), CAP.faces)
    one = CAP.faces[0]
    mesh = TriMesh(extra.vertices_mm, np.vstack([CAP.faces, [[one[1], one[0], len(CAP.vertices_mm)]]]))
    assert "MESH-EDGE" in codes(mesh)


def test_two_fans_in_one_point_are_found() -> None:
    tip = int(boundary_loops(CAP)[0][0])
    count = len(CAP.vertices_mm)
    tip_mm = CAP.vertices_mm[tip]
    vertices_mm = np.vstack([CAP.vertices_mm, tip_mm + SIDEWAYS_mm[0], tip_mm + SIDEWAYS_mm[1]])
    mesh = TriMesh(vertices_mm, np.vstack([CAP.faces, [[tip, count, count + 1]]]))
    (finding,) = check_target(mesh)
    assert finding.code == "MESH-VERTEX"
    assert f": {tip}" in finding.message


def test_a_flipped_face_is_found_with_its_edges() -> None:
    faces = CAP.faces.copy()
    faces[20] = faces[20, ::-1]
    (finding,) = check_target(TriMesh(CAP.vertices_mm, faces))
    assert finding.code == "MESH-FLIPPED"
    assert finding.message.startswith("3 edge(s)")


def moebius(turns: int = 1, count: int = 40) -> TriMesh:
    """Return a band of two rows of corners that meets itself after so many half turns."""
    angle = 2 * np.pi * np.arange(count) / count
    middle = 40 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    lean = turns * angle / 2
    across = 8 * np.column_stack([np.cos(lean) * np.cos(angle), np.cos(lean) * np.sin(angle), np.sin(lean)])
    faces = []
    for k in range(count):
        a, b = 2 * k, 2 * k + 1
        c, d = (a + 2, b + 2) if k < count - 1 else ((1, 0) if turns % 2 else (0, 1))
        faces += [[a, c, b], [b, c, d]]
    return TriMesh(np.stack([middle - across, middle + across], axis=1).reshape(-1, 3), np.array(faces))


def test_a_band_with_one_side_is_told_from_flipped_faces() -> None:
    assert codes(moebius(turns=2)) == set()
    (finding,) = check_target(moebius())
    assert finding.code == "MESH-ONE-SIDED"
    assert "cut it across" in finding.hint
    band = moebius(turns=2)
    band.faces[7] = band.faces[7, ::-1].copy()
    assert codes(band) == {"MESH-FLIPPED"}


def test_a_closed_surface_is_refused() -> None:
    tube = cylinder()
    vertices_mm = np.vstack([tube.vertices_mm, [[0, 0, 0], [0, 0, 90.0]]])
    lids = []
    for loop in boundary_loops(tube):
        centre = len(tube.vertices_mm) + int(tube.vertices_mm[loop[0], 2] > 45)
        lids.append(np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), centre)]))
    assert codes(TriMesh(vertices_mm, np.vstack([tube.faces, *lids]))) == {"MESH-CLOSED"}


def test_separate_pieces_are_counted() -> None:
    far = CAP.vertices_mm + np.array([500.0, 0, 0])
    mesh = TriMesh(np.vstack([CAP.vertices_mm, far]), np.vstack([CAP.faces, CAP.faces + len(far)]))
    (finding,) = check_target(mesh)
    assert finding.code == "MESH-COMPONENTS"
    assert "2" in finding.message


def test_a_handle_is_found() -> None:
    columns, rows = 12, 8
    k = np.arange(columns * rows)
    u, v = k % columns, k // columns
    right, above = (u + 1) % columns + v * columns, u + (v + 1) % rows * columns
    corner = (u + 1) % columns + (v + 1) % rows * columns
    faces = np.vstack([np.column_stack([k, right, corner]), np.column_stack([k, corner, above])])[1:]
    a, b = 2 * np.pi * u / columns, 2 * np.pi * v / rows
    ring = 60 + 20 * np.cos(b)
    mesh = TriMesh(np.column_stack([ring * np.cos(a), ring * np.sin(a), 20 * np.sin(b)]), faces)
    assert codes(mesh) == {"MESH-HANDLE"}


@pytest.mark.parametrize(("factor", "level"), [(0.001, "error"), (1 / 25.4, "warning"), (1, None), (1000, "warning")])
def test_sizes_of_other_units_are_noticed(factor: float, level: str | None) -> None:
    found = check_target(TriMesh(CAP.vertices_mm * factor, CAP.faces))
    assert [finding.level for finding in found if finding.code == "MESH-UNITS"] == ([level] if level else [])


def test_a_face_without_area_is_an_error() -> None:
    vertices_mm = CAP.vertices_mm.copy()
    a, b, c = CAP.faces[5]
    vertices_mm[a] = (vertices_mm[b] + vertices_mm[c]) / 2
    assert "MESH-FLAT-FACE" in codes(TriMesh(vertices_mm, CAP.faces))


def test_a_surface_without_area_is_an_error() -> None:
    assert "MESH-AREA" in codes(TriMesh(CAP.vertices_mm * [1, 0, 0], CAP.faces))


def test_several_faults_are_reported_together() -> None:
    faces = CAP.faces.copy()
    faces[20] = faces[20, ::-1]
    vertices_mm = CAP.vertices_mm.copy()
    vertices_mm[0, 0] = np.nan
    far = CAP.vertices_mm + np.array([500.0, 0, 0])
    mesh = TriMesh(np.vstack([vertices_mm, far]), np.vstack([faces, CAP.faces + len(far)]))
    assert {"MESH-NAN", "MESH-FLIPPED", "MESH-COMPONENTS"} <= codes(mesh)


def test_harmless_extras_are_left_out_with_a_word() -> None:
    messy = with_faces(CAP.faces[3].tolist(), [0, 0, 1])
    messy = TriMesh(np.vstack([messy.vertices_mm, [[0, 0, 0.0]]]), messy.faces)
    mesh, found = tidy(messy)
    assert {finding.code for finding in found} == {"MESH-COLLAPSED", "MESH-DUPLICATE", "MESH-UNUSED"}
    assert not errors(found)
    assert len(mesh.faces) == len(CAP.faces)
    assert check_target(mesh) == []


def test_boundary_loops_run_with_their_faces_and_the_longest_comes_first() -> None:
    mesh = pierced_cap(edge_mm=6)
    outer, hole = boundary_loops(mesh)
    assert len(outer) == len(hole)
    assert (
        np.linalg.norm(mesh.vertices_mm[outer, :2], axis=1).min()
        > np.linalg.norm(mesh.vertices_mm[hole, :2], axis=1).max()
    )
    ring = mesh.vertices_mm[outer, :2]
    shoelace = np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - ring[:, 1] * np.roll(ring[:, 0], -1))
    assert shoelace > 0  # counter-clockwise seen from above, as the faces are
