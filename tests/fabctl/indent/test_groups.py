"""Runs analysed anew in groups: one value a specimen, spreads, the ratio with its intervals, and one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fabctl.cli.indent import command
from fabctl.errors import UsageError
from fabctl.indent.export import export
from fabctl.indent.groups import analyse_groups, parse_groups
from fabctl.indent.recorder import COLUMNS, Row
from fabctl.records.folder import start_run
from fabctl.workspace import Workspace


def add_run(lab: Workspace, specimen: str, stiffness_N_mm: float, seed: int = 0) -> str:
    """Record a spring pressed to 3 mm from 0.6 mm above, and let go with 10 % less force; return the run's id."""
    run = start_run(lab.runs, "indent", specimen=specimen, config={"method": {"secant_mm": 2.0}})
    down = np.arange(-0.6, 3.0, 0.01)
    rng = np.random.default_rng(seed)
    rows, k = [",".join(COLUMNS)], 0
    for step, depth, share in (("load", down, 1.0), ("unload", down[::-1], 0.9)):
        for d in depth:
            k += 1
            force_N = share * stiffness_N_mm * max(d, 0.0) + float(rng.normal(0, 0.001))
            rows.append(Row(k / 100, k, 5 + d, force_N, force_N, step, 0, 1, "moving", "").text())
    (run.path / "samples.csv").write_text("\n".join(rows) + "\n")
    run.write_result({})
    run.finish("done")
    return run.run_id


@pytest.fixture
def lab(tmp_path: Path) -> Workspace:
    """Return a lab with three stiff specimens and three soft ones, one of them tested twice."""
    lab = Workspace(tmp_path)
    (tmp_path / "design").mkdir()
    for k, stiffness in enumerate((0.59, 0.60, 0.61, 0.39, 0.40, 0.41)):
        specimen = lab.new_specimen(tmp_path / "design").name
        add_run(lab, specimen, stiffness, k)
    add_run(lab, "S-0001", 0.63, 9)
    return lab


GROUPS = ("stiff=S-0001,S-0002,S-0003", "soft=S-0004,S-0005,S-0006")


def test_several_runs_of_a_specimen_are_one_specimen(lab: Workspace) -> None:
    found = analyse_groups(parse_groups(lab, (), GROUPS))["groups"]
    assert len(found["stiff"]["runs"]) == 4
    secant = found["stiff"]["stiffness_secant_N_mm"]
    assert secant["count"] == 3
    assert secant["mean"] == pytest.approx((0.61 + 0.60 + 0.61) / 3, rel=2e-3)


def test_the_ratio_of_two_groups_has_fiellers_and_the_bootstrap_interval(lab: Workspace) -> None:
    ratios = analyse_groups(parse_groups(lab, (), GROUPS))["ratios"]
    secant = {ratio["how"]: ratio for ratio in ratios if ratio["figure"] == "stiffness_secant_N_mm"}
    assert set(secant) == {"Fieller", "BCa"}
    for ratio in secant.values():
        assert ratio["value_ratio"] == pytest.approx(1.517, rel=3e-3)
        assert ratio["low_ratio"] < 1.517 < ratio["high_ratio"]
    assert secant["Fieller"]["high_ratio"] - secant["Fieller"]["low_ratio"] > 0.05


def test_one_specimen_a_group_gives_a_ratio_and_says_why_there_is_no_interval(lab: Workspace) -> None:
    ratios = analyse_groups(parse_groups(lab, ("S-0002", "S-0005"), ()))["ratios"]
    secant = next(ratio for ratio in ratios if ratio["figure"] == "stiffness_secant_N_mm")
    assert secant["value_ratio"] == pytest.approx(1.5, rel=5e-3)
    assert secant["low_ratio"] is None
    assert "at least two" in secant["reason"]


def test_the_picture_holds_both_branches_of_every_curve(lab: Workspace, tmp_path: Path) -> None:
    picture = tmp_path / "curves.svg"
    analyse_groups(parse_groups(lab, (), GROUPS), picture)
    text = picture.read_text()
    assert text.count("stroke-dasharray") >= 7  # the ways out
    assert text.count("#0b6e99") >= 8  # four runs of the stiff group, in and out
    assert text.count("#c8502d") >= 6


def test_the_command_names_the_figure_of_each_ratio_and_each_run(lab: Workspace) -> None:
    words = ["analyse", "--group", GROUPS[0], "--group", GROUPS[1]]
    said = CliRunner().invoke(command, words, obj=str(lab.root), catch_exceptions=False).output
    assert "stiff / soft, secant stiffness: 1.5" in said
    assert said.count("secant 0.") == 7


@pytest.mark.parametrize(("words", "why"), [("stiff", "write NAME=RUN"), ("a=S-0099", "S-0099")])
def test_a_group_that_is_none_is_refused(lab: Workspace, words: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        parse_groups(lab, (), [words])


def test_a_run_that_is_no_indentation_is_bad_input_and_told_as_what_it_is(lab: Workspace) -> None:
    scan, refused = start_run(lab.runs, "scan", specimen="S-0001"), start_run(lab.runs, "indent", specimen="S-0002")
    refused.finish("refused", "the rig is not ready")
    for run, said in ((scan, "not an indentation but a scan"), (refused, r"holds no samples.*\(refused\)")):
        with pytest.raises(UsageError, match=said):
            analyse_groups(parse_groups(lab, (run.run_id,), ()))
        with pytest.raises(UsageError, match=said):
            export(run, "csv", lab.root / "samples.csv")
