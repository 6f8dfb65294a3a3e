"""After the cut: what the bed picture shows of each path, against the design.

Across each path the missing light is added up and compared with that of the job's other paths: where hardly any is
missing there is no cut; where a good part is missing, but less than elsewhere, it is not through; and its centroid says
where the cut lies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from design.pattern.paths import CutPath
from fabctl.vision.profile import ToPixels, across, centroid_mm, linear_light, missing
from fabctl.vision.template import F64

State = Literal["cut", "missing", "not_through", "displaced", "unseen"]
REACH_MM = 0.9
INNER_MM = 0.55
EVERY_MM = 0.25
CLEAR_MM = 0.15  # no other path may come nearer to a profile than this
ENDS_MM = 0.3  # left out at both ends of a straight piece
MISSING_RATIO = 0.25  # of the job's typical missing light
THROUGH_RATIO = 0.86
MOST_DISPLACED_MM = 0.2
LEAST_WINDOWS_COUNT = 3
LEAST_SHARE_MM = 0.02  # typical missing light, as a width fully dark, below which nothing was cut at all


@dataclass(frozen=True, slots=True)
class SeenPath:
    """What the picture shows of one path; ratios are against the job's median path."""

    index: int
    layer: str
    cell: int | None
    state: State
    dark_ratio: float | None
    offset_mm: float | None
    middle_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Inspection:
    """All paths, and the whole job's shift."""

    paths: tuple[SeenPath, ...]
    dark_mm: float  # the median path's missing light, as the width of a fully dark line
    shift_mm: tuple[float, float]

    def faulty(self) -> list[SeenPath]:
        """Return the paths that are not as designed."""
        return [path for path in self.paths if path.state not in ("cut", "unseen")]


@dataclass(frozen=True, slots=True)
class _Windows:
    """Measured windows of one path: missing light (m,) as width, offset (m,) and the left normal of each (m, 2)."""

    dark_mm: F64
    offset_mm: F64
    normal: F64


def inspect(image: NDArray[np.uint8], paths: Sequence[CutPath], to_pixels: ToPixels, mm_per_px: float) -> Inspection:
    """Return what a grey bed picture shows of the `paths`; `to_pixels` takes the paths' own millimetres to pixels.

    Engraved layers are left out. Paths so crowded that no profile is free of neighbours are `unseen`.
    """
    light = linear_light(image)
    chosen = [(k, path) for k, path in enumerate(paths) if path.layer in ("slit", "hole", "outline")]
    clear = _Neighbours([path for _, path in chosen])
    windows = [_windows(light, path, n, clear, to_pixels, mm_per_px) for n, (_, path) in enumerate(chosen)]
    darks = [float(np.median(w.dark_mm)) for w in windows if len(w.dark_mm) >= LEAST_WINDOWS_COUNT]
    # The upper half of the paths: if some are missing, they must not lower what is typical.
    typical = float(np.median([d for d in darks if d >= np.median(darks)])) if darks else 0.0
    shift = _shift([w for w in windows if _is_through(w, typical)])
    seen = tuple(_judge(k, path, w, typical, shift) for (k, path), w in zip(chosen, windows, strict=True))
    return Inspection(seen, typical, (float(shift[0]), float(shift[1])))


def inspection_findings(inspection: Inspection) -> list[Finding]:
    """Return the inspection as findings: what is wrong, with how many paths, and the first few named."""
    if inspection.paths and inspection.dark_mm < LEAST_SHARE_MM:
        return [Finding("CUT-NOTHING", "no path of the design is seen cut", hint="the right sheet, place and picture?")]
    words = {"missing": "not cut", "not_through": "not through", "displaced": f"more than {MOST_DISPLACED_MM:g} mm off"}
    found = []
    for state, text in words.items():
        mine = [path for path in inspection.paths if path.state == state]
        if mine:
            named = ", ".join(f"{p.index} at ({p.middle_mm[0]:.0f}, {p.middle_mm[1]:.0f})" for p in mine[:5])
            more = "…" if len(mine) > 5 else ""
            found.append(Finding(f"CUT-{state.upper().replace('_', '-')}", f"{len(mine)} paths {text}: {named}{more}"))
    shift = math.hypot(*inspection.shift_mm)
    if shift > MOST_DISPLACED_MM:
        text = f"the whole job lies {shift:.2f} mm off ({inspection.shift_mm[0]:+.2f}, {inspection.shift_mm[1]:+.2f})"
        found.append(Finding("CUT-SHIFTED", text, hint="origin, alignment, or the sheet has moved (--registration)"))
    return found


