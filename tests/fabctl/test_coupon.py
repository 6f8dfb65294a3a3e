"""A coupon's filled form is read back against the map, and one that is not filled in is refused with all its faults."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from design.coupon import PatchAsCut
from fabctl.cli.main import cli
from fabctl.config.coupon import CouponConfig
from fabctl.config.material import load_material
from fabctl.coupon import open_coupon, read_form
from fabctl.cut.compose import composer, open_design, sheet_of
from fabctl.cut.program import read_program
from fabctl.designing import write_coupon
from fabctl.errors import BundleError, RefusedError, UsageError
from fabctl.events import Event
from fabctl.records.folder import start_run
from fabctl.reports.page import render
from fabctl.reports.specimen import specimen_report
from fabctl.workspace import Specimen, Workspace

ROOT = Path(__file__).resolve().parents[2]

HEAD = "patch,hinge_mm,expected_expansion_ratio,flat_length_mm,measured_length_mm,cycles_count,failed_at\n"
CUT = {"A": PatchAsCut(0.2, 1.51), "B": PatchAsCut(0.25, 1.5), "C": PatchAsCut(0.6, None)}
FILLED = HEAD + "A,0.2,1.5100,60,90.4 90.6 90.8,100,\nB,0.25,1.5000,60,92.0,40,37\nC,0.6,,60,60.1,3,\n"


def form(folder: Path, text: str) -> Path:
    path = folder / "coupon.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_measured_expansions_stand_beside_the_expected_with_their_uncertainty(tmp_path: Path) -> None:
    a, b, c = read_form(form(tmp_path, FILLED), 0.2, CUT)
    assert a.expansion_ratio == pytest.approx(90.6 / 60) and a.readings_count == 3
    assert a.uncertainty_ratio == pytest.approx(2 * ((0.2 / 60) ** 2 + (0.2 / 60) ** 2 / 3) ** 0.5)
    assert a.agrees() is True and b.agrees() is False
    assert b.off_ratio() == pytest.approx(92 / 60 - 1.5) and (b.cycles_count, b.failed_at_count) == (40, 37)
    assert c.expected_ratio is None and c.agrees() and c.off_ratio() == pytest.approx(0.1 / 60)


def test_every_fault_of_a_form_is_told_at_once(tmp_path: Path) -> None:
    text = HEAD + "A,0.2,1.5,60,,10,\nB,0.25,1.5,60,9o.1,ten,\nC,0.6,,60,905,5,9\nC,0.6,,60,90,-1,\n"
    with pytest.raises(RefusedError) as caught:
        read_form(form(tmp_path, text), 0.2, CUT)
    codes = [finding.code for finding in caught.value.findings]
    assert codes.count("COUPON-NUMBER") == 4
    assert {"COUPON-CYCLES", "COUPON-LENGTH", "COUPON-TWICE"} <= set(codes)
    with pytest.raises(RefusedError):
        read_form(form(tmp_path, "a,b\n1,2\n"), 0.2, CUT)
    with pytest.raises(UsageError, match="no such file"):
        read_form(tmp_path / "nothing.csv", 0.2, CUT)


@pytest.fixture
def lab(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


@pytest.fixture
def specimen(lab: Workspace) -> Specimen:
    """A coupon of two hinges that was cut."""
    write_coupon(lab.root / "coupon", CouponConfig(hinges_mm=(0.25, 0.4)), ROOT)
    made = lab.new_specimen(lab.root / "coupon")
    run = start_run(lab.runs, "cut", specimen=made.name)
    run.write_result({})
    run.finish("done")
    return made


def fill(specimen: Specimen, shift_mm: float, only: str = "AB") -> Path:
    """Fill in the specimen's own form, every length off the map by so much."""
    path = specimen.design / "coupon.csv"
    *head, _, _ = lines = path.read_text().splitlines()
    rows, filled = lines[-2:], []
    for row in rows:
        name, hinge, expected, flat, *_ = row.split(",")
        length = float(expected) * float(flat) + shift_mm
        filled += [f"{name},{hinge},{expected},{flat},{length:.2f},50,"] if name in only else []
    path.write_text("\n".join([*head, *filled]) + "\n")
    return path


def test_every_hinge_that_is_solved_is_told(lab: Workspace) -> None:
    heard: list[Event] = []
    write_coupon(lab.root / "told", CouponConfig(hinges_mm=(0.25, 0.4)), ROOT, emit=heard.append)
    assert [event.done_frac for event in heard] == [0.0, 0.0, 0.45, 0.9]  # the cell, either hinge, the writing
    assert "0.25 mm" in heard[1].message and "0.4 mm" in heard[2].message
    with pytest.raises(BundleError, match="exists already"):  # and a taken folder is refused before any of it
        write_coupon(lab.root / "told", CouponConfig(hinges_mm=(0.25, 0.4)), ROOT, emit=heard.append)
    assert len(heard) == 4


