"""What may be noted about a specimen: the facts that runs and reports read, each with its kind."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any

from fabctl.errors import UsageError

GIVEN = ("id", "made_utc", "design")  # at the cut; they stay


def _above_zero(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise ValueError("a number above zero")
    return value


def _from_zero(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value >= 0):
        raise ValueError("a number, zero or above")
    return value


def _time(text: str) -> str:
    return datetime.fromisoformat(text).isoformat()


def _text(text: str) -> str:
    if not text.strip():
        raise ValueError("some text")
    return text


# name -> how it is read, and what it is, for whoever gave something else
KNOWN: dict[str, tuple[Callable[[str], Any], str]] = {
    "thickness_mm": (_above_zero, "a number above zero: the sheet as measured"),
    "batch": (_text, "text: the rubber's batch"),
    "rest_h": (_from_zero, "a number, zero or above: hours it has rested since it was deployed"),
    "deployed_utc": (_time, "a time such as 2026-11-22T04:31"),
    "remark": (_text, "text: anything else"),
}


def read_notes(words: Sequence[str], free: bool = False) -> dict[str, Any]:
    """Return the facts in `KEY=VALUE` words; `free` allows keys that nothing reads.

    Raises `UsageError` with everything that is wrong.
    """
    facts: dict[str, Any] = {}
    wrong = []
    for word in words:
        key, sign, value = word.partition("=")
        try:
            if not sign or not key.isidentifier():
                raise ValueError(f"{word!r} is not KEY=VALUE")
            if key in facts:
                raise ValueError(f"{key} is given twice")
            facts[key] = _fact(key, value, free)
        except ValueError as fault:
            wrong.append(str(fault))
    if wrong:
        raise UsageError("\n  ".join(["nothing was noted:", *wrong]))
    return facts


def _fact(key: str, value: str, free: bool) -> Any:
    if key in GIVEN:
        raise ValueError(f"{key} was given at the cut and stays")
    if key in KNOWN:
        read, kind = KNOWN[key]
        try:
            return read(value)
        except ValueError:
            raise ValueError(f"{key}={value}: {key} is {kind}") from None
    if free:
        return _bare(value)
    near = difflib.get_close_matches(key, KNOWN, 1)
    meant = f"; did you mean {near[0]}?" if near else ""
    raise ValueError(f"{key} is not known{meant} (known: {', '.join(KNOWN)}; --free allows others)")


def _bare(value: str) -> Any:
    """Return a free value as JSON reads it, or as text; NaN and infinity pass `json.loads`, and are text here."""
    try:
        found = json.loads(value)
        json.dumps(found, allow_nan=False)
    except ValueError:
        return value
    return found
