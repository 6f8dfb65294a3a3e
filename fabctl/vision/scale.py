"""Millimetres for a scan: from marks whose distances are known, or from pairs of points picked on it.

A photogrammetry cloud has a scale and a frame of its own. Coded marks seen in its pictures are placed in that frame by
the pictures' poses (COLMAP's text model, which other programs also export), or are given as points on the cloud; their
true places then fix scale, turn and shift. Bars, pairs of points with a known distance, fix the scale alone.

Three errors make the scale's uncertainty: of each mark's or bar's own place, by how badly they fit; of each picture's
pose, which moves all its marks together and so leaves no misfit, by leaving each picture out in turn (Efron and Stein
1981); and of the mark finder, alike in all pictures. An error of the board's own measured size is in none of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from design.findings import Finding, errors
from fabctl.errors import RefusedError
from fabctl.vision.boards import MarkSheet
from fabctl.vision.template import F64

LEAST_MARKS_COUNT = 3
MOST_SPREAD_RATIO = 0.005  # between the scales that single distances give
MOST_ERROR_RATIO = 0.01  # of the marks' extent: a mark placed worse is not that mark
LEAST_RAY_ANGLE_RAD = math.radians(3)  # rays flatter to each other than this place nothing
FINDER_PX = 0.005  # standard; what moves marks outwards or inwards in every picture, as lens curvature within a mark
COVERAGE_FRAC = 0.9545  # what k = 2 means for many values; Student's factor where they are few
MOST_RAY_RATIO = 0.01  # distance of a ray from its point, over the distance to the camera


@dataclass(frozen=True, slots=True)
class Bar:
    """Two points of the scan, in its own unit, whose distance is `length_mm`."""

    first: F64  # (3,)
    second: F64  # (3,)
    length_mm: float


@dataclass(frozen=True, slots=True)
class ScanScale:
    """How a scan becomes millimetres: scaled, turned and shifted by `to_mm`; scaled alone where only bars are known."""

    mm_per_unit_ratio: float
    uncertainty_ratio: float  # expanded (k = 2), relative
    to_mm: F64  # (4, 4) similarity from the scan's frame to that of the marks
    spread_ratio: float  # of the scales that single distances give, relative
    used_count: int
    rms_mm: float | None
    findings: tuple[Finding, ...]


@dataclass(frozen=True, slots=True)
class ShotPose:
    """One picture of the scan: a point X of the scan's frame is in front of the lens at R X + t."""

    K: F64
    distortion: F64  # OpenCV's k1, k2, p1, p2
    R: F64
    t: F64


def scale_by_bars(bars: Sequence[Bar]) -> ScanScale:
    """Return the scale that the bars give; raise `RefusedError` where they contradict each other or have no length."""
    lengths = np.array([np.linalg.norm(np.subtract(bar.second, bar.first)) for bar in bars])
    told = np.array([bar.length_mm for bar in bars])
    if not len(bars) or not (np.all(np.isfinite(lengths)) and np.all(lengths > 0) and np.all(told > 0)):
        raise RefusedError("no scale", [Finding("SCALE-BARS", "every bar needs two different points and a length")])
    mm_per_unit = float(told @ lengths / (lengths @ lengths))
    spread = _spread(told / lengths / mm_per_unit, told)
    found = _spread_findings(spread, "bars", [f"bar {k}" for k in range(len(bars))], told / lengths / mm_per_unit)
    if len(bars) == 1:
        found.append(Finding("SCALE-ONE-BAR", "one bar alone cannot be checked", "warning", hint="give a second"))
    if errors(found):
        raise RefusedError("the bars contradict each other", found)
    matrix = np.diag([mm_per_unit] * 3 + [1.0])
    rest_mm = mm_per_unit * lengths - told
    doubt = _doubt(rest_mm, len(bars) - 1, float(np.linalg.norm(told)))
    return ScanScale(mm_per_unit, doubt, matrix, spread, len(bars), None, tuple(found))


def scale_by_marks(places: Mapping[int, F64], sheet: MarkSheet, plane_mm: float = 0.0) -> ScanScale:
    """Return scale and first pose from the marks' centres in the scan's own frame, id -> (3,).

    The result's frame is the sheet's (z up, marks at `plane_mm`). A mark that contradicts the others is left out with a
    warning where five or more are known; otherwise contradiction is refused.
    """
    return _agreed(places, sheet, plane_mm)[0]


