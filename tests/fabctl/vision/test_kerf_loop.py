"""From a coupon's program to the kerf that the toolpath uses, over the simulated laser and a rendered photograph."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fabctl.cli.common import run_guarded
from fabctl.cli.main import cli
from fabctl.config.material import load_material
from fabctl.errors import REFUSED, USAGE
from fabctl.testing import SimulatedBench, _bench
from simulators.camera.burn import kerf_mm, read_trace
from simulators.camera.picture import Studio
from simulators.camera.scene import Beam, Bed, Camera, Pose, Scene, Sheet
from tests.fabctl.vision.test_kerf_in_program import program

BEAM = Beam(0.095, 0.11)
TRAVEL_MM = (300.0, 200.0)


@pytest.fixture
def laser_bench(tmp_path: Path) -> Iterator[SimulatedBench]:
    yield from _bench(tmp_path, ("laser",))


def photograph(trace: Path, size_mm: tuple[float, float], place_mm: tuple[float, float], path: Path) -> None:
    """Write what a camera sees of the sheet, over a light table, after the laser has burned `trace`."""
    w, h = size_mm
    camera = Camera(
        size_px=(round(22 * w), round(22 * h)),
        mm_per_px=0.049,
        focal_px=3000.0,
        looks_at_mm=(w / 2, h / 2),
        tilt_rad=0.03,
        turn_rad=0.05,
        blur_px=1.0,
        distortion_ratio=(-0.02, 0.0, 0.0, 0.0, 0.0),
    )
    sheet = Sheet(size_mm, poses=(Pose(),), grey_frac=0.08, open_frac=0.8, beam=BEAM)
    rows = read_trace(trace) - np.array([0.0, *place_mm, 0.0])
    cv2.imwrite(str(path), Studio(Scene(camera=camera, bed=Bed(size_mm), sheet=sheet, texel_mm=0.0125)).frame(0, rows))


@pytest.mark.slow
def test_a_coupon_is_cut_photographed_measured_and_its_kerf_used(laser_bench: SimulatedBench, tmp_path: Path) -> None:
    made = laser_bench.fabctl("kerf", "coupon", "--material", "natural-rubber-2.3", "--powers", "0.5,0.7", "-o", "c")
    assert laser_bench.fabctl("kerf", "cut", "c", "--dry-run")["run"] is None
    done = laser_bench.fabctl("kerf", "cut", "c", "--yes")
    run = tmp_path / "runs" / done["run"]
    assert (run / "artefacts" / "coupon.json").read_bytes() == (tmp_path / "c" / "coupon.json").read_bytes()

    state = laser_bench.lab.bench_state("sim")
    w, h = made["size_mm"]
    (_, _, x), (_, _, y) = json.loads((run / "manifest.json").read_text())["config"]["placement"]
    photograph(state / "laser-trace.csv", (w, h), (x, y), tmp_path / "photo.png")
    (known,) = laser_bench.fabctl("specimen", "read", "photo.png")["specimens"]
    assert (known["id"], known["runs"]) == (done["specimen"], [done["run"]])
    seen = laser_bench.fabctl("kerf", "measure", "photo.png", "--write")  # the id says which coupon it is
    assert seen["specimen"] == done["specimen"]
    laser_bench.fabctl("kerf", "coupon", "--material", "natural-rubber-2.3", "--powers", "0.5,0.8", "-o", "other")
    laser_bench.fabctl("kerf", "measure", "photo.png", "--coupon", "other/coupon.json", expect=REFUSED)
    laser_bench.fabctl("report", done["specimen"])

    true = [
        np.interp(0.6, [0.5, 0.7], [kerf_mm(p / 25.0, angle, BEAM) for p in (0.5, 0.7)]) for angle in (0, math.pi / 2)
    ]
    assert seen["kerf_mm"] == pytest.approx(np.mean(true), abs=0.01)
    material = load_material("natural-rubber-2.3", tmp_path)
    assert material.laser is not None
    assert material.laser.kerf_mm == pytest.approx(seen["kerf_mm"], abs=1e-4)
    assert program(material.laser.kerf_mm) != program(0.125)


def test_a_coupon_is_no_design_and_a_design_no_coupon(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "coupon.json").write_text("{}")
    for words, said in ((["cut", "run"], "fabctl kerf cut"), (["kerf", "cut"], "not a coupon")):
        monkeypatch.setattr(sys, "argv", ["fabctl", "--home", str(tmp_path), *words, str(tmp_path / "c")])
        assert run_guarded(cli) == USAGE
        assert said in capsys.readouterr().err
