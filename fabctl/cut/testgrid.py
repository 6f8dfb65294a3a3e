"""A labelled grid of short cuts over power, speed and passes: how a new material finds its preset. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fabctl.cut.program import decimal

# Digits on a 2 × 4 lattice, as strokes of (x, y); a label needs no more.
GLYPHS: dict[str, tuple[tuple[tuple[int, int], ...], ...]] = {
    "0": (((0, 0), (2, 0), (2, 4), (0, 4), (0, 0)),),
    "1": (((0, 3), (1, 4), (1, 0)), ((0, 0), (2, 0))),
    "2": (((0, 4), (2, 4), (2, 2), (0, 2), (0, 0), (2, 0)),),
    "3": (((0, 4), (2, 4), (2, 0), (0, 0)), ((0, 2), (2, 2))),
    "4": (((0, 4), (0, 2), (2, 2)), ((2, 4), (2, 0))),
    "5": (((2, 4), (0, 4), (0, 2), (2, 2), (2, 0), (0, 0)),),
    "6": (((2, 4), (0, 4), (0, 0), (2, 0), (2, 2), (0, 2)),),
    "7": (((0, 4), (2, 4), (1, 0)),),
    "8": (((0, 0), (2, 0), (2, 4), (0, 4), (0, 0)), ((0, 2), (2, 2))),
    "9": (((2, 2), (0, 2), (0, 4), (2, 4), (2, 0), (0, 0)),),
    ".": (((1, 0), (1, 1)),),
    "%": (((0, 0), (2, 4)), ((0, 4), (0, 3)), ((2, 0), (2, 1))),
    "x": (((0, 0), (2, 2)), ((0, 2), (2, 0))),
}
GLYPH_MM, STEP_MM = 0.5, 1.6  # lattice unit; from one character to the next


@dataclass(frozen=True, slots=True)
class Grid:
    """What to try. Cells are squares of `cell_mm` holding one straight cut, and a closed square inside it."""

    powers_frac: tuple[float, ...]
    feeds_mm_s: tuple[float, ...]
    passes: tuple[int, ...] = (1,)
    cell_mm: float = 8.0
    gap_mm: float = 4.0
    label_power_frac: float = 0.12
    label_feed_mm_s: float = 60.0


def size_mm(grid: Grid) -> tuple[float, float]:
    """Return the width and height of the whole grid, labels included."""
    pitch = grid.cell_mm + grid.gap_mm
    return 12 + len(grid.powers_frac) * len(grid.passes) * pitch, 8 + len(grid.feeds_mm_s) * pitch


def grid_lines(grid: Grid, s_max_count: float) -> tuple[str, ...]:
    """Return the program: labels first, then the cells from the gentlest to the strongest, so that fire comes last.

    Columns are powers (repeated for each number of passes), rows are speeds.
    """
    pitch = grid.cell_mm + grid.gap_mm
    columns = [(power, passes) for passes in grid.passes for power in grid.powers_frac]
    lines = ["G21", "G90", "G94", "G17", "M4S0"]
    labels: list[str] = []
    for k, (power, passes) in enumerate(columns):
        labels += _text(f"{100 * power:.0f}%{passes}x", 12 + k * pitch, 2.0)
    for row, feed in enumerate(grid.feeds_mm_s):
        labels += _text(f"{feed:g}", 1.0, 8 + row * pitch + grid.cell_mm / 2 - 1)
    lines += _with_power(labels, grid.label_feed_mm_s, grid.label_power_frac * s_max_count)
    cells = [
        (power * passes / feed, 12 + k * pitch, 8 + row * pitch, power, feed, passes)
        for k, (power, passes) in enumerate(columns)
        for row, feed in enumerate(grid.feeds_mm_s)
    ]
    for _, x, y, power, feed, passes in sorted(cells):
        lines += _with_power(_cell(x, y, grid.cell_mm) * passes, feed, power * s_max_count)
    return (*lines, "G0X0Y0", "M5", "G4P0.01")


def _cell(x: float, y: float, size: float) -> list[str]:
    a, b = size * 0.25, size * 0.75
    square = [(a, a), (b, a), (b, b), (a, b), (a, a)]
    return [*_stroke([(x, y), (x + size, y)]), *_stroke([(x + u, y + v) for u, v in square])]


def _text(text: str, x: float, y: float) -> list[str]:
    lines: list[str] = []
    for k, letter in enumerate(text):
        for stroke in GLYPHS.get(letter, ()):
            lines += _stroke([(x + k * STEP_MM + GLYPH_MM * u, y + GLYPH_MM * v) for u, v in stroke])
    return lines


def _stroke(points: Sequence[tuple[float, float]]) -> list[str]:
    first, *rest = [f"X{decimal(x)}Y{decimal(y)}" for x, y in points]
    return [f"G0{first}", f"G1{rest[0]}", *rest[1:]]


def _with_power(lines: Sequence[str], feed_mm_s: float, s_count: float) -> list[str]:
    """Put feed and power on the first cut; both stay in force."""
    out, todo = [], True
    for line in lines:
        if todo and line.startswith("G1"):
            line, todo = f"{line}F{decimal(60 * feed_mm_s)}S{decimal(s_count)}", False
        out.append(line)
    return out