def _agreed(places: Mapping[int, F64], sheet: MarkSheet, plane_mm: float) -> tuple[ScanScale, list[int]]:
    """Return the scale by the marks that agree, and their ids."""
    ids = sorted(k for k in places if sheet.mark(k) is not None)
    dropped: list[Finding] = []
    while True:
        made, worst = _by_marks({k: places[k] for k in ids}, sheet, plane_mm, dropped)
        if not errors(made.findings):
            return made, ids
        if len(ids) <= LEAST_MARKS_COUNT + 1:
            raise RefusedError("the marks give no scale", made.findings)
        ids.remove(worst)
        dropped.append(Finding("SCALE-MARK-DROPPED", f"mark {worst} contradicts the others and is left out", "warning"))


def _by_marks(
    places: Mapping[int, F64], sheet: MarkSheet, plane_mm: float, before: Sequence[Finding]
) -> tuple[ScanScale, int]:
    known = {mark.id: np.array([mark.x_mm, mark.y_mm, plane_mm]) for mark in sheet.marks}
    ids = sorted(places)
    if len(ids) < LEAST_MARKS_COUNT:
        text = f"{len(ids)} marks of {sheet.name} known in the scan, at least {LEAST_MARKS_COUNT} are needed"
        raise RefusedError("the marks give no scale", [*before, Finding("SCALE-FEW", text)])
    seen, told = np.array([places[k] for k in ids]), np.array([known[k] for k in ids])
    pairs = list(itertools.combinations(range(len(ids)), 2))
    lengths = np.array([np.linalg.norm(seen[a] - seen[b]) for a, b in pairs])
    true = np.array([np.linalg.norm(told[a] - told[b]) for a, b in pairs])
    mm_per_unit, R, t = similarity(seen, told)
    ratios = true / np.maximum(lengths, 1e-12) / mm_per_unit
    rest_mm = np.linalg.norm(mm_per_unit * seen @ R.T + t - told, axis=1)
    spread = _spread(ratios, true)
    found = [*before, *_spread_findings(spread, "marks", [f"marks {ids[a]} and {ids[b]}" for a, b in pairs], ratios)]
    worst = int(np.argmax(rest_mm))
    if rest_mm[worst] > MOST_ERROR_RATIO * float(true.max()):
        text = f"mark {ids[worst]} lies {rest_mm[worst]:.2f} mm from where the others put it"
        found.append(Finding("SCALE-MARK", text, hint="another mark, moved, or wrongly placed in the scan"))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = mm_per_unit * R, t
    rms = float(np.sqrt(np.mean(rest_mm**2)))
    # All marks lie in one plane, so to first order only what is off within it bears on the scale: 2 n coordinates, of
    # which shift, turn and scale take four.
    flat_mm = (mm_per_unit * seen @ R.T + t - told)[:, :2].ravel()
    doubt = _doubt(flat_mm, len(flat_mm) - 4, float(np.linalg.norm(told - told.mean(axis=0))))
    return ScanScale(mm_per_unit, doubt, matrix, spread, len(ids), rms, tuple(found)), ids[worst]


