"""Facts about a specimen are checked against what the tool knows to read."""

from __future__ import annotations

import pytest

from fabctl.cli.specimen import note
from fabctl.errors import UsageError
from fabctl.notes import KNOWN, read_notes


def test_known_facts_are_read_as_what_they_are() -> None:
    words = ["thickness_mm=2.31", "batch=7", "rest_h=0", "deployed_utc=2026-11-22T04:31"]
    told = {"thickness_mm": 2.31, "batch": "7", "rest_h": 0.0, "deployed_utc": "2026-11-22T04:31:00"}
    assert read_notes(words) == told


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("thicknes_mm=2.3", "did you mean thickness_mm"),
        ("colour=red", "known: thickness_mm"),
        ("thickness_mm=-1", "above zero"),
        ("thickness_mm=nan", "above zero"),
        ("thickness_mm=2,3", "above zero"),
        ("rest_h=inf", "zero or above"),
        ("deployed_utc=yesterday", "a time such as"),
        ("batch= ", "text"),
        ("id=S-9", "given at the cut"),
        ("batch", "not KEY=VALUE"),
    ],
)
def test_what_is_wrong_is_told_with_what_would_be_right(word: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        read_notes([word])


def test_all_faults_are_told_at_once() -> None:
    with pytest.raises(UsageError) as fault:
        read_notes(["thickness_mm=x", "colour=red", "batch=B7"])
    assert "thickness_mm" in str(fault.value)
    assert "colour" in str(fault.value)


def test_free_keys_are_allowed_where_they_are_asked_for() -> None:
    assert read_notes(["colour=red", "holes=3", "x=NaN"], free=True) == {"colour": "red", "holes": 3, "x": "NaN"}
    with pytest.raises(UsageError, match="above zero"):
        read_notes(["thickness_mm=0"], free=True)


def test_the_help_lists_every_known_fact() -> None:
    assert [key for key in KNOWN if key not in (note.help or "")] == []
