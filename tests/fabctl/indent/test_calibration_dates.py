"""A calibration past its date is told before the run and in the report; force and frame have dates of their own."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from fabctl.errors import USAGE, ConfigError
from fabctl.indent.calibration import Calibration, calibration_path, load_calibration, save_calibration
from fabctl.reports.indent_step import _calibration_facts

MADE = datetime(2026, 1, 1, tzinfo=UTC)
BOTH = Calibration(
    gain_ratio=1.01,
    gain_se_ratio=1e-3,
    force_utc=MADE.isoformat(),
    compliance_mm_N=0.02,
    compliance_se_mm_N=1e-4,
    frame_utc=MADE.isoformat(),
    force_valid_days_count=30,
    frame_valid_days_count=365,
)


def test_only_the_one_that_is_past_its_date_is_flagged() -> None:
    later = MADE + timedelta(days=31)
    assert [f.code for f in BOTH.findings(later)] == ["RIG-FORCE-EXPIRED"]
    assert BOTH.findings(MADE + timedelta(days=29)) == []


def test_the_report_gives_uncertainty_and_date_and_flags_what_was_past_it() -> None:
    force, frame = _calibration_facts(BOTH.as_dict(), MADE + timedelta(days=31))
    assert force.value == "1.0100 ± 0.0020"
    assert force.note == "PAST ITS DATE: ended on 2026-01-31"
    assert frame.value == "0.02000 ± 0.00020 mm/N"
    assert frame.note == "valid to 2027-01-01"


def test_a_calibration_file_of_before_keeps_its_one_date() -> None:
    old = {k: v for k, v in BOTH.as_dict().items() if not k.endswith("valid_days_count")} | {"valid_days_count": 10}
    assert len(Calibration(**old).findings(MADE + timedelta(days=11))) == 2


def test_a_run_without_calibration_says_what_that_means() -> None:
    (only,) = _calibration_facts(None, MADE)
    assert only.value == "none"
    assert "not taken off" in only.note


def test_a_calibration_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    save_calibration(tmp_path, "lab", BOTH)
    assert load_calibration(tmp_path, "lab") == BOTH
    assert load_calibration(tmp_path, "other") is None


def test_a_damaged_calibration_is_refused_with_all_its_faults_and_the_way_out(tmp_path: Path) -> None:
    path = save_calibration(tmp_path, "lab", BOTH)
    faults = {
        "gain_ratio": float("nan"), "compliance_mm_N": -0.02, "force_utc": "yesterday", "frame_utc": "2026-01-01",
        "valid_days_count": "long",
    }  # fmt: skip
    path.write_text(json.dumps(BOTH.as_dict() | faults, indent=1))
    with pytest.raises(ConfigError) as caught:
        load_calibration(tmp_path, "lab")
    assert caught.value.exit_code == USAGE
    assert all(any(f": {name}: " in line for line in caught.value.complaints) for name in faults)
    assert "fabctl rig calibrate force" in caught.value.complaints[-1]


@pytest.mark.parametrize("text", ["", "null", "[1]", '{"gain', '"x"', "{'gain_ratio': 1e400}"])
def test_what_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    path = calibration_path(tmp_path, "lab")
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(ConfigError, match="fabctl rig calibrate"):
        load_calibration(tmp_path, "lab")