class _Neighbours:
    """All straight pieces of a job, to ask whether a profile crosses another one."""

    def __init__(self, paths: Sequence[CutPath]) -> None:
        from shapely import STRtree, linestrings

        ends = [piece for path in paths for piece in _pieces(path)]
        self.owner = np.array([(n, k) for n, path in enumerate(paths) for k in range(len(_pieces(path)))]).reshape(
            -1, 2
        )
        self._tree = STRtree(np.asarray(linestrings(np.array(ends).reshape(-1, 2, 2))))

    def clear(self, path: int, piece: int, profiles: F64) -> NDArray[np.bool_]:
        """Return which profiles (m, 2, 2) come near no piece but their own."""
        from shapely import linestrings

        pairs = self._tree.query(linestrings(profiles), predicate="dwithin", distance=CLEAR_MM)
        strangers = np.any(self.owner[pairs[1]] != np.array([path, piece]), axis=1)
        free = np.ones(len(profiles), dtype=bool)
        free[pairs[0][strangers]] = False
        return free


def _pieces(path: CutPath) -> list[F64]:
    points = np.vstack([path.points_mm, path.points_mm[:1]]) if path.closed else path.points_mm
    return [points[k : k + 2] for k in range(len(points) - 1) if np.linalg.norm(points[k + 1] - points[k]) > 1e-6]


def _windows(
    light: F64, path: CutPath, number: int, clear: _Neighbours, to_pixels: ToPixels, mm_per_px: float
) -> _Windows:
    dark, offset, normals = [], [], []
    step = mm_per_px / 4
    for k, ends in enumerate(_pieces(path)):
        direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        along = np.arange(ENDS_MM, float(np.linalg.norm(ends[1] - ends[0])) - ENDS_MM, EVERY_MM)
        if not len(along):
            continue
        left = np.array([-direction[1], direction[0]])
        places = ends[0] + along[:, None] * direction
        free = clear.clear(number, k, np.stack([places - REACH_MM * left, places + REACH_MM * left], axis=1))
        if not free.any():
            continue
        rows = across(light, to_pixels, ends, REACH_MM, step, along[free])
        background, lacking = missing(rows, INNER_MM)
        dark.append((lacking / np.maximum(background, 1e-3)).sum(axis=1) * step)
        offset.append(centroid_mm(rows, np.maximum(lacking - 0.15 * lacking.max(axis=1, keepdims=True), 0.0)))
        normals.append(np.tile(left, (int(free.sum()), 1)))
    if not dark:
        return _Windows(np.empty(0), np.empty(0), np.empty((0, 2)))
    return _Windows(np.concatenate(dark), np.concatenate(offset), np.vstack(normals))


def _is_through(windows: _Windows, typical: float) -> bool:
    return len(windows.dark_mm) >= LEAST_WINDOWS_COUNT and float(np.median(windows.dark_mm)) > THROUGH_RATIO * typical


def _shift(windows: Sequence[_Windows]) -> F64:
    """Return the common displacement (2,) that explains the offsets along all normals best."""
    good = [(w.normal, w.offset_mm) for w in windows]
    if not good:
        return np.zeros(2)
    normal, offset = np.vstack([n for n, _ in good]), np.concatenate([o for _, o in good])
    sound = np.isfinite(offset)
    if np.linalg.matrix_rank(normal[sound]) < 2:
        return np.zeros(2)
    return np.asarray(np.linalg.lstsq(normal[sound], offset[sound], rcond=None)[0], dtype=np.float64)


def _judge(index: int, path: CutPath, windows: _Windows, typical: float, shift: F64) -> SeenPath:
    middle = path.points_mm.mean(axis=0)
    place = (float(middle[0]), float(middle[1]))
    if len(windows.dark_mm) < LEAST_WINDOWS_COUNT or typical < LEAST_SHARE_MM:
        return SeenPath(index, path.layer, path.cell, "unseen", None, None, place)
    ratio = float(np.median(windows.dark_mm)) / typical
    # A path cut through along half its length only has a dark half: the low quarter tells.
    low = float(np.quantile(windows.dark_mm, 0.25)) / typical
    own = windows.offset_mm - windows.normal @ shift
    offset = float(np.nanmedian(np.abs(own))) if np.isfinite(own).any() else None
    state: State = "cut"
    if ratio < MISSING_RATIO:
        state, offset = "missing", None
    elif offset is not None and offset > MOST_DISPLACED_MM:
        state = "displaced"  # said first: part of its darkness lies outside the window
    elif min(ratio, low / 0.9) < THROUGH_RATIO:
        state = "not_through"
    return SeenPath(index, path.layer, path.cell, state, ratio, offset, place)
