"""What a finished run has come to, in a line: what `fabctl run list` shows where the outcome itself says nothing."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

UNITS = {
    "N_mm": "N/mm",
    "mm_N": "mm/N",
    "mm_s": "mm/s",
    "mm2": "mm²",
    "mm": "mm",
    "mJ": "mJ",
    "MPa": "MPa",
    "degC": "°C",
    "deg": "°",
    "N": "N",
    "s": "s",
    "h": "h",
    "kg": "kg",
    "g": "g",
    "count": "",
}
UNIT = re.compile(rf"_({'|'.join(UNITS)})$")

PRESSED = (("stiffness_secant_N_mm", "secant stiffness", "N/mm"), ("force_max_N", "largest force", "N"))
CALIBRATED = (("gain_ratio", "gain of the load cell", ""), ("compliance_mm_N", "give of the frame", "mm/N"))


def result_words(result: Mapping[str, Any]) -> str:
    """Return the figures of a cut, an indentation or a calibration that tell most, with their units."""
    told = []
    if "burnt_mm" in result:
        told.append(f"{result['burnt_mm'] / 1000:.2f} m burnt")
    if "actual_s" in result:
        told.append(f"{result['actual_s']:.0f} s, estimated {result['estimate_s']:.0f} s")
    if "curves_count" in result:
        told.append(f"{result['curves_count']} curves")
    for key, name, unit in PRESSED if "stiffness_secant_N_mm" in result else CALIBRATED:
        if result.get(key) is not None:
            told.append(f"{name} {result[key]:.4g} {unit}".strip())
    return ", ".join(told)


def named(key: str) -> tuple[str, str]:
    """Return the words and the unit of a key as records have them, such as `force_max_N`."""
    found = UNIT.search(key)
    bare, unit = (key[: found.start()], UNITS[found[1]]) if found else (key, "")
    return bare.replace("_", " "), unit


def is_simulated(manifest: Mapping[str, Any]) -> bool | None:
    """Say whether a run was made on a bench of simulators; None where it needed no bench."""
    config = manifest.get("config") or {}
    bench = config.get("bench")
    if bench is None and "simulated" not in config:
        return None
    listed = isinstance(bench, dict) and (bench.get("simulated") or bench.get("simulators"))
    return bool(config.get("simulated") or listed)
