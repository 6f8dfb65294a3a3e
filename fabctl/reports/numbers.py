"""How a report writes numbers and times: no more digits than are known, words with units, the reader's own clock."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Any

from fabctl.records.words import named

DIGITS_COUNT = 2  # of an uncertainty: more would claim to know how uncertain one is
COVERAGE = 2.0  # standard deviations in a half interval of about 95 %


def decimals_of(half: float) -> int:
    """Return to how many decimals a value is written whose uncertainty is `half`."""
    return max(0, DIGITS_COUNT - 1 - math.floor(math.log10(float(f"{half:.{DIGITS_COUNT - 1}e}"))))


def with_half(value: float, half: float | None, unit: str = "", sign: str = "") -> str:
    """Return value ± half interval, both to the digits that the latter has; three digits where it is not known."""
    tail = f" {unit}" if unit else ""
    if half is None or not math.isfinite(half) or half <= 0:
        return plain(value, unit, sign)
    decimals = decimals_of(half)
    return f"{_fixed(value, decimals, sign)} ± {half:.{decimals}f}{tail}"


def plain(value: float, unit: str = "", sign: str = "") -> str:
    """Return a value of unknown uncertainty to three digits, never in powers of ten below a million."""
    tail = f" {unit}" if unit else ""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}{tail}"
    if abs(value) >= 1e6:
        return f"{value:{sign}.3g}{tail}"
    return _fixed(value, max(0, 2 - math.floor(math.log10(abs(value)))), sign) + tail


def percent(frac: float, decimals: int = 1, sign: str = "") -> str:
    """Return a fraction in percent."""
    return f"{_fixed(100 * frac, decimals, sign)} %"


def _fixed(value: float, decimals: int, sign: str = "") -> str:
    """Return `value` with so many decimals, and nothing as a plain 0: never as -0."""
    text = f"{value:{sign}.{decimals}f}"
    return text.lstrip("+-") if float(text) == 0 else text


def fact(key: str, value: Any) -> tuple[str, str]:
    """Return the words and the value with its unit of a key as records have them: `stage_x_mm`, `humidity_frac`."""
    words, unit = named(key.removesuffix("_frac"))
    if not isinstance(value, float | int) or isinstance(value, bool):
        return words, str(value)
    return words, percent(value) if key.endswith("_frac") else plain(value, unit)


def clock(utc: str) -> str:
    """Return the time of a record on the clock of whoever makes the report, with its zone."""
    try:
        then = datetime.fromisoformat(utc)
    except ValueError:
        return utc
    if then.tzinfo is None:
        return utc
    return then.astimezone().strftime("%Y-%m-%d %H:%M %Z")
