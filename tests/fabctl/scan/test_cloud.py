"""Every format gives the same points; bad files are refused with a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fabctl.errors import RefusedError, UsageError
from fabctl.scan import cloud, stream
from fabctl.scan.clean import clean
from fabctl.scan.cloud import read_cloud, read_labelled
from fabctl.scan.foreign import open3d

POINTS = np.round(np.random.default_rng(0).uniform(-50, 50, (900, 3)), 3)


def written(folder: Path, kind: str) -> Path:
    path = folder / f"cloud.{kind}"
    if kind in ("xyz", "csv", "txt"):
        np.savetxt(path, POINTS, fmt="%.4f", delimiter="," if kind == "csv" else " ")
    elif kind == "las":
        laspy = pytest.importorskip("laspy")
        made = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
        made.header.scales, made.header.offsets = [1e-4] * 3, [0.0] * 3
        made.x, made.y, made.z = POINTS.T
        made.write(str(path))
    elif kind == "obj":
        path.write_text("\n".join(f"v {x} {y} {z}" for x, y, z in POINTS))
    else:
        o3d = open3d()
        o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS)))
    return path


@pytest.mark.parametrize("kind", ["ply", "pcd", "xyz", "csv", "txt", "obj", "las"])
def test_every_format_gives_the_same_points(tmp_path: Path, kind: str) -> None:
    found = read_cloud(written(tmp_path, kind))
    assert np.allclose(found.points, POINTS, atol=1e-3)


def test_a_scanned_mesh_is_sampled_evenly_and_says_so(tmp_path: Path) -> None:
    from design.meshfiles import write_mesh
    from design.targets import cap

    write_mesh(tmp_path / "scan.stl", cap(edge_mm=10))
    found = read_cloud(tmp_path / "scan.stl")
    assert [f.code for f in found.findings] == ["SCAN-MESH"]
    assert np.ptp(found.points, axis=0)[2] == pytest.approx(40, abs=1)


@pytest.mark.parametrize(
    ("name", "text", "error"),
    [
        ("empty.ply", b"", RefusedError),
        ("prose.xyz", b"this is no cloud\nat all\n", RefusedError),
        ("few.xyz", b"1 2 3\n4 5 6\n", RefusedError),
        ("broken.las", b"LASF but not really", RefusedError),
        ("cloud.docx", b"PK", UsageError),
    ],
)
def test_what_is_no_cloud_is_refused_with_a_reason(
    tmp_path: Path, name: str, text: bytes, error: type[Exception]
) -> None:
    (tmp_path / name).write_bytes(text)
    with pytest.raises(error):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (1.0, 2.0, -0.7)])
def test_points_on_one_straight_line_are_refused(way: tuple[float, float, float]) -> None:
    with pytest.raises(RefusedError, match="SCAN-LINE"):
        clean(np.linspace(0, 90, 900)[:, None] * way + 40.0)


def test_points_that_are_no_numbers_are_left_out_and_counted(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "cloud.xyz", np.concatenate([POINTS, np.full((7, 3), np.nan)]))
    found = read_cloud(tmp_path / "cloud.xyz")
    assert len(found.points) == 900
    assert "7 points" in found.findings[0].message


@pytest.mark.parametrize("kind", ["ply", "xyz", "csv", "las"])
def test_more_points_than_asked_for_are_thinned_and_it_says_so(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, kind)
    found, again = read_cloud(path, seed=1, most=600), read_cloud(path, seed=1, most=600)
    assert len(found.points) == 600
    assert found.findings[0].code == "SCAN-THINNED"
    assert "900 points were thinned to 600" in found.findings[0].message
    assert np.array_equal(found.points, again.points)
    assert not np.array_equal(found.points, read_cloud(path, seed=2, most=600).points)


def test_a_file_read_in_small_pieces_is_drawn_evenly(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    table = np.zeros(
        20_000, dtype=[("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("red", ">f4"), ("green", ">f4"), ("blue", ">f4")]
    )
    table["x"], table["y"], table["blue"] = np.arange(20_000), 1.0, 0.5
    lines = ["ply", "format binary_big_endian 1.0", "element vertex 20000"]
    lines += [f"property float {name}" for name in table.dtype.names or ()]
    (tmp_path / "big.ply").write_bytes("\n".join([*lines, "end_header\n"]).encode() + table.tobytes())
    monkeypatch.setattr(stream, "PIECE", 700)
    found = read_cloud(tmp_path / "big.ply", most=2000)
    assert len(np.unique(found.points[:, 0])) == 2000
    assert np.histogram(found.points[:, 0], bins=4)[0] == pytest.approx(500, abs=90)
    assert found.colours is not None
    assert (found.colours == [0, 0, 128]).all()


@pytest.mark.parametrize(("kind", "full"), [("f4", 1.0), ("f4", 255.0), ("u1", 255), ("u2", 65535)])
def test_colours_of_a_ply_are_brought_to_one_range(tmp_path: Path, kind: str, full: float) -> None:
    table = np.zeros(900, dtype=[("x", "<f8"), ("y", "<f8"), ("z", "<f8"), *((k, "<" + kind) for k in cloud.RGB)])
    table["x"], table["y"], table["z"] = POINTS.T
    table["red"], table["blue"][:450] = full, full
    word = {"f4": "float", "u1": "uchar", "u2": "ushort"}[kind]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 900", *(f"property double {k}" for k in "xyz")]
    lines += [f"property {word} {k}" for k in cloud.RGB]
    (tmp_path / "cloud.ply").write_bytes("\n".join([*lines, "end_header\n"]).encode() + table.tobytes())
    found = read_cloud(tmp_path / "cloud.ply")
    assert found.colours is not None
    assert found.colours[[0, 899]].tolist() == [[255, 0, 255], [255, 0, 0]]


def test_a_ply_that_ends_too_early_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "ply")
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(RefusedError, match="ends after"):
        read_cloud(path)


@pytest.mark.parametrize("gain", [1, 255])
def test_colours_and_normals_of_a_text_file_are_known_by_their_range(tmp_path: Path, gain: int) -> None:
    normals = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    colours = np.random.default_rng(1).integers(0, 256, POINTS.shape) / 255 * gain
    table = np.concatenate([POINTS, normals, colours], axis=1)
    (tmp_path / "cloud.xyz").write_text(
        "x y z nx ny nz r g b\n" + "\n".join(" ".join(f"{v:.6f}" for v in row) for row in table)
    )
    found = read_cloud(tmp_path / "cloud.xyz")
    assert found.normals is not None
    assert found.colours is not None
    assert np.allclose(found.normals, normals, atol=1e-4)
    assert np.allclose(found.colours, np.round(colours / gain * 255), atol=1)


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("z,x,y,intensity,ny,nz,nx,b,g,r", "zxyinnnbgr"),
        ('"Points:2";"Points:0";"Points:1";"Blue";"Red";"Green"', "zxybrg"),
        ("//R G B X Y Z", "rgbxyz"),
        ("# y [mm]\tz [mm]\tx [mm]", "yzx"),
        ("id time x_mm y_mm z_mm red green blue", "iixyzrgb"),
    ],
)
def test_columns_named_in_a_header_are_taken_by_their_names(tmp_path: Path, header: str, order: str) -> None:
    normals = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    seen = np.random.default_rng(1).integers(0, 256, (len(POINTS), 3))
    turned = iter((1, 2, 0))
    of = {"x": POINTS[:, 0], "y": POINTS[:, 1], "z": POINTS[:, 2], "i": np.arange(len(POINTS))}
    of |= {"r": seen[:, 0], "g": seen[:, 1], "b": seen[:, 2]}
    table = np.column_stack([normals[:, next(turned)] if c == "n" else of[c] for c in order])
    mark = next((m for m in ";,\t" if m in header), " ")
    np.savetxt(tmp_path / "cloud.csv", table, delimiter=mark, header=header, comments="", fmt="%.6f")
    found = read_cloud(tmp_path / "cloud.csv")
    assert np.allclose(found.points, POINTS)
    assert "SCAN-COLUMNS" in [f.code for f in found.findings]
    if "r" in order:
        assert found.colours is not None
        assert np.array_equal(found.colours, seen)
    if "n" in order:
        assert found.normals is not None
        assert np.allclose(found.normals, normals, atol=1e-5)


def test_a_unit_in_the_header_is_told_and_not_applied(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "cloud.csv", POINTS / 1000, delimiter=",", header="x_m,y_m,z_m", comments="")
    found = read_cloud(tmp_path / "cloud.csv")
    assert np.allclose(found.points, POINTS / 1000)
    assert "--unit-mm 1000" in found.findings[0].hint


@pytest.mark.parametrize("header", ["x,y,z,x", "x_mm,y_m,z_mm", "x,y,z,intensity,nx,ny,nz"])
def test_a_header_that_contradicts_itself_or_the_rows_is_refused(tmp_path: Path, header: str) -> None:
    table = np.column_stack([POINTS, POINTS[:, 0]])
    np.savetxt(tmp_path / "cloud.csv", table, delimiter=",", header=header, comments="")
    with pytest.raises(RefusedError) as refused:
        read_cloud(tmp_path / "cloud.csv")
    assert refused.value.findings[0].code == "SCAN-HEADER"


@pytest.mark.parametrize("mark", [";", " ", "\t"])
def test_numbers_with_a_decimal_comma_are_read_as_such(tmp_path: Path, mark: str) -> None:
    lines = [mark.join(f"{value:.3f}".replace(".", ",") for value in row) for row in POINTS]
    (tmp_path / "cloud.csv").write_text("\n".join(lines))
    assert np.allclose(read_cloud(tmp_path / "cloud.csv").points, POINTS)


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_a_pcd_with_other_fields_and_missing_points_is_read(tmp_path: Path, form: str) -> None:
    table = np.column_stack([POINTS, np.arange(len(POINTS))]).astype(np.float32)
    table[3, :3] = np.nan
    head = "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA {form}\n"
    rows = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in table).encode()
    (tmp_path / "cloud.pcd").write_bytes(head.encode() + (rows if form == "ascii" else table.tobytes()))
    found = read_cloud(tmp_path / "cloud.pcd")
    assert np.allclose(found.points, np.delete(POINTS, 3, axis=0), atol=1e-3)
    assert [f.code for f in found.findings] == ["SCAN-NAN"]


@pytest.mark.parametrize("form", ["binary_big_endian", "binary_little_endian", "ascii"])
def test_a_ply_with_other_properties_and_empty_faces_is_read(tmp_path: Path, form: str) -> None:
    order = ">" if "big" in form else "<"
    kinds = [
        ("confidence", "f4"),
        ("z", "f8"),
        ("x", "f8"),
        ("y", "f8"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
    ]
    table = np.zeros(len(POINTS), dtype=[(n, order + k) for n, k in kinds])
    table["x"], table["y"], table["z"] = POINTS.T
    table["green"] = 77
    said = {"f4": "float", "f8": "double", "u1": "uchar"}
    head = ["ply", f"format {form} 1.0", "comment made by hand", f"element vertex {len(table)}"]
    head += [f"property {said[k]} {n}" for n, k in kinds]
    head += ["element face 0", "property list uchar int vertex_indices", "end_header", ""]
    body = "\n".join(" ".join(str(v) for v in row) for row in table).encode() if form == "ascii" else table.tobytes()
    (tmp_path / "cloud.ply").write_bytes("\n".join(head).encode() + body)
    found = read_cloud(tmp_path / "cloud.ply")
    assert np.array_equal(found.points, POINTS)
    assert found.colours is not None
    assert np.array_equal(found.colours[0], [0, 77, 0])


def test_every_bad_line_of_a_label_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "marks.csv").write_text("label,x,y,z\na,1,2,3\nb,1,2\na,4,5,6\n")
    with pytest.raises(RefusedError) as fault:
        read_labelled(tmp_path / "marks.csv")
    assert len(fault.value.findings) == 2
