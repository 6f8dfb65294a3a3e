"""A specimen's page says what is known, what is missing, and which run speaks."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from fabctl.records.folder import RunFolder, start_run
from fabctl.reports.indent_step import indent_step
from fabctl.reports.page import render
from fabctl.reports.scan import sentence_of
from fabctl.reports.specimen import specimen_report, telling, verdict
from fabctl.scan.pictures import write_bar
from fabctl.workspace import Specimen, Workspace

SCAN: dict[str, Any] = {
    "deviation": {"rms_mm": 0.5, "rms_frac": 0.0025},
    "tolerance_frac": 0.01,
    "share_within_required_frac": 0.95,
    "verdict": "pass",
}


@pytest.fixture
def lab(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


@pytest.fixture
def specimen(lab: Workspace) -> Specimen:
    (lab.root / "design").mkdir()
    (lab.root / "design/cells.csv").write_text("cell,expansion_ratio,hinge_mm\n0,1.3,0.25\n1,1.5,0.25\n")
    return lab.new_specimen(lab.root / "design")


def run(lab: Workspace, kind: str, status: str, result: dict[str, Any] | None = None, message: str = "") -> RunFolder:
    made = start_run(lab.runs, kind, specimen="S-0001")
    made.path.rename(lab.runs / f"{len(list(lab.runs.iterdir())):03d}-{kind}-x")  # one second holds several
    made = RunFolder(lab.runs / f"{len(list(lab.runs.iterdir())):03d}-{kind}-x")
    if result is not None:
        made.write_result(result)
    made.finish(status, message)
    return made


def test_what_was_not_done_is_named(lab: Workspace, specimen: Specimen) -> None:
    run(lab, "cut", "done", {})
    report = specimen_report(lab, specimen)
    assert report.word == "incomplete"
    assert report.reasons == ("indent: not done yet", "scan: not done yet")
    page = render(report)
    assert "1.300 to 1.500" in page
    assert "not done yet" in page


def test_a_later_failure_takes_nothing_from_an_earlier_result(lab: Workspace, specimen: Specimen) -> None:
    good = run(lab, "scan", "done", SCAN)
    run(lab, "scan", "refused", None, "bin.obj: cannot be compared")
    assert telling(lab.runs_of("S-0001"))["scan"] == good


def test_a_newer_result_replaces_an_older_one(lab: Workspace, specimen: Specimen) -> None:
    run(lab, "scan", "failed")
    run(lab, "scan", "done", SCAN)
    newest = run(lab, "scan", "done", SCAN | {"verdict": "fail"})
    assert telling(lab.runs_of("S-0001"))["scan"] == newest


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({}, "pass"),
        ({"verdict": "fail"}, "fail"),
        ({"tolerance_frac": None}, "incomplete"),
        ({"deviation": None}, "incomplete"),
    ],
)
def test_the_verdict_follows_the_scan(lab: Workspace, specimen: Specimen, change: dict[str, Any], word: str) -> None:
    for kind in ("cut", "indent"):
        run(lab, kind, "done", {})
    run(lab, "scan", "done", SCAN | change)
    assert verdict(telling(lab.runs_of("S-0001")))[0] == word


def test_a_scan_without_a_tolerance_says_which_option_gives_one(lab: Workspace, specimen: Specimen) -> None:
    for kind, result in (("cut", {}), ("indent", {}), ("scan", SCAN | {"tolerance_frac": None})):
        run(lab, kind, "done", result)
    word, _, reasons = verdict(telling(lab.runs_of("S-0001")))
    assert word == "incomplete"
    assert "--tolerance-frac" in reasons[0]


def test_text_from_outside_cannot_become_markup(lab: Workspace, specimen: Specimen) -> None:
    run(lab, "cut", "failed", {}, "<script>alert(1)</script>")
    assert "<script>alert" not in render(specimen_report(lab, specimen))


def test_the_verdict_says_what_was_done_on_simulators(lab: Workspace, specimen: Specimen) -> None:
    made = {"cut": {"bench": {"simulated": True}}, "indent": {"simulated": True}, "scan": {"simulated": False}}
    for kind, config in made.items():
        start_run(lab.runs, kind, specimen="S-0001", config=config).finish("done")
    report = specimen_report(lab, specimen)
    assert report.sentence.endswith("Simulated, on no real device: cut, indent.")
    page = render(report)
    assert "Simulated, on no real device" in page
    assert [step.simulated for step in report.steps] == [False, True, True, False]
    assert page.count('<span class="simulated">') == 2


def test_figures_of_a_curve_are_told_to_the_digits_of_their_uncertainty_and_in_words(
    lab: Workspace, specimen: Specimen
) -> None:
    made = start_run(lab.runs, "indent", specimen="S-0001", config={"conditions": {"humidity_frac": 0.45}})
    found = {"stiffness_secant_N_mm": 0.0069712, "stiffness_secant_ci95_N_mm": 3.91e-5, "hysteresis_ratio": 0.0585}
    made.write_result(found)
    made.finish("done")
    facts = {fact.label: fact.value for fact in indent_step(made, specimen.design).facts}
    assert facts["secant stiffness"] == "0.006971 ± 0.000039 N/mm"
    assert (facts["hysteresis"], facts["humidity"]) == ("5.9 %", "45.0 %")


def test_a_real_bench_is_not_called_simulated(lab: Workspace, specimen: Specimen) -> None:
    start_run(lab.runs, "cut", specimen="S-0001", config={"bench": {"simulated": False, "simulators": {}}}).finish(
        "done"
    )
    assert "imulated" not in specimen_report(lab, specimen).sentence


def test_the_scan_against_the_prediction_is_told_in_fractions_of_the_targets_diagonal() -> None:
    body: dict[str, Any] = {
        "deviation": {"rms_mm": 0.5, "rms_frac": 0.0025, "p95_abs_mm": 0.9, "diagonal_mm": 200.0},
        "against_predicted": {"rms_mm": 0.36, "rms_frac": 0.0017, "diagonal_mm": 212.0},
    }
    assert sentence_of(body).endswith("0.36 mm (0.18 %).")


def test_the_bar_of_colours_is_named_at_its_ends(tmp_path: Path) -> None:
    write_bar(tmp_path / "bar.svg", 2.0, 200.0)
    drawn = (tmp_path / "bar.svg").read_text()
    bar = re.search(r'<rect x="(\d+)" y="4" width="(\d+)"', drawn)
    assert bar is not None
    left, right = int(bar[1]), int(bar[1]) + int(bar[2])
    assert f'x="{left}" y="32" text-anchor="middle">-2 mm' in drawn
    assert f'x="{right}" y="32" text-anchor="middle">+2 mm' in drawn
