"""Letters of one stroke width, for engraving: no outlines to fill, few moves, and no two that read alike.

Each letter is drawn on a grid of 4 by 6 units; a point is two digits (x, y), strokes are parted by a bar.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from design.errors import DesignError
from design.pattern.paths import CutPath, Layer
from design.pattern.tiling import Array

GLYPHS: dict[str, str] = {
    "0": "10 30 41 45 36 16 05 01 10 | 11 35",
    "1": "15 26 20 | 10 30",
    "2": "05 16 36 45 44 00 40",
    "3": "05 16 36 45 44 33 42 41 30 10 01 | 23 33",
    "4": "30 36 02 42",
    "5": "46 06 04 34 43 41 30 10 01",
    "6": "45 36 16 05 01 10 30 41 42 33 03",
    "7": "06 46 10",
    "8": "13 04 05 16 36 45 44 33 13 02 01 10 30 41 42 33",
    "9": "01 10 30 41 45 36 16 05 04 13 43",
    "A": "00 26 40 | 12 32",
    "B": "00 06 36 45 44 33 03 | 33 42 41 30 00",
    "C": "45 36 16 05 01 10 30 41",
    "D": "00 06 26 44 42 20 00",
    "E": "46 06 00 40 | 03 33",
    "F": "46 06 00 | 03 33",
    "G": "45 36 16 05 01 10 30 41 43 23",
    "H": "00 06 | 40 46 | 03 43",
    "I": "20 26 | 10 30 | 16 36",
    "J": "46 41 30 10 01",
    "K": "00 06 | 46 03 40",
    "L": "06 00 40",
    "M": "00 06 23 46 40",
    "N": "00 06 40 46",
    "O": "10 30 41 45 36 16 05 01 10",
    "P": "00 06 36 45 44 33 03",
    "Q": "10 30 41 45 36 16 05 01 10 | 22 40",
    "R": "00 06 36 45 44 33 03 | 23 40",
    "S": "45 36 16 05 04 13 33 42 41 30 10 01",
    "T": "06 46 | 20 26",
    "U": "06 01 10 30 41 46",
    "V": "06 20 46",
    "W": "06 10 24 30 46",
    "X": "00 46 | 06 40",
    "Y": "06 23 46 | 23 20",
    "Z": "06 46 00 40",
    "-": "13 33",
    "+": "13 33 | 21 25",
    "=": "12 32 | 14 34",
    ".": "20 21",
    ":": "21 22 | 24 25",
    "/": "00 46",
    "_": "00 40",
    " ": "",
}
LETTER_UNITS, GAP_UNITS, HEIGHT_UNITS = 4, 2, 6


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where a line of text goes: its middle, the letters' height, the most width it may take, and its turn."""

    x_mm: float
    y_mm: float
    height_mm: float
    width_mm: float
    turn_rad: float = 0.0


def text_width_mm(text: str, height_mm: float) -> float:
    """Return the width of a line of text."""
    units = len(text) * LETTER_UNITS + max(0, len(text) - 1) * GAP_UNITS
    return units * height_mm / HEIGHT_UNITS


def text_strokes(text: str, anchor: Anchor, layer: Layer = "engrave") -> list[CutPath]:
    """Return the strokes of `text`, centred on its anchor and made smaller where it would be too wide.

    Small letters become capitals; raises `DesignError` on a letter the font does not have.
    """
    unknown = sorted({letter for letter in text.upper() if letter not in GLYPHS})
    if unknown:
        raise DesignError(f"no letter for {' '.join(map(repr, unknown))}; text may have A-Z, 0-9 and - + = . : / _")
    height = anchor.height_mm * min(1.0, anchor.width_mm / max(text_width_mm(text, anchor.height_mm), 1e-9))
    unit = height / HEIGHT_UNITS
    middle = np.array([text_width_mm(text, height) / 2, height / 2])
    c, s = math.cos(anchor.turn_rad), math.sin(anchor.turn_rad)
    turn = np.array([[c, s], [-s, c]])
    found = []
    for k, letter in enumerate(text.upper()):
        left = np.array([k * (LETTER_UNITS + GAP_UNITS), 0])
        for stroke in _strokes(GLYPHS[letter]):
            points = ((stroke + left) * unit - middle) @ turn + np.array([anchor.x_mm, anchor.y_mm])
            found.append(CutPath(layer, points))
    return found


def _strokes(glyph: str) -> list[Array]:
    strokes = [stroke.split() for stroke in glyph.split("|")]
    return [np.array([divmod(int(point), 10) for point in stroke], dtype=np.float64) for stroke in strokes if stroke]
