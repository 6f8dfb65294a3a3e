"""Mesh files come back as they were written; broken ones are refused with every fault."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.errors import MeshError, UnreadableMesh
from design.meshfiles import read_corner_uv, read_mesh, read_triangles, write_mesh, write_ply
from design.meshformats import parse_obj
from design.surface import TriMesh, check_target
from design.targets import cap

CAP = cap(edge_mm=12)


def refusal(path: Path) -> MeshError:
    with pytest.raises(MeshError) as caught:
        read_mesh(path)
    return caught.value


def codes(fault: MeshError) -> set[str]:
    return {finding.code for finding in fault.findings}


def ascii_ply(mesh: TriMesh) -> str:
    head = ["ply", "format ascii 1.0", f"element vertex {len(mesh.vertices_mm)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(mesh.faces)}", "property list uchar int vertex_index", "end_header"]
    rows = [f"{x!r} {y!r} {z!r}" for x, y, z in mesh.vertices_mm.tolist()]
    return "\n".join([*head, *rows, *(f"3 {a} {b} {c}" for a, b, c in mesh.faces.tolist()), ""])


def ascii_stl(mesh: TriMesh) -> str:
    lines = ["solid s"]
    for corners in mesh.vertices_mm[mesh.faces].tolist():
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x!r} {y!r} {z!r}" for x, y, z in corners]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid s", ""])


@pytest.mark.parametrize("name", ["a.obj", "a.ply"])
def test_a_written_mesh_reads_back_exactly(tmp_path: Path, name: str) -> None:
    write_mesh(tmp_path / name, CAP)
    mesh, found = read_mesh(tmp_path / name)
    assert found == []
    np.testing.assert_array_equal(mesh.vertices_mm, CAP.vertices_mm)
    np.testing.assert_array_equal(mesh.faces, CAP.faces)


def test_binary_stl_is_welded_into_one_surface(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.stl", CAP)
    mesh, found = read_mesh(tmp_path / "a.stl")
    assert found == []
    assert len(mesh.vertices_mm) == len(CAP.vertices_mm)
    np.testing.assert_allclose(mesh.vertices_mm[mesh.faces], CAP.vertices_mm[CAP.faces], atol=1e-5)


def test_ascii_stl_reads_as_the_same_surface(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text(ascii_stl(CAP))
    mesh, _ = read_mesh(tmp_path / "a.stl")
    np.testing.assert_allclose(mesh.vertices_mm[mesh.faces], CAP.vertices_mm[CAP.faces], atol=1e-12)


def test_ascii_ply_reads_as_the_same_surface(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ascii_ply(CAP))
    mesh, _ = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.vertices_mm, CAP.vertices_mm)
    np.testing.assert_array_equal(mesh.faces, CAP.faces)


def test_big_endian_ply_with_colours_and_mixed_polygons_reads(tmp_path: Path) -> None:
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    head += (
        "property uchar red\nelement face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = [(0, 0, 0), (90, 0, 0), (90, 90, 0), (0, 90, 0), (45, 150, 9)]
    body = b"".join(np.array(p, dtype=">f4").tobytes() + b"\7" for p in points)
    body += (
        b"\1\4" + np.array([0, 1, 2, 3], dtype=">i4").tobytes() + b"\1\3" + np.array([3, 2, 4], dtype=">i4").tobytes()
    )
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    mesh, found = read_mesh(tmp_path / "a.ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]
    assert [finding.code for finding in found] == ["MESH-POLYGONS"]


@pytest.mark.parametrize("form", ["{0}", "{0}/{0}", "{0}//{0}", "{0}/{0}/{0}"])
def test_every_way_obj_writes_a_corner_is_understood(tmp_path: Path, form: str) -> None:
    rows = ["v 0 0 0", "v 50 0 0", "v 0 50 0", "vt 0 0", "vt 1 0", "vt 0 1", "vn 0 0 1", "vn 0 0 1", "vn 0 0 1"]
    rows.append("f " + " ".join(form.format(k) for k in (1, 2, 3)))
    (tmp_path / "a.obj").write_text("# comment\n" + "\n".join(rows) + "\n")
    assert read_mesh(tmp_path / "a.obj")[0].faces.tolist() == [[0, 1, 2]]


def test_obj_indices_may_count_from_the_end(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 50 0 0\nv 0 50 0\nf -3 -2 -1\n")
    assert read_mesh(tmp_path / "a.obj")[0].faces.tolist() == [[0, 1, 2]]


def test_texture_corners_follow_their_own_indices(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 50 0 0\nv 0 50 0\nvt 0 1\nvt 0 0\nvt 1 0\nf 1/2 2/3 3/1\n")
    corners_mm, uv = read_corner_uv(tmp_path / "a.obj")
    assert corners_mm[0].tolist() == [[0, 0, 0], [50, 0, 0], [0, 50, 0]]
    assert uv[0].tolist() == [[0, 0], [1, 0], [0, 1]]


def test_pieces_that_touch_all_along_are_welded_with_a_warning(tmp_path: Path) -> None:
    count = len(CAP.faces)
    loose = TriMesh(CAP.vertices_mm[CAP.faces].reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))
    write_ply(tmp_path / "a.ply", loose)
    mesh, found = read_mesh(tmp_path / "a.ply")
    assert len(mesh.vertices_mm) == len(CAP.vertices_mm)
    assert [(finding.code, finding.level) for finding in found] == [("MESH-WELDED", "warning")]


def test_colours_are_written_beside_the_points(tmp_path: Path) -> None:
    colors = np.arange(3 * len(CAP.vertices_mm), dtype=np.int64).reshape(-1, 3) % 255
    write_ply(tmp_path / "a.ply", CAP, colors.astype(np.uint8))
    mesh, _ = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.vertices_mm, CAP.vertices_mm)
    assert b"property uchar green" in (tmp_path / "a.ply").read_bytes()


BROKEN = {
    "missing.ply": (None, "FILE-MISSING"),
    "empty.obj": (b"", "FILE-EMPTY"),
    "blank.stl": (b" \n ", "FILE-EMPTY"),
    "step.stp": (b"ISO-10303-21;", "FILE-FORMAT"),
    "prose.obj": (b"this is a letter\nnot a mesh\n", "FILE-FORMAT"),
    "binary.obj": (b"v 1 2 3\n\0\0\1\2\3", "FILE-BINARY"),
    "prose.ply": (b"hello", "FILE-FORMAT"),
    "headless.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "FILE-TRUNCATED"),
    "prose.stl": (b"hello " * 30, "FILE-FORMAT"),
    "cut.stl": (b"solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0", "FILE-TRUNCATED"),
    "words.obj": (b"v 0 0 0\nv 50 zero 0\nv 0 50 0\nf 1 2 3\n", "FILE-LINE"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_mesh_is_unreadable_and_says_why(tmp_path: Path, name: str) -> None:
    data, code = BROKEN[name]
    if data is not None:
        (tmp_path / name).write_bytes(data)
    fault = refusal(tmp_path / name)
    assert isinstance(fault, UnreadableMesh)
    assert code in codes(fault)
    assert name in str(fault)


@pytest.mark.parametrize("name", ["a.ply", "a.stl"])
@settings(max_examples=25, deadline=None)
@given(part=st.floats(0.02, 0.98))
def test_a_binary_file_cut_anywhere_is_refused(
    tmp_path_factory: pytest.TempPathFactory, name: str, part: float
) -> None:
    path = tmp_path_factory.mktemp("cut") / name
    write_mesh(path, CAP)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    assert isinstance(refusal(path), UnreadableMesh)


def test_a_face_beyond_the_last_vertex_is_refused_with_the_other_faults(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.obj", CAP)
    text = (tmp_path / "a.obj").read_text().replace("v 0.0 0.0", "v nan 0.0", 1)
    (tmp_path / "a.obj").write_text(text + "f 1 2 99999\n")
    assert {"MESH-INDEX", "MESH-NAN"} <= codes(refusal(tmp_path / "a.obj"))


def test_a_scan_may_be_of_any_topology(tmp_path: Path) -> None:
    tetrahedron = TriMesh(np.eye(4, 3) * 50, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    write_ply(tmp_path / "a.ply", tetrahedron)
    assert len(read_triangles(tmp_path / "a.ply")[0].faces) == 4
    assert "MESH-CLOSED" in codes(refusal(tmp_path / "a.ply"))


@pytest.mark.parametrize("name", ["double_dome", "lilium_tower", "vase"])
def test_the_published_targets_are_sound(shared: Path, name: str) -> None:
    mesh, found = read_mesh(shared / "published" / "targets" / f"{name}.obj")
    assert found == []
    assert check_target(mesh) == []


@pytest.mark.parametrize("form", ["{0}", "{0}/{0}", "{0}//{0}", "{0}/{0}/{0}"])
def test_the_quick_and_the_patient_reading_of_obj_agree(form: str) -> None:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in CAP.vertices_mm.tolist()]
    lines += [f"vt {x!r} {y!r}" for x, y, _ in CAP.vertices_mm.tolist()]
    lines += ["vn 0 0 1"] * len(CAP.vertices_mm)
    lines += ["f " + " ".join(form.format(corner) for corner in face) for face in (CAP.faces + 1).tolist()]
    quick, patient = parse_obj("\n".join(lines).encode()), parse_obj("\n".join([*lines, " # patiently"]).encode())
    np.testing.assert_array_equal(quick.points, patient.points)
    np.testing.assert_array_equal(quick.polygons, patient.polygons)
    assert isinstance(quick.polygons, np.ndarray)
    assert isinstance(patient.polygons, list)
    assert (quick.texture is None) == (patient.texture is None)
    if quick.texture is not None:
        np.testing.assert_array_equal(quick.texture_polygons, patient.texture_polygons)


@pytest.mark.parametrize("odd", ["f 1 2 3 4", "f -1 -2 -3", "f 1/1 2/1 3/1", "v 1 2", "f 1 2 x", "curv 0 1"])
def test_an_odd_line_is_not_passed_over(odd: str) -> None:
    lines = ["v 0 0 0", "v 50 0 0", "v 0 50 0", "v 50 50 1", "vt 0 0", "f 1 2 3", odd]
    soup = parse_obj("\n".join(lines).encode())
    assert isinstance(soup.polygons, list)
    assert [finding.code for finding in soup.findings] == (["FILE-LINE"] if odd in ("v 1 2", "f 1 2 x") else [])


def test_a_mesh_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.obj").write_text("as before")

    def fill_the_disk(path: Path, text: str) -> None:
        path.write_bytes(text[:100].encode())
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fill_the_disk)
    with pytest.raises(OSError, match=r"a\.obj"):
        write_mesh(tmp_path / "a.obj", CAP)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["a.obj"]
    assert (tmp_path / "a.obj").read_text() == "as before"
