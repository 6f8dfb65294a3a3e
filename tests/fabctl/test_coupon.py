"""A coupon's filled form is read back against the map, and one that is not filled in is refused with all its faults."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from fabctl.cli.main import cli
from fabctl.config.coupon import CouponConfig
from fabctl.config.material import load_material
from fabctl.coupon import keep_result, read_form
from fabctl.cut.compose import composer, open_design, sheet_of
from fabctl.cut.program import read_program
from fabctl.designing import write_coupon
from fabctl.errors import RefusedError, UsageError
from fabctl.records.folder import start_run
from fabctl.reports.page import render
from fabctl.reports.specimen import specimen_report
from fabctl.workspace import Specimen, Workspace

ROOT = Path(__file__).resolve().parents[2]

HEAD = "patch,hinge_mm,expected_expansion_ratio,flat_length_mm,measured_length_mm,cycles_count,failed_at\n"
FILLED = HEAD + "A,0.2,1.5100,60,90.4 90.6 90.8,100,\nB,0.25,1.5000,60,92.0,40,37\nC,0.6,,60,60.1,3,\n"


def form(folder: Path, text: str) -> Path:
    path = folder / "coupon.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_measured_expansions_stand_beside_the_expected_with_their_uncertainty(tmp_path: Path) -> None:
    a, b, c = read_form(form(tmp_path, FILLED), 0.2)
    assert a.expansion_ratio == pytest.approx(90.6 / 60) and a.readings_count == 3
    assert a.uncertainty_ratio == pytest.approx(2 * ((0.2 / 60) ** 2 + (0.2 / 60) ** 2 / 3) ** 0.5)
    assert a.agrees() is True and b.agrees() is False
    assert b.off_ratio() == pytest.approx(92 / 60 - 1.5) and (b.cycles_count, b.failed_at_count) == (40, 37)
    assert c.agrees() is None and c.off_ratio() is None


def test_every_fault_of_a_form_is_told_at_once(tmp_path: Path) -> None:
    text = HEAD + "A,0.2,1.5,60,,10,\nB,0.25,1.5,60,9o.1,ten,\nC,0.3,1.5,60,905,5,9\nC,0.3,1.5,60,90,-1,\n"
    with pytest.raises(RefusedError) as caught:
        read_form(form(tmp_path, text), 0.2)
    codes = [finding.code for finding in caught.value.findings]
    assert codes.count("COUPON-NUMBER") == 4
    assert {"COUPON-CYCLES", "COUPON-LENGTH", "COUPON-TWICE"} <= set(codes)
    with pytest.raises(RefusedError):
        read_form(form(tmp_path, "a,b\n1,2\n"), 0.2)
    with pytest.raises(UsageError, match="no such file"):
        read_form(tmp_path / "nothing.csv", 0.2)


def test_the_command_keeps_the_result_beside_the_form(tmp_path: Path) -> None:
    form(tmp_path, FILLED)
    done = CliRunner().invoke(cli, ["design", "coupon-read", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "torn at 37" in done.output and "outside their uncertainty: B" in done.output
    kept = json.loads((tmp_path / "measured.json").read_text())
    assert [patch["cycles_count"] for patch in kept["patches"]] == [100, 40, 3]


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
    head, *rows = path.read_text().splitlines()
    filled = []
    for row in rows:
        name, hinge, expected, flat, *_ = row.split(",")
        length = float(expected) * float(flat) + shift_mm
        filled += [f"{name},{hinge},{expected},{flat},{length:.2f},50,"] if name in only else []
    path.write_text("\n".join([head, *filled]) + "\n")
    return path


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
    assert done.exit_code == 0, done.output
    report = specimen_report(lab, specimen)
    assert report.word == word
    page = render(report)
    assert "A, hinge 0.250 mm" in page and "50 cycles" in page and "<svg" in page
    assert (path.parent / "measured.json").is_file()


def test_a_form_of_another_coupon_is_not_laid_to_a_specimen(lab: Workspace, specimen: Specimen, tmp_path: Path) -> None:
    patches = read_form(form(tmp_path, FILLED), 0.2)
    with pytest.raises(RefusedError) as caught:
        keep_result(lab, specimen.name, tmp_path / "coupon.csv", patches, 0.2)
    assert {finding.code for finding in caught.value.findings} == {"COUPON-OTHER"}
    assert len(caught.value.findings) == 3
