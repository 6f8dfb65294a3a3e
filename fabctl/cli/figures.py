"""Figures of a result in words: the name, the unit that its name ends in, and as many digits as mean something."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from fabctl.records.words import named

DIGITS = 4


def figures(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each figure of a result, with its reason where it was not found; lists and tables are left out.

    `not_found` in the result holds the reasons by name.
    """
    reasons = result.get("not_found") or {}
    for name, value in result.items():
        if isinstance(value, dict | list):
            continue
        words, unit = named(name)
        if value is None:
            why = reasons.get(name)
            yield f"{words}: not found: {why}" if why else f"{words}: none"
        else:
            yield f"{words}: {spoken(value)} {unit}".rstrip()


def spoken(value: Any) -> str:
    """Return a value as a person reads it: four significant digits, yes or no, names side by side."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(spoken, value)) or "none"
    if not isinstance(value, float) or not math.isfinite(value):
        return str(value)
    return f"{value:.0f}" if 10**DIGITS <= abs(value) < 1e9 else f"{value:.{DIGITS}g}"
