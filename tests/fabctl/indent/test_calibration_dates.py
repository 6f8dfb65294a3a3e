"""A calibration past its date is told before the run and in the report; force and frame have dates of their own."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from fabctl.indent.calibration import Calibration
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
