"""One specimen through every room of the simulated bench, held against the specimen's own answer key."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fabctl.testing import SimulatedBench

SPEC = """
name: little-cap
target: {make: cap, radius_mm: 60, half_angle_deg: 55}
material: natural-rubber-2.3
scale: {end: high}
"""
DESIGN_FILES = {
    "spec.yaml", "target.ply", "flat.ply", "cells.csv", "paths.json", "cut.dxf", "cut.svg", "cut.nc", "deployed.ply",
    "response.csv", "findings.json", "preview.png", "manifest.json",
}  # fmt: skip


@pytest.mark.slow
def test_design_cut_indent_scan_and_report_agree_with_the_answer_key(simulated_bench: SimulatedBench) -> None:
    home = simulated_bench.lab.root
    spec = str(Path(__file__).parents[2] / "configs/specs/cap.yaml")
    found = simulated_bench.fabctl("flow", spec, "--bench", "sim", "--method", "quick", "--yes")

    assert found["specimen"] == "S-0001"
    assert {p.name for p in (home / "specimens/S-0001/design").iterdir()} >= DESIGN_FILES
    # the curve: what the rig measured is what the specimen was made to answer
    measured, predicted = found["indent"]["stiffness_secant_N_mm"], found["indent"]["predicted_secant_N_mm"]
    assert measured == pytest.approx(predicted, rel=0.1)
    # the scan: the scale the scanner hid, between 0.01 and 100, is found but for what the sheet itself is too large
    key = json.loads((home / "bench-state/sim/truth/scan-truth.json").read_text())
    assert found["scan"]["pose"]["unit_mm"] == pytest.approx(1 / key["scale_ratio"], rel=0.04)
    assert found["verdict"] == "pass"
    page = Path(found["report"]).read_text()
    assert "S-0001" in page
    assert "://" not in page.replace("http://www.w3.org/", "")

    runs = simulated_bench.fabctl("run", "list", "--specimen", "S-0001")["runs"]
    assert [(run["kind"], run["status"]) for run in runs] == [(k, "done") for k in ("cut", "indent", "scan", "report")]


def test_a_bench_with_a_person_stops_after_the_cut_with_a_checklist(simulated_bench: SimulatedBench) -> None:
    home = simulated_bench.lab.root
    (home / "tiny.yaml").write_text(SPEC.replace("radius_mm: 60", "radius_mm: 40") + "response: null\n")
    by_hand = (Path(__file__).parents[2] / "configs/benches/sim.yaml").read_text().replace("automatic", "by_hand")
    (home / "byhand.yaml").write_text(by_hand)
    found = simulated_bench.fabctl("flow", "tiny.yaml", "--bench", "byhand.yaml", "--yes")
    assert "report" not in found
    assert any("--continue S-0001" in line for line in found["next"])


def test_flow_names_what_is_missing_before_anything_is_made(simulated_bench: SimulatedBench) -> None:
    simulated_bench.fabctl("flow", "nowhere.yaml", expect=2)
    simulated_bench.fabctl("flow", "--continue", "S-0099", "--yes", expect=2)
    assert not (simulated_bench.lab.root / "out").exists()
