"""A coupon's filled form is read back against the map, and one that is not filled in is refused with all its faults."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from fabctl.cli.design import command
from fabctl.coupon import read_form
from fabctl.errors import RefusedError

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
    with pytest.raises(RefusedError):
        read_form(tmp_path / "nothing.csv", 0.2)


def test_the_command_keeps_the_result_beside_the_form(tmp_path: Path) -> None:
    form(tmp_path, FILLED)
    done = CliRunner().invoke(command, ["coupon-read", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "torn at 37" in done.output and "outside their uncertainty: B" in done.output
    kept = json.loads((tmp_path / "measured.json").read_text())
    assert [patch["cycles_count"] for patch in kept["patches"]] == [100, 40, 3]
