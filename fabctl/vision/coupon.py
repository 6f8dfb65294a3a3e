"""The kerf coupon: for each power a ladder of slits along x and one along y, between open squares; marks around.

The squares fall out, so a picture shows how bright "open" is everywhere on it; and each is larger than drawn by one
kerf, a second measurement of it. Marks are engraved by the same machine, so the coupon's millimetres are the machine's.
Between the upper marks stands its id, so that a picture tells which coupon it shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from design.export.gcode import END, GcodeOptions, gcode
from design.pattern.drawing import Box
from design.pattern.font import Anchor
from design.pattern.paths import CutPath, LayerPreset
from fabctl.errors import UsageError
from fabctl.files import why_not
from fabctl.vision.boards import COUPON_IDS, Mark, MarkSheet, hatch, sheet_ink
from fabctl.vision.ids import id_size_modules
from fabctl.vision.template import F64

FORMAT = 2  # 1 had no room for an id
SLIT_MM = 8.0
PITCH_MM = 2.5
SLITS_COUNT = 4
WINDOW_MM = 3.0
MARK_MM = 6.0
MARGIN_MM = 3.0
ROW_MM = 11.0
GAP_MM = 3.0
MODULE_MM = 0.75  # of the id's code
TEXT_MM = 3.0
MOST_FEED_MM_S, MOST_PASSES_COUNT = 10_000.0, 100
HEADER_LINES = 5  # G21 G90 G94 G17 M4S0: modal words, once


@dataclass(frozen=True, slots=True)
class Slit:
    """One slit of the ladder; `axis` is its direction."""

    power_frac: float
    axis: str
    ends_mm: tuple[tuple[float, float], tuple[float, float]]

    @property
    def ends(self) -> F64:
        """Return both ends (2, 2)."""
        return np.array(self.ends_mm, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Window:
    """One open square, its centre, and the power that cut it."""

    power_frac: float
    centre_mm: tuple[float, float]
    side_mm: float


@dataclass(frozen=True, slots=True)
class Coupon:
    """What is cut, in millimetres from the coupon's lower left corner."""

    size_mm: tuple[float, float]
    feed_mm_s: float
    passes_count: int
    slits: tuple[Slit, ...]
    windows: tuple[Window, ...]
    marks: MarkSheet


def make_coupon(powers_frac: Sequence[float], feed_mm_s: float, passes_count: int = 1) -> Coupon:
    """Return the coupon for these powers, one row each, the first at the bottom."""
    if not powers_frac or len(set(powers_frac)) != len(powers_frac) or not all(0 < p <= 1 for p in powers_frac):
        raise UsageError(f"powers must differ and lie between 0 and 1, not {', '.join(f'{p:g}' for p in powers_frac)}")
    first = MARGIN_MM + MARK_MM + GAP_MM
    left = first + WINDOW_MM + GAP_MM
    right = left + SLIT_MM + GAP_MM + WINDOW_MM + GAP_MM
    last = right + (SLITS_COUNT - 1) * PITCH_MM + GAP_MM
    slits: list[Slit] = []
    windows = []
    for row, power in enumerate(powers_frac):
        y0 = MARGIN_MM + row * ROW_MM
        middle = y0 + SLIT_MM / 2
        for k in range(SLITS_COUNT):
            y = y0 + 0.25 + k * PITCH_MM
            x = right + k * PITCH_MM
            slits.append(Slit(power, "x", ((left, y), (left + SLIT_MM, y))))
            slits.append(Slit(power, "y", ((x, y0), (x, y0 + SLIT_MM))))
        for x in (first, left + SLIT_MM + GAP_MM, last):
            windows.append(Window(power, (x + WINDOW_MM / 2, middle), WINDOW_MM))
    width = last + WINDOW_MM + GAP_MM + MARK_MM + MARGIN_MM
    height = 2 * MARGIN_MM + len(powers_frac) * ROW_MM + MARK_MM
    near, far_x, far_y = MARGIN_MM + MARK_MM / 2, width - MARGIN_MM - MARK_MM / 2, height - MARGIN_MM - MARK_MM / 2
    places = [(near, near), (far_x, near), (far_x, far_y), (near, far_y)]
    marks = tuple(Mark(COUPON_IDS[k], x, y, MARK_MM) for k, (x, y) in enumerate(places))
    return Coupon(
        (width, height),
        feed_mm_s,
        passes_count,
        tuple(slits),
        tuple(windows),
        MarkSheet("coupon", (width, height), marks),
    )


