"""The simulated scanner shows what it should and hides what it must."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from design.meshfiles import write_mesh
from design.targets import cap
from simulators.photogrammetry import LABELS, ScanPlan, scan

MESH = cap(edge_mm=8)
PLAN = ScanPlan(seed=4, points_count=6000, unseen_frac=0.3, cameras_count=10)


def test_the_same_seed_gives_the_same_cloud_and_another_one_another() -> None:
    one, same = (scan(MESH.vertices_mm, MESH.faces, PLAN) for _ in range(2))
    other = scan(MESH.vertices_mm, MESH.faces, ScanPlan(seed=5, points_count=6000, cameras_count=10))
    assert np.array_equal(one.points, same.points)
    assert one.scale_ratio != other.scale_ratio


def test_the_kept_pose_carries_the_mesh_into_the_cloud() -> None:
    made = scan(MESH.vertices_mm, MESH.faces, PLAN)
    body = made.labels == 0
    shown = made.scale_ratio * made.source_mm[body] @ made.rotation.T + made.translation
    off = np.linalg.norm(shown - made.points[body], axis=1) / made.scale_ratio
    assert np.median(off) < 0.01 * MESH.diagonal_mm()


def test_as_much_is_unseen_and_wrong_as_was_asked_for() -> None:
    made = scan(MESH.vertices_mm, MESH.faces, PLAN)
    assert made.unseen_frac == pytest.approx(0.3, abs=0.01)
    body, stray = (made.labels == 0).sum(), (made.labels == LABELS.index("outlier")).sum()
    assert stray / (stray + body) == pytest.approx(0.05, abs=0.005)


def test_the_truth_lies_in_its_own_folder_and_not_in_the_cloud(tmp_path: Path) -> None:
    slot, truth = tmp_path / "slot", tmp_path / "truth"
    slot.mkdir()
    write_mesh(slot / "deployed.ply", MESH)
    words = ["scanner", "--slot", str(slot), "--out", str(tmp_path / "cloud.ply"), "--truth", str(truth)]
    words += ["--points", "3000", "--cameras", "6", "--seed", "1"]
    subprocess.run([sys.executable, "-m", "simulators", *words], check=True, capture_output=True)
    assert sorted(p.name for p in truth.iterdir()) == ["scan-truth.json", "scan-truth.npz"]
    facts = json.loads((truth / "scan-truth.json").read_text())
    header = (tmp_path / "cloud.ply").read_bytes()[:400]
    assert str(facts["scale_ratio"]).encode() not in header
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cloud.ply", "slot", "truth"]


def test_without_a_specimen_the_scanner_says_what_is_missing(tmp_path: Path) -> None:
    words = ["scanner", "--slot", str(tmp_path), "--out", str(tmp_path / "cloud.ply")]
    done = subprocess.run([sys.executable, "-m", "simulators", *words], check=False, capture_output=True, text=True)
    assert done.returncode == 2
    assert "deployed.ply" in done.stderr
