"""`fabctl scan run --scale markers` by the scan's own pictures and by picked bars, from files to the record."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from fabctl.cli.main import cli
from fabctl.config.boards import config_of, write_board
from fabctl.errors import RefusedError, UsageError
from fabctl.scan.metric import read_bars, scale_from_bars
from fabctl.vision.boards import scale_marks
from simulators.scanner import main as scanner


@dataclass(frozen=True)
class Scanned:
    home: Path
    unit_mm: float  # the truth


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    """Return a lab with a lopsided cap, its cloud in units of its own, the scan's pictures and their model."""
    home = tmp_path_factory.mktemp("metric")
    x, y = np.meshgrid(np.linspace(-60, 60, 31), np.linspace(-40, 40, 21))
    z = 25 * np.exp(-((x - 15) ** 2 + y**2) / 900) + 0.1 * x
    vertices = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    k = np.arange(30 * 20) // 30 * 31 + np.arange(30 * 20) % 30
    faces = np.vstack([np.column_stack([k, k + 1, k + 32]), np.column_stack([k, k + 32, k + 31])])
    text = [f"v {a:.6f} {b:.6f} {c:.6f}" for a, b, c in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (home / "target.obj").write_text("\n".join(text) + "\n")
    write_board(config_of(scale_marks((300.0, 200.0))), home / "configs/boards/scale.yaml")
    words = ["--mesh", str(home / "target.obj"), "--out", str(home / "cloud.ply"), "--points", "8000", "--seed", "4"]
    assert scanner([*words, "--shots", str(home / "shots"), "--truth", str(home / "truth")]) == 0
    truth = json.loads((home / "truth/scan-truth.json").read_text())
    return Scanned(home, 1 / truth["scale_ratio"])


def run(scanned: Scanned, *words: str, scale: str = "markers") -> dict[str, Any]:
    home = scanned.home
    fixed = ["scan", "run", str(home / "cloud.ply"), "--target", str(home / "target.obj"), "--scale", scale]
    done = CliRunner().invoke(cli, ["--home", str(home), *fixed, *words, "--json"])
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_the_scans_own_pictures_give_its_scale_to_a_fiftieth_of_a_percent(scanned: Scanned) -> None:
    found = run(scanned, "--model", str(scanned.home / "shots"))
    scale = found["scale"]
    error = scale["unit_mm"] / scanned.unit_mm - 1
    assert abs(error) < 2e-4
    assert abs(error) < 2 * scale["sigma_frac"] < 1e-3
    assert scale["markers_count"] == 6
    assert found["pose"]["unit_mm"] == pytest.approx(scale["unit_mm"])
    up = np.array(scale["to_board"])[2, :3] / scale["unit_mm"]
    assert np.linalg.norm(up) == pytest.approx(1.0, abs=1e-6)


def test_the_first_pose_stands_the_cloud_on_the_board(scanned: Scanned) -> None:
    from fabctl.scan.cloud import read_cloud

    to_board = np.array(run(scanned, "--model", str(scanned.home / "shots"))["scale"]["to_board"])
    points = read_cloud(scanned.home / "cloud.ply", 0).points
    labels = np.load(scanned.home / "truth/scan-truth.npz")["labels"]
    placed = points[labels == 0] @ to_board[:3, :3].T + to_board[:3, 3]
    source = np.load(scanned.home / "truth/scan-truth.npz")["source_mm"][labels == 0]
    told = source - [0.0, 0.0, source[:, 2].min()] + [150.0, 100.0, 0.0]
    assert np.median(np.linalg.norm(placed - told, axis=1)) < 0.8  # the cloud's own noise and smoothing


def test_without_its_pictures_or_with_moved_marks_there_is_no_scale(scanned: Scanned, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name in ("cameras.txt", "images.txt"):
        shutil.copy(scanned.home / "shots" / name, tmp_path / name)
    with pytest.raises(Exception, match=r"shot-00\.png"):
        run(scanned, "--model", str(tmp_path))
    write_board(config_of(scale_marks((330.0, 200.0))), tmp_path / "other.yaml")
    with pytest.raises(RefusedError, match="marks"):
        run(scanned, "--model", str(scanned.home / "shots"), "--marks", str(tmp_path / "other.yaml"))
    with pytest.raises(UsageError, match="belong to --scale markers"):
        run(scanned, "--model", str(scanned.home / "shots"), scale="free")


def test_bars_picked_on_the_cloud_give_the_scale(scanned: Scanned, tmp_path: Path) -> None:
    unit = scanned.unit_mm
    rows = ["x1,y1,z1,x2,y2,z2,length_mm", f"0,0,0,{100 / unit},0,0,100.01", f"1,1,1,1,{1 + 150 / unit},1,149.99"]
    (tmp_path / "bars.csv").write_text("\n".join(rows) + "\n")
    found = run(scanned, "--bars", str(tmp_path / "bars.csv"))["scale"]
    assert found["unit_mm"] == pytest.approx(unit, rel=2e-4)
    assert found["markers_count"] == 2
    assert found["sigma_frac"] > 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0,0,0,1,0,0", r"bars\.csv:1: 6 values"),
        ("0,0,0,1,0,0,ten", r"bars\.csv:1: not numbers"),
        ("x1,y1,z1,x2,y2,z2,length_mm\n", "no bars"),
        ("0,0,0,nan,0,0,10", r"bars\.csv:1"),
    ],
)
def test_a_broken_file_of_bars_is_named_by_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "bars.csv").write_text(text)
    with pytest.raises(UsageError, match=said):
        read_bars(tmp_path / "bars.csv")


def test_bars_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bars.csv").write_text("0,0,0,1,0,0,10\n0,0,0,0,1,0,10.2\n")
    with pytest.raises(RefusedError, match="differ by"):
        scale_from_bars(tmp_path / "bars.csv")
