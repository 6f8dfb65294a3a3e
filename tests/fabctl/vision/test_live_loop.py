"""The whole loop over live processes: marks engraved, the sheet turned by hand, found by camera, cut, and inspected."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import MultiLineString, distance, points

from fabctl.config.boards import config_of, write_board
from fabctl.errors import REFUSED
from fabctl.simulated import stop
from fabctl.testing import SimulatedBench
from fabctl.vision.bed import alignment_path, lens_path
from fabctl.vision.lens import Lens, write_lens
from simulators.camera.burn import on_sheet, read_trace, strokes, to_machine
from simulators.camera.picture import Studio
from simulators.camera.scene import Camera, Pose, Scene, Sheet
from tests.fabctl.vision.conftest import BED, CAMERA, REGISTRATION

F64 = NDArray[np.float64]
ZERO_MM = np.array([300.0, 200.0])  # where the laser's zero is on the bed
LAID, TURNED = Pose(), Pose(0.0, 110.0, 45.0, 0.3)
AT_MM = (10.0, 18.0)
SLITS = [((12 + 9 * c, 24 + 11 * r), (15 + 9 * c, 31 + 11 * r)) for c in range(12) for r in range(2)]
SLITS_TOP_MM = 42.0
DUMMIES = ("target.ply", "flat.ply", "cells.csv", "cut.dxf", "cut.svg", "cut.nc", "deployed.ply", "response.csv")


def write_design(folder: Path) -> Path:
    """Write a design folder by hand: slits, and a tag with room for the id and its code."""
    folder.mkdir()
    paths = [{"layer": "slit", "points_mm": s, "closed": False, "cell": k} for k, s in enumerate(SLITS)]
    drawing = {
        "format": 1,
        "sheet_mm": [130, 64],
        "id_anchor": {"x_mm": 65.0, "y_mm": 18.0, "height_mm": 3.0, "width_mm": 16.0},
        "code_box": {"x_mm": 57.0, "y_mm": 7.0, "width_mm": 14.4, "height_mm": 6.4},
        "paths": paths,
    }
    (folder / "paths.json").write_text(json.dumps(drawing))
    (folder / "spec.yaml").write_text("name: loop\ntarget: cap.obj\nmaterial: natural-rubber-2.3\n")
    for name in DUMMIES:
        (folder / name).write_text(f"{name}\n")
    files = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}
    (folder / "manifest.json").write_text(json.dumps({"format": 1, "files": files}))
    return folder


class Bench:
    """A person at the simulated bench: lays things before the camera, and types commands."""

    def __init__(self, bench: SimulatedBench, lens: Lens) -> None:
        self.bench, self.root = bench, bench.lab.root
        self.state = bench.lab.bench_state("sim")
        write_lens(lens, lens_path(self.state))
        for sheet in (BED, REGISTRATION):
            write_board(config_of(sheet), self.root / "configs" / "boards" / f"{sheet.name}.yaml")
        self.scene = Scene(camera=CAMERA)
        self.lay(self.scene)

    def lay(self, scene: Scene) -> None:
        self.scene = scene
        (self.state / "scene.json").write_text(json.dumps(asdict(scene)))

    def fabctl(self, *words: str, expect: int = 0) -> dict[str, Any]:
        return self.bench.fabctl(*words, expect=expect)

    def refused(self, *words: str) -> set[str]:
        """Return why the command is refused, by the codes of its findings."""
        return {row["code"] for row in self.fabctl(*words, expect=REFUSED)["findings"]}

    def trace(self) -> F64:
        return read_trace(self.state / "laser-trace.csv") + np.array([0.0, *ZERO_MM, 0.0])

    def engraved_and_turned(self) -> Sheet:
        """Align, engrave the sheet's marks, and turn the sheet by hand."""
        made = self.fabctl("camera", "align", "--offset-mm", "-300", "-200")
        assert made["rms_mm"] < 0.05
        sheet = Sheet(REGISTRATION.size_mm, poses=(LAID,), thickness_mm=2.3)
        self.lay(replace(self.scene, sheet=sheet))
        self.fabctl("cut", "marks", "registration", "--material", "natural-rubber-2.3", "--yes")
        turned = replace(sheet, poses=(LAID, replace(TURNED, from_s=float(self.trace()[-1, 0]))))
        self.lay(replace(self.scene, sheet=turned))
        return turned


@pytest.fixture
def bench(simulated_bench: SimulatedBench, lens: Lens) -> Bench:
    return Bench(simulated_bench, lens)


def cut_words(design: Path, at_mm: Sequence[float] = AT_MM) -> list[str]:
    return ["cut", "run", str(design), "--origin", "camera", "--at-mm", *(f"{v:g}" for v in at_mm), "--yes"]


