"""Every format gives the same points; bad files are refused with a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fabctl.errors import RefusedError, UsageError
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


def test_points_that_are_no_numbers_are_left_out_and_counted(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "cloud.xyz", np.concatenate([POINTS, np.full((7, 3), np.nan)]))
    found = read_cloud(tmp_path / "cloud.xyz")
    assert len(found.points) == 900
    assert "7 points" in found.findings[0].message


def test_more_points_than_asked_for_are_thinned_and_it_says_so(tmp_path: Path) -> None:
    found = read_cloud(written(tmp_path, "xyz"), seed=1, most=600)
    assert len(found.points) == 600
    assert found.findings[0].code == "SCAN-THINNED"


def test_every_bad_line_of_a_label_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "marks.csv").write_text("label,x,y,z\na,1,2,3\nb,1,2\na,4,5,6\n")
    with pytest.raises(RefusedError) as fault:
        read_labelled(tmp_path / "marks.csv")
    assert len(fault.value.findings) == 2
