"""One cut as a program: a drawing, an id to engrave and a material's presets in; G-code lines out. Pure.

The design folder's `cut.nc` is this without an id; the laser room composes a run's own program with one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from design.errors import DesignError
from design.export.gcode import GcodeOptions, gcode
from design.pattern.drawing import Drawing
from design.pattern.font import text_strokes
from design.pattern.paths import CutPath, Layer, LayerPreset
from design.pattern.sequence import sequence
from design.pattern.toolpath import ToolOptions, along_mm, strokes_of

RAPID_MM_S, ACCELERATION_MM_S2 = 100.0, 500.0  # of a small gantry laser, for the estimate alone


@dataclass(frozen=True, slots=True)
class JobOptions:
    """How a drawing is cut: the beam, the machine, and how far apart strokes that follow each other should lie."""

    tool: ToolOptions = field(default_factory=ToolOptions)
    machine: GcodeOptions = field(default_factory=GcodeOptions)
    spread_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Job:
    """A program and what it was made from: `strokes` in the order of cutting, sheet millimetres."""

    lines: tuple[str, ...]
    strokes: tuple[CutPath, ...]
    bounds_mm: tuple[float, float, float, float]  # x, y lowest; x, y highest, of the strokes with the machine's origin
    cut_mm: float
    travel_mm: float
    time_s: float


def compose_job(
    drawing: Drawing,
    presets: Mapping[Layer, LayerPreset],
    options: JobOptions = JobOptions(),
    id_text: str = "",
    code: Sequence[CutPath] = (),
    remarks: Iterable[str] = (),
) -> Job:
    """Return the program that cuts `drawing` and engraves `id_text` at its anchor.

    `code` are further strokes to engrave, in sheet millimetres: the id's code, drawn into the drawing's `code_box`.
    Raises `DesignError` where a layer has no preset, the id has no place, or a path cannot be cut with this kerf.
    """
    paths = list(drawing.paths)
    if id_text:
        if drawing.id_anchor is None:
            raise DesignError(f"the drawing keeps no place for an id, so {id_text!r} cannot be engraved")
        for anchor in (drawing.id_anchor, *drawing.more_ids):
            paths += text_strokes(id_text, anchor)
    paths += code
    if not paths:
        raise DesignError("nothing is drawn, so there is nothing to cut")
    strokes = strokes_of(paths, options.tool)
    passes: dict[Layer, int] = {layer: preset.passes_count for layer, preset in presets.items()}
    strokes = sequence(strokes, passes, options.spread_mm)
    lines = gcode(strokes, presets, options.machine, remarks)
    points = np.vstack([stroke.points_mm for stroke in strokes]) + np.array(options.machine.origin_mm)
    low, high = points.min(axis=0), points.max(axis=0)
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return Job(lines, tuple(strokes), bounds, *amount(strokes, presets))


def amount(strokes: Sequence[CutPath], presets: Mapping[Layer, LayerPreset]) -> tuple[float, float, float]:
    """Return cut length and travel in mm, and an estimate of the time in s (one stop between strokes, no corners)."""
    lengths = [along_mm(stroke.points_mm)[-1] for stroke in strokes]
    moves = [math.dist(a.points_mm[-1].tolist(), b.points_mm[0].tolist()) for a, b in pairwise(strokes)]
    cutting_s = sum(_move_s(d, presets[s.layer].feed_mm_s) for d, s in zip(lengths, strokes, strict=True))
    return sum(lengths), sum(moves), cutting_s + sum(_move_s(d, RAPID_MM_S) for d in moves)


def _move_s(length_mm: float, speed_mm_s: float) -> float:
    """Return the time of one move from rest to rest."""
    ramp_mm = speed_mm_s**2 / ACCELERATION_MM_S2
    if length_mm < ramp_mm:
        return 2 * math.sqrt(length_mm / ACCELERATION_MM_S2)
    return length_mm / speed_mm_s + speed_mm_s / ACCELERATION_MM_S2