@pytest.mark.slow
def test_a_sheet_engraved_turned_and_found_is_cut_where_it_lies_and_known_again(bench: Bench) -> None:
    sheet = bench.engraved_and_turned()
    design = write_design(bench.root / "design")
    before_s = sheet.poses[-1].from_s
    done = bench.fabctl(*cut_words(design))
    name = done["specimen"]
    run = bench.root / "runs" / done["run"]
    assert {"bed.png", "job-on-bed.png", "registration.json"} <= {p.name for p in (run / "artefacts").iterdir()}
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["config"]["registration"]["turn_rad"] == pytest.approx(TURNED.turn_rad, abs=1e-3)

    # What the beam did, seen from the sheet as it truly lay, is the design.
    burnt = strokes(bench.trace())
    long = np.hypot(*(burnt[:, 2:4] - burnt[:, :2]).T) > 0.02  # where the tag's strokes turn, some micrometres are hot
    burnt = burnt[(burnt[:, 5] > before_s) & (burnt[:, 4] > 0.008) & long]
    cuts = on_sheet(burnt, sheet)[:, :4].reshape(-1, 2, 2)
    design_mm = MultiLineString([(np.array(ends) + AT_MM).tolist() for ends in SLITS])
    assert distance(points(cuts.reshape(-1, 2)), design_mm).max() < 0.15
    assert np.linalg.norm(cuts[:, 1] - cuts[:, 0], axis=1).sum() == pytest.approx(design_mm.length, rel=0.05)

    seen = bench.fabctl("cut", "inspect", name, "-o", "inspection.png")
    assert seen["paths_count"]["cut"] == len(SLITS)
    assert seen["faulty"] == []

    # A photograph from near the tag leads to the specimen and its runs.
    at = on_bed(sheet, np.array([[64.2, 12.0]]) + AT_MM)
    near = Camera(size_px=(640, 480), mm_per_px=0.12, focal_px=1500.0, looks_at_mm=at, tilt_rad=0.3, turn_rad=1.0)
    picture = Studio(replace(bench.scene, camera=near, texel_mm=0.05)).frame(3, bench.trace())
    cv2.imwrite(str(bench.root / "photo.png"), picture)
    (row,) = bench.fabctl("specimen", "read", "photo.png")["specimens"]
    assert (row["id"], row["known"], row["runs"]) == (name, True, [done["run"]])


def on_bed(sheet: Sheet, place_mm: F64) -> tuple[float, float]:
    x, y = to_machine(place_mm, sheet.poses[-1], sheet.size_mm)[0]
    return float(x), float(y)


@pytest.mark.slow
def test_a_knocked_camera_an_old_alignment_a_moved_sheet_and_no_camera_cut_nothing(bench: Bench) -> None:
    sheet = bench.engraved_and_turned()
    design = write_design(bench.root / "design")
    still = bench.scene
    bench.fabctl("camera", "register", "--thickness-mm", "2.3", "-o", "registration.json")
    rows = len(bench.trace())

    bench.lay(replace(still, camera=replace(CAMERA, shift_mm=(0.4, 0.0))))
    assert "ALIGN-DRIFT" in bench.refused(*cut_words(design))

    bench.lay(still)
    path = alignment_path(bench.state)
    stored = path.read_text()
    path.write_text(json.dumps({**json.loads(stored), "made_utc": "2020-01-01T00:00:00+00:00"}))
    assert bench.refused(*cut_words(design)) == {"ALIGN-OLD"}
    path.write_text(stored)

    # Within the travel, but over the sheet's edge: the upper slits reach 1 mm beyond its 100 mm.
    assert "SHEET-OUTLINE" in bench.refused(*cut_words(design, (AT_MM[0], 100.0 - SLITS_TOP_MM + 1.0)))

    # The same marks on a sheet that ends 3 mm before its told right edge.
    short = replace(sheet, size_mm=(REGISTRATION.size_mm[0] - 3.0, REGISTRATION.size_mm[1]))
    bench.lay(replace(still, sheet=short))
    assert bench.refused(*cut_words(design)) == {"SHEET-SHORT"}

    bench.lay(replace(still, sheet=replace(sheet, poses=(*sheet.poses[:1], replace(sheet.poses[1], x_mm=111.0)))))
    assert bench.refused(*cut_words(design), "--camera-file", "registration.json") == {"SHEET-MOVED"}

    # Out of the travel, or with it the marks out of sight.
    bench.lay(replace(still, sheet=replace(sheet, poses=(LAID, replace(sheet.poses[1], x_mm=200.0, y_mm=120.0)))))
    assert bench.refused(*cut_words(design)) & {"CUT-X", "CUT-Y", "MARKS-FEW", "SHEET-SHORT"}

    bench.lay(still)
    stop(bench.state)
    bench.fabctl(*cut_words(design), expect=2)  # nothing runs: `sim up` is named
    assert len(bench.trace()) == rows
    ended = [json.loads(file.read_text())["status"] for file in (bench.root / "runs").glob("*-cut-*/outcome.json")]
    assert set(ended) <= {"failed", "refused"}