def mark_strokes(coupon: Coupon, spot_mm: float) -> list[CutPath]:
    """Return the strokes that engrave the marks."""
    return hatch(sheet_ink(coupon.marks), spot_mm, spot_mm)


def strokes_at(coupon: Coupon, power_frac: float) -> list[CutPath]:
    """Return the cuts of one power: slits first, then the square, drawn on its line without kerf compensation."""
    slits = [CutPath("slit", s.ends) for s in coupon.slits if s.power_frac == power_frac]
    half = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]]) / 2
    squares = [
        CutPath("slit", np.array(w.centre_mm) + half * w.side_mm) for w in coupon.windows if w.power_frac == power_frac
    ]
    return (slits + squares) * coupon.passes_count


def id_places(coupon: Coupon) -> tuple[Anchor, Box]:
    """Return where the id's text and its code are engraved: between the upper marks, a margin from them."""
    across, up = id_size_modules()
    width_mm, height_mm = across * MODULE_MM, up * MODULE_MM
    left, low = MARGIN_MM + MARK_MM + GAP_MM, coupon.size_mm[1] - MARGIN_MM - height_mm
    start, end = left + width_mm + GAP_MM, coupon.size_mm[0] - left
    text = Anchor((start + end) / 2, low + height_mm / 2, TEXT_MM, end - start)
    return text, Box(left, low, width_mm, height_mm)


def coupon_gcode(
    coupon: Coupon, engrave: LayerPreset, spot_mm: float, options: GcodeOptions, id_strokes: Sequence[CutPath] = ()
) -> tuple[str, ...]:
    """Return the program: marks and id, then the ladders in the order of their power."""
    first = gcode([*mark_strokes(coupon, spot_mm), *id_strokes], {"engrave": engrave}, options)
    lines = list(first[: -len(END)])
    for power in powers_of(coupon):
        preset = LayerPreset(power, coupon.feed_mm_s)
        lines += gcode(strokes_at(coupon, power), {"slit": preset}, options)[HEADER_LINES : -len(END)]
    return (*lines, *END)


def powers_of(coupon: Coupon) -> list[float]:
    """Return the coupon's powers, lowest first."""
    return sorted({slit.power_frac for slit in coupon.slits})


def moved(coupon: Coupon, x_mm: float, y_mm: float) -> MarkSheet:
    """Return the coupon's marks with its corner at (`x_mm`, `y_mm`)."""
    shifted = tuple(replace(m, x_mm=m.x_mm + x_mm, y_mm=m.y_mm + y_mm) for m in coupon.marks.marks)
    return replace(coupon.marks, marks=shifted)


def coupon_data(coupon: Coupon) -> dict[str, object]:
    """Return what makes the same coupon again, as plain JSON."""
    return {
        "format": FORMAT,
        "powers_frac": powers_of(coupon),
        "feed_mm_s": coupon.feed_mm_s,
        "passes_count": coupon.passes_count,
    }


def coupon_from(data: dict[str, object], where: str) -> Coupon:
    """Return the coupon of `coupon_data`; raise `UsageError` where it is none."""
    try:
        if data["format"] != FORMAT:
            text = f"coupon format {data['format']}, this tool reads {FORMAT}; make and cut the coupon again"
            raise UsageError(f"{where}: {text}")
        powers, feed, passes = data["powers_frac"], data["feed_mm_s"], data["passes_count"]
        if not isinstance(powers, list) or not isinstance(feed, int | float) or not isinstance(passes, int):
            raise ValueError("powers_frac must be a list, feed_mm_s a number, passes_count a whole number")
        if not (0 < feed < MOST_FEED_MM_S and 0 < passes <= MOST_PASSES_COUNT):
            limits = f"feed_mm_s up to {MOST_FEED_MM_S:g}, passes_count up to {MOST_PASSES_COUNT}"
            raise ValueError(f"{limits}, both above zero, not {feed:g} and {passes}")
        return make_coupon([float(p) for p in powers], float(feed), passes)
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError(f"{where}: not a coupon: {why_not(fault)}") from fault
