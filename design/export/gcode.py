"""Strokes to G-code for GRBL 1.1 in laser mode: the only place that knows S words and mm/min.

M4 only: the beam's power follows the speed, is off in every G0, and goes off when a starved planner stops. Power and
speed ride on motion lines, because a line with S alone makes the firmware wait for standstill. Nothing here writes to
the board's EEPROM.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from design.errors import DesignError
from design.pattern.paths import CutPath, Layer, LayerPreset
from design.pattern.tiling import Array

LINE_LIMIT = 79  # characters the board takes in one line, newline not counted
DECIMALS = 3
END = ("G0X0Y0", "M5", "G4P0.01")  # the `ok` of the dwell comes only when all motion has ended


@dataclass(frozen=True, slots=True)
class GcodeOptions:
    """What the machine is: `s_max_count` is its `$30`; moves that burn longer than `longest_move_s` are split."""

    s_max_count: float = 1000.0
    origin_mm: tuple[float, float] = (0.0, 0.0)
    longest_move_s: float | None = None


def gcode(
    strokes: Sequence[CutPath],
    presets: Mapping[Layer, LayerPreset],
    options: GcodeOptions = GcodeOptions(),
    remarks: Iterable[str] = (),
) -> tuple[str, ...]:
    """Return the program that cuts `strokes` in the order given; raise `DesignError` on a layer without a preset."""
    missing = sorted({stroke.layer for stroke in strokes} - set(presets))
    if missing:
        raise DesignError(f"the material has no laser preset for the layer {', '.join(missing)}")
    lines = [f";{_plain(remark)}"[:LINE_LIMIT] for remark in remarks]
    lines += ["G21", "G90", "G94", "G17", "M4S0"]
    layer: Layer | None = None
    for stroke in strokes:
        added = _stroke_lines(stroke, presets[stroke.layer], options, new_preset=stroke.layer != layer)
        lines += added
        layer = stroke.layer if added else layer
    lines += END
    return tuple(lines)


def _stroke_lines(stroke: CutPath, preset: LayerPreset, options: GcodeOptions, new_preset: bool) -> list[str]:
    points = stroke.points_mm
    if stroke.closed:
        points = np.vstack([points, points[:1]])
    if options.longest_move_s is not None:
        points = _split(points, options.longest_move_s * preset.feed_mm_s)
    texts = [f"X{_number(x)}Y{_number(y)}" for x, y in (points + np.array(options.origin_mm)).tolist()]
    if all(text == texts[0] for text in texts):
        return []  # shorter than the last decimal
    lines = [f"G0{texts[0]}"]
    power = (
        f"F{_number(60 * preset.feed_mm_s)}S{_number(preset.power_frac * options.s_max_count)}" if new_preset else ""
    )
    before = texts[0]
    for text in texts[1:]:
        if text == before:
            continue
        lines.append(f"G1{text}{power}" if len(lines) == 1 else text)
        before, power = text, ""
    return lines


def _split(points_mm: Array, longest_mm: float) -> Array:
    lengths = np.linalg.norm(np.diff(points_mm, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(lengths / longest_mm - 1e-9)).astype(int)
    pieces = [
        a + (b - a) * np.arange(n)[:, None] / n
        for a, b, n in zip(points_mm[:-1], points_mm[1:], counts.tolist(), strict=True)
    ]
    return np.vstack([*pieces, points_mm[-1:]])


def _number(value: float) -> str:
    """Return a decimal without exponent, without trailing zeros, never `-0`."""
    if not math.isfinite(value):
        raise DesignError(f"a coordinate or word of the program is {value}")
    text = f"{value:.{DECIMALS}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _plain(remark: str) -> str:
    return "".join(letter if " " <= letter <= "~" and letter not in "();!?~$" else " " for letter in remark)