def similarity(source: F64, target: F64) -> tuple[float, F64, F64]:
    """Return scale, turn (3, 3) and shift (3,) that take points (n, 3) to `target`, least squares (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(U) * np.linalg.det(Vt))) or 1.0])
    R = U @ sign @ Vt
    scale = float((S * np.diag(sign)).sum() / (a * a).sum())
    return scale, R, target.mean(axis=0) - scale * R @ source.mean(axis=0)


def _spread(ratios: F64, weight_mm: F64) -> float:
    """Return the standard deviation of relative scales, long distances counting more."""
    return float(np.sqrt(np.average((ratios - 1) ** 2, weights=weight_mm**2)))


def _doubt(rest_mm: F64, freedom_count: int, arm_mm: float) -> float:
    """Return the expanded relative uncertainty of a scale from its misfits; `arm_mm` is the norm of all lever arms."""
    if freedom_count < 1:
        return math.inf
    return _cover(freedom_count) * float(np.sqrt(rest_mm @ rest_mm / freedom_count)) / arm_mm


def _cover(freedom_count: int) -> float:
    """Return the coverage factor of a standard deviation that so many free values tell."""
    from scipy.stats import t

    return float(t.ppf((1 + COVERAGE_FRAC) / 2, freedom_count))


def _spread_findings(spread: float, what: str, names: Sequence[str], ratios: F64) -> list[Finding]:
    if spread <= MOST_SPREAD_RATIO:
        return []
    k = int(np.argmax(np.abs(ratios - 1)))
    text = f"the {what} give scales that differ by {spread:.2%}, {MOST_SPREAD_RATIO:.1%} is the limit"
    return [Finding("SCALE-SPREAD", text, where=names[k], hint=f"{names[k]}: {ratios[k] - 1:+.2%}")]


def triangulate(sightings: Sequence[tuple[ShotPose, F64]]) -> F64 | None:
    """Return the point (3,) of the scan's frame that pictures see at these pixels (2,); None where they do not agree.

    First the point nearest to all rays, then the least squares of the pixels themselves.
    """
    from scipy.optimize import least_squares

    rays = [_ray(pose, pixel) for pose, pixel in sightings]
    if len(rays) < 2 or _widest_angle([d for _, d in rays]) < LEAST_RAY_ANGLE_RAD:
        return None
    keep = [np.eye(3) - np.outer(d, d) for _, d in rays]
    start = np.linalg.solve(np.sum(keep, axis=0), np.sum([P @ o for P, (o, _) in zip(keep, rays, strict=True)], axis=0))

    def residual(point: F64) -> F64:
        return np.concatenate([_seen(pose, point) - pixel for pose, pixel in sightings])

    found = np.asarray(least_squares(residual, start, loss="soft_l1", f_scale=1.0).x, dtype=np.float64)
    off = [
        np.linalg.norm(P @ (found - o)) / max(float(np.linalg.norm(found - o)), 1e-12)
        for P, (o, _) in zip(keep, rays, strict=True)
    ]
    return found if float(np.median(off)) < MOST_RAY_RATIO else None


def _ray(pose: ShotPose, pixel: F64) -> tuple[F64, F64]:
    import cv2

    bare = cv2.undistortPoints(pixel.reshape(1, 1, 2), pose.K, pose.distortion).reshape(2)
    direction = pose.R.T @ np.array([bare[0], bare[1], 1.0])
    return -pose.R.T @ pose.t, direction / np.linalg.norm(direction)


def _seen(pose: ShotPose, point: F64) -> F64:
    import cv2

    turn = cv2.Rodrigues(pose.R)[0]
    pixel, _ = cv2.projectPoints(point.reshape(1, 1, 3), turn, pose.t, pose.K, pose.distortion)
    return np.asarray(pixel.reshape(2), dtype=np.float64)


def _widest_angle(directions: Sequence[F64]) -> float:
    cosines = np.clip(np.array(directions) @ np.array(directions).T, -1, 1)
    return float(np.arccos(cosines.min()))


def marks_in_pictures(shots: Sequence[tuple[ShotPose, Mapping[int, F64]]]) -> dict[int, F64]:
    """Return the place of every mark that two or more pictures see, id -> (3,); a shot is a pose and id -> pixel."""
    ids = sorted({k for _, seen in shots for k in seen})
    found = {}
    for k in ids:
        place = triangulate([(pose, seen[k]) for pose, seen in shots if k in seen])
        if place is not None:
            found[k] = place
    return found


Shots = Sequence[tuple[ShotPose, Mapping[int, F64]]]


def scale_by_shots(shots: Shots, sheet: MarkSheet, plane_mm: float = 0.0) -> ScanScale:
    """Return scale and first pose from where pictures see the marks, with what poses and mark finder add in doubt."""
    made, ids = _agreed(marks_in_pictures(shots), sheet, plane_mm)
    told = {k: mark.centre_mm for k in ids if (mark := sheet.mark(k)) is not None}
    doubt = math.hypot(made.uncertainty_ratio, _pose_doubt(shots, told), 2 * _finder_doubt(shots, told))
    return replace(made, uncertainty_ratio=doubt)


def _pose_doubt(shots: Shots, told: Mapping[int, F64]) -> float:
    """Return the expanded relative uncertainty by the pictures: how the scale changes as each is left out."""
    useful = [shot for shot in shots if any(k in told for k in shot[1])]
    n = len(useful)
    scales = []
    for left_out in range(n):
        places = marks_in_pictures([shot for k, shot in enumerate(useful) if k != left_out])
        ids = sorted(places.keys() & told.keys())
        if len(ids) < LEAST_MARKS_COUNT:
            return math.inf  # without this picture there is no scale, so nothing checks it
        target = np.array([[*told[k], 0.0] for k in ids])
        scales.append(similarity(np.array([places[k] for k in ids]), target)[0])
    spread = float(np.sqrt((n - 1) * np.var(scales)))
    return _cover(n - 1) * spread / float(np.mean(scales))


def _finder_doubt(shots: Shots, told: Mapping[int, F64]) -> float:
    """Return the standard relative uncertainty by the mark finder: its error over the marks' distances in a picture."""
    groups = [np.array([seen[k] for k in seen if k in told]) for _, seen in shots]
    arms = [float(np.sqrt(np.mean(np.sum((g - g.mean(axis=0)) ** 2, axis=1)))) for g in groups if len(g) > 1]
    return FINDER_PX / float(np.median(arms)) if arms else math.inf
