"""A report writes no more digits than are known, words for names, and times on the reader's clock."""

from __future__ import annotations

import time

import pytest

from fabctl.reports.numbers import clock, fact, percent, plain, with_half


@pytest.mark.parametrize(
    ("value", "half", "told"),
    [
        (0.0069712, 0.0000391, "0.006971 ± 0.000039 N/mm"),
        (0.474123, 0.01415, "0.474 ± 0.014 N/mm"),
        (1.5, 0.0996, "1.50 ± 0.10 N/mm"),
        (-0.0004, 0.0038, "-0.0004 ± 0.0038 N/mm"),
        (123.4, 17.3, "123 ± 17 N/mm"),
        (1234.5, 230.0, "1234 ± 230 N/mm"),
        (0.024871, None, "0.0249 N/mm"),
        (0.02, 0.0, "0.0200 N/mm"),
    ],
)
def test_a_value_has_the_digits_of_its_uncertainty(value: float, half: float | None, told: str) -> None:
    assert with_half(value, half, "N/mm") == told


def test_nothing_is_told_without_a_sign_and_large_numbers_without_lost_digits() -> None:
    assert percent(-0.0000028, 3, "+") == "0.000 %"
    assert percent(0.0123, 2, "+") == "+1.23 %"
    assert plain(120.4, "s") == "120 s" and plain(0.0, "mm") == "0 mm"


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("humidity_frac", 0.45, ("humidity", "45.0 %")),
        ("stage_x_mm", 0.0, ("stage x", "0 mm")),
        ("temperature_degC", 22.5, ("temperature", "22.5 °C")),
        ("batch", "B7", ("batch", "B7")),
        ("rest_h", 12.0, ("rest", "12.0 h")),
    ],
)
def test_names_of_records_are_told_in_words_with_units(key: str, value: object, told: tuple[str, str]) -> None:
    assert fact(key, value) == told


def test_times_are_told_on_the_local_clock_with_its_zone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "Europe/Zurich")
    time.tzset()
    assert clock("2026-07-25T17:43:59.123+00:00") == "2026-07-25 19:43 CEST"
    monkeypatch.undo()
    time.tzset()
    assert clock("never") == "never"
