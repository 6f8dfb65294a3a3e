"""The conditions of a test: from the specimen's record, from the operator, from the time since it was deployed."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from fabctl.indent.job import conditions, unrecorded

DEPLOYED = datetime(2026, 11, 20, 8, tzinfo=UTC)
RECORD = {"id": "S-0001", "thickness_mm": 2.31, "deployed_utc": DEPLOYED.isoformat()}


def test_what_the_operator_says_goes_before_the_record_and_the_rest_follows_from_the_deployment() -> None:
    found = conditions(RECORD, {"thickness_mm": 2.4, "batch": None}, DEPLOYED + timedelta(hours=30))
    assert found == {"thickness_mm": 2.4, "deployed_utc": DEPLOYED.isoformat(), "rest_h": pytest.approx(30.0)}
    assert conditions(RECORD, {"rest_h": 2.0})["rest_h"] == 2.0


@pytest.mark.parametrize("broken", ["yesterday", 5, None])
def test_a_deployment_at_no_time_gives_no_rest(broken: object) -> None:
    assert "rest_h" not in conditions({"deployed_utc": broken}, {})


def test_what_nobody_recorded_is_named_and_nothing_is_said_where_all_is_there() -> None:
    (only,) = unrecorded(conditions({"batch": "B7"}, {}))
    assert (only.code, only.level) == ("INDENT-CONDITIONS", "warning")
    assert "the sheet's thickness, hours of rest" in only.message
    assert unrecorded({"thickness_mm": 2.3, "batch": "B7", "rest_h": 1.0}) == []