def test_a_coupon_is_composed_for_its_own_sheet_with_the_id_on_every_patch(specimen: Specimen) -> None:
    bundle, asked = open_design(specimen.design)
    material = load_material(asked.material, ROOT)
    assert sheet_of(asked, ROOT).thickness_mm == material.thickness_mm
    assert isinstance(asked, CouponConfig) and asked.hinges_mm == (0.25, 0.4)
    programs = [composer(bundle, asked, material)(name, 1000.0) for name in ("S-0001", "S-0008")]
    burnt = [sum(step.length_mm for step in read_program(lines).steps if step.burns) for lines in programs]
    assert burnt[0] != burnt[1]


@pytest.mark.parametrize(
    ("shift_mm", "only", "word"), [(0.0, "AB", "pass"), (2.0, "AB", "fail"), (0.0, "A", "incomplete")]
)
def test_the_report_of_a_coupon_says_whether_the_map_holds(
    lab: Workspace, specimen: Specimen, shift_mm: float, only: str, word: str
) -> None:
    assert specimen_report(lab, specimen).word == "incomplete"
    path = fill(specimen, shift_mm, only)
    done = CliRunner().invoke(cli, ["--home", str(lab.root), "design", "coupon-read", specimen.name])
    assert done.exit_code == (6 if word == "fail" else 0), done.output
    report = specimen_report(lab, specimen)
    assert report.word == word
    page = render(report)
    assert "A, hinge 0.250 mm" in page and "50 cycles" in page and "<svg" in page
    assert (path.parent / "measured.json").is_file()


def read(lab: Workspace, *words: str) -> tuple[int, str]:
    done = CliRunner().invoke(cli, ["--home", str(lab.root), "design", "coupon-read", *words])
    return done.exit_code, done.output + str(done.exception)


def test_the_command_keeps_the_result_beside_the_form_and_ends_with_6_where_the_map_does_not_hold(
    lab: Workspace, specimen: Specimen
) -> None:
    path = fill(specimen, 0.0)
    path.write_text(path.read_text().replace(",50,\n", ",50,37\n"))
    code, said = read(lab, str(path))
    assert code == 0 and "torn at 37" in said and "all within their uncertainty" in said
    kept = json.loads((path.parent / "measured.json").read_text())
    assert [patch["failed_at_count"] for patch in kept["patches"]] == [37, 37]
    path = fill(specimen, 2.0)
    code, said = read(lab, str(path.parent))
    assert code == 6 and "2 of 2 patches off the map by more than their uncertainty: A, B" in said


def test_expected_expansions_are_those_of_the_cells_whatever_the_form_says(lab: Workspace, specimen: Specimen) -> None:
    path = fill(specimen, 0.0)
    filled = path.read_text()
    path.write_text(filled.replace(",0.2500,1.5000,", ",,,"))  # what was left empty is known all the same
    assert read(lab, specimen.name)[0] == 0
    kept = json.loads((path.parent / "measured.json").read_text())["patches"]
    assert (kept[0]["hinge_mm"], kept[0]["expected_ratio"]) == (0.25, pytest.approx(1.5, abs=0.002))
    path.write_text(filled.replace(",1.5000,60.000,90.00", ",1.6000,60.000,96.00"))
    code, said = read(lab, specimen.name)
    assert code != 0 and "expected_expansion_ratio is 1.6000 in the form, 1.5000 as cut" in said


def test_a_form_of_another_coupon_or_with_unknown_patches_is_refused(
    lab: Workspace, specimen: Specimen, tmp_path: Path
) -> None:
    with pytest.raises(RefusedError) as caught:
        read_form(filled := form(tmp_path, FILLED), 0.2, open_coupon(specimen.design, filled))
    assert [finding.code for finding in caught.value.findings] == ["COUPON-OTHER"] * 5
    assert "patch C was not cut; the coupon has A, B" in str(caught.value)
    code, said = read(lab, str(tmp_path / "coupon.csv"))  # a form without the folder of what was cut
    assert code != 0 and "what was cut is not known" in said and "--specimen" in said


def test_the_form_says_how_it_is_filled_in_and_names_the_notches(specimen: Specimen) -> None:
    head = [line for line in (specimen.design / "coupon.csv").read_text().splitlines() if line.startswith("#")]
    for word in ("A1 and A2", "cells.csv", *HEAD.split(",")[3:6], "failed_at", "coupon-read"):
        assert any(word in line for line in head), word
    assert not any("," in line for line in head)  # one field of a spreadsheet's first column
