"""Find coded square markers in a picture: OpenCV proposes quadrilaterals, the marker's own picture decides.

A find is accepted only where the whole blurred picture of one marker correlates with the pixels, and clearly better
than that of any other marker. That reads markers whose modules are as small as the blur, and leaves textures alone.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fabctl.vision.template import (
    CORNERS,
    F64,
    Fit,
    correlation,
    fit,
    fitting_blur_px,
    homography,
    look,
    module_px,
    render,
    sample_grid,
    warp,
    worst_module,
)

Family = Literal["5x5_250", "mip_36h12"]
FAMILIES: dict[Family, str] = {"5x5_250": "DICT_5X5_250", "mip_36h12": "DICT_ARUCO_MIP_36h12"}
ACCEPT_RATIO = 0.80  # correlation of the whole picture, frame and margin included
MARGIN_RATIO = 0.06  # by how much the best code must beat the second
CODE_RATIO = 0.70  # correlation of the code's modules alone, where frame and margin no longer help
SCREEN_CODE_RATIO = 0.55  # correlation of the whole picture, before anything is fitted
WRONG_MODULE = 0.6  # of what a module of the other colour would show; one such makes it another marker
HOPELESS_RATIO = 0.6  # no change of blur brings a first fit below this to ACCEPT_RATIO
# What a quick first fit must show at least. Of markers at the limits of what is read the worst showed 0.95, 0.89, 0.12
# and 0.34: the whole, the code alone, its lead over other codes, the worst module.
SKETCH_RATIO, SKETCH_CODE_RATIO, SKETCH_LEAD_RATIO, SKETCH_WRONG_MODULE = 0.65, 0.5, -0.05, 1.5
SKETCH_STEPS = 8
ENOUGH_SIDE_PX = 1600  # a picture still larger is halved once more
SAME_QUAD_RATIO = 0.02  # of the side: nearer outlines are one and the same
SCREEN_RATIO = 0.45  # correlation with the bare frame that a quadrilateral needs to be looked at further
BLURS_px = (0.5, 0.9, 1.4, 2.0, 3.0)
COARSE_PER_MODULE = 3
LARGE_MODULE_PX, SMALL_MODULE_PX = 14.0, 8.0  # modules of more than the first are read at no more than the second
LEAST_SMALL_PX = 8
LIKELY_COUNT = 24  # codes that are compared at every blur


@dataclass(frozen=True, slots=True)
class Marker:
    """One marker in a picture. `H` maps its own frame (-1 to 1, y down) to pixels."""

    family: Family
    id: int
    H: F64  # (3, 3)
    score_ratio: float
    contrast_frac: float
    blur_px: float
    module_px: float  # the shorter side of a module

    @property
    def centre_px(self) -> F64:
        """Return the picture of the marker's centre (2,), perspective included."""
        return np.asarray(self.H[:2, 2] / self.H[2, 2], dtype=np.float64)

    @property
    def corners_px(self) -> F64:
        """Return the corners (4, 2): upper left, upper right, lower right, lower left in the marker's own frame."""
        return warp(self.H, CORNERS)


@functools.cache
def codes(family: Family) -> F64:
    """Return the modules (ids, m, m) of every marker of the family, frame included; 1 is white."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family]))
    inner = int(dictionary.markerSize)
    found = np.zeros((len(dictionary.bytesList), inner + 2, inner + 2))
    for k, row in enumerate(dictionary.bytesList):
        found[k, 1:-1, 1:-1] = cv2.aruco.Dictionary.getBitsFromByteList(row[None], inner)
    return found


def find_markers(
    image: NDArray[np.uint8],
    family: Family = "5x5_250",
    *,
    upscale: int = 1,
    inverted: bool = False,
    smallest_px: float = 20.0,
) -> list[Marker]:
    """Return the markers in a grey picture (h, w), each id once, by id.

    `upscale` enlarges the picture for the search alone, for markers of few pixels; `inverted` also takes light markers
    on dark ground; `smallest_px` is the least side of a marker.
    """
    best: dict[int, Marker] = {}
    for marker in find_all(image, family, upscale=upscale, inverted=inverted, smallest_px=smallest_px):
        if marker.id not in best or best[marker.id].score_ratio < marker.score_ratio:
            best[marker.id] = marker
    return [best[k] for k in sorted(best)]


def find_all(
    image: NDArray[np.uint8],
    family: Family = "5x5_250",
    *,
    upscale: int = 1,
    inverted: bool = False,
    smallest_px: float = 20.0,
) -> list[Marker]:
    """Return every marker in the picture, by id; an id that lies at two places comes twice. As `find_markers`."""
    grey = np.ascontiguousarray(image, dtype=np.float64)
    found: list[Marker] = []
    refused: list[F64] = []
    for quad in _quadrilaterals(image, family, upscale, inverted, smallest_px):
        if any(_same_place(quad, marker) for marker in found) or _among(quad, refused):
            continue  # OpenCV proposes the same outline once for each of its thresholds
        marker = read_quadrilateral(grey, quad, family, inverted)
        if marker is None:
            refused.append(quad)
        elif not any(_same_place(marker.corners_px, other) for other in found):
            found.append(marker)
    return sorted(found, key=lambda marker: marker.id)


def _same_place(quad: F64, marker: Marker) -> bool:
    side = float(np.linalg.norm(marker.corners_px[1] - marker.corners_px[0]))
    return bool(np.abs(quad.mean(axis=0) - marker.centre_px).max() < 0.15 * side)


def _among(quad: F64, refused: list[F64]) -> bool:
    if not refused:
        return False
    side = float(np.linalg.norm(quad[1] - quad[0]))
    return bool((np.abs(np.array(refused) - quad).max(axis=(1, 2)) < SAME_QUAD_RATIO * side).any())


def mirrored(image: NDArray[np.uint8], family: Family = "5x5_250") -> list[Marker]:
    """Return the markers that the picture shows only in a mirror: what a sheet upside down would give."""
    return find_markers(np.ascontiguousarray(image[:, ::-1]), family)


def read_quadrilateral(grey: F64, quad: F64, family: Family, inverted: bool = False) -> Marker | None:
    """Return the marker of which `quad` (4, 2), clockwise on the screen, is about the outline; None where none is.

    Where modules are large the marker is read in a smaller picture of its surroundings: samples far apart would mostly
    miss the edges, and those that an outline puts off them would not find back.
    """
    modules = codes(family).shape[1]
    H = homography(CORNERS, quad)
    halvings = _halvings(H, modules)
    if halvings:
        low = np.maximum(np.floor(quad.min(axis=0) - 0.5 * np.ptp(quad, axis=0)), 0)
        small = _halved(grey, low, np.ceil(quad.max(axis=0) + 0.5 * np.ptp(quad, axis=0)), halvings)
        if min(small.shape) < LEAST_SMALL_PX:
            return None
        marker = _read(small, homography(CORNERS, (quad - low) / 2**halvings), family, inverted)
        return None if marker is None else _enlarged(marker, low, 2**halvings)
    return _read(grey, H, family, inverted)


def _halvings(H: F64, modules: int) -> int:
    """Return how often the surroundings of an outline are halved before a marker is sought in it."""
    px = max(module_px(H, modules))
    return min(math.ceil(math.log2(px / SMALL_MODULE_PX)), 8) if LARGE_MODULE_PX < px < math.inf else 0


def _halved(grey: F64, low: F64, high: F64, count: int) -> F64:
    """Return the picture from corner to corner, smoothed and halved `count` times; its corner stays pixel (0, 0)."""
    import cv2

    (left, upper), (right, lower) = low.astype(int), high.astype(int)
    small = grey[upper:lower, left:right]
    for _ in range(count if small.size else 0):
        small = np.asarray(cv2.pyrDown(small), dtype=np.float64)
    return small


def _enlarged(marker: Marker, corner_px: F64, factor: int) -> Marker:
    """Return a marker as the picture shows it, of which it was read in a part from `corner_px` on, made smaller."""
    grow = np.array([[factor, 0, corner_px[0]], [0, factor, corner_px[1]], [0, 0, 1.0]])
    blur_px, module = marker.blur_px * factor, marker.module_px * factor
    return replace(marker, H=grow @ marker.H, blur_px=blur_px, module_px=module)


def _read(grey: F64, H: F64, family: Family, inverted: bool) -> Marker | None:
    modules = codes(family).shape[1]
    size_px = math.sqrt(math.prod(module_px(H, modules)))
    places = sample_grid(modules, COARSE_PER_MODULE)
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    seen = look(grey, warp(H, grid))
    frame = abs(correlation(seen[_frame_mask(modules)], _frame(modules)))
    if not frame >= SCREEN_RATIO:
        return None
    best = _likeliest(_unit(seen), family, size_px, inverted)
    if best[0] < SCREEN_CODE_RATIO:
        return None
    return _refined(grey, H, family, best[1], best[2], inverted)


def _likeliest(seen: F64, family: Family, size_px: float, inverted: bool) -> tuple[float, int, float]:
    """Return correlation, code (id and quarter turns) and blur that fit the samples `seen` (n,) best.

    All codes are compared at one blur, the likeliest of those at the others: blur changes how well a code fits, hardly
    which.
    """
    blurs = list({_level(blur_px / size_px): blur_px for blur_px in reversed(BLURS_px)}.items())
    middle = blurs.pop(len(blurs) // 2)
    near = seen.astype(np.float32)
    scores = _templates(family, middle[0]) @ near
    sizes = np.abs(scores) if inverted else scores
    chosen = np.argpartition(sizes, -LIKELY_COUNT)[-LIKELY_COUNT:]
    best = (abs(float(scores[chosen[-1]])), int(chosen[-1]), middle[1])
    for level, blur_px in (middle, *blurs):
        scores = _templates(family, level)[chosen] @ near
        k = int(np.argmax(np.abs(scores) if inverted else scores))
        if abs(scores[k]) > best[0]:
            best = (abs(float(scores[k])), int(chosen[k]), blur_px)
    return best


def _refined(grey: F64, H: F64, family: Family, k: int, blur_px: float, inverted: bool) -> Marker | None:
    """Fit code `k` (id and quarter turns), then let it stand against all others."""
    number, turns = divmod(k, 4)
    turned = H @ _quarter_turns(turns)
    bits = codes(family)[number]
    sketch = fit(grey, bits, turned / turned[2, 2], blur_px, SKETCH_STEPS, COARSE_PER_MODULE)
    if sketch is None or not _may_be(grey, sketch, family, number):
        return None
    found = _best_blur(grey, bits, sketch.H, blur_px)
    if found is None or found.score_ratio < (-1 if inverted else ACCEPT_RATIO) or abs(found.score_ratio) < ACCEPT_RATIO:
        return None
    if not _stands_out(grey, found, family, number) or worst_module(grey, bits, found) > WRONG_MODULE:
        return None
    px = module_px(found.H, len(bits))
    return Marker(family, number, found.H, abs(found.score_ratio), found.contrast_frac, found.blur_px, min(px))


def _best_blur(grey: F64, bits: F64, H: F64, blur_px: float) -> Fit | None:
    """Fit place and blur in turn: neither moves the other much."""
    best = fit(grey, bits, H, fitting_blur_px(grey, bits, H, blur_px))
    if best is None or abs(best.score_ratio) < HOPELESS_RATIO:
        return None
    blur_px = fitting_blur_px(grey, bits, best.H, best.blur_px)
    return best if blur_px == best.blur_px else fit(grey, bits, best.H, blur_px) or best


def _may_be(grey: F64, sketch: Fit, family: Family, number: int) -> bool:
    """Say whether a quick first fit is worth the full one; nearly all that is no marker ends here."""
    if abs(sketch.score_ratio) < SKETCH_RATIO:
        return False
    own, lead = _code_scores(grey, sketch, family, number)
    if own < SKETCH_CODE_RATIO or lead < SKETCH_LEAD_RATIO:
        return False
    return worst_module(grey, codes(family)[number], sketch) <= SKETCH_WRONG_MODULE


def _stands_out(grey: F64, found: Fit, family: Family, number: int) -> bool:
    """Say whether the code's own modules fit, and no other id fits nearly as well."""
    own, lead = _code_scores(grey, found, family, number)
    return own >= CODE_RATIO and lead >= MARGIN_RATIO


def _code_scores(grey: F64, found: Fit, family: Family, number: int) -> tuple[float, float]:
    """Return the correlation of the code's own modules, and by how much it beats that of any other id."""
    modules = codes(family).shape[1]
    places = sample_grid(modules, COARSE_PER_MODULE)
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    level = _level(found.blur_px / math.sqrt(math.prod(module_px(found.H, modules))))
    inner = np.abs(grid).max(axis=1) < 1 - 2 / modules
    seen = look(grey, warp(found.H, grid[inner]))
    scores = np.abs(_inner_templates(family, level) @ _unit(seen)).reshape(-1, 4).max(axis=1)
    own = float(scores[number])
    scores[number] = -1.0
    return own, own - float(scores.max())


def _unit(values: F64) -> F64:
    values = values - values.mean()
    return np.asarray(values / max(float(np.linalg.norm(values)), 1e-9), dtype=np.float64)


def _level(sigma_modules: float) -> float:
    """Return the blur rounded to a coarse step, so that few template sets are ever made."""
    return float(np.clip(round(sigma_modules * 5) / 5, 0.2, 1.0))


@functools.cache
def _pictures(family: Family, sigma_modules: float) -> F64:
    """Return (ids * 4, s * s): every marker of the family in its four turns, not normalised."""
    bits = codes(family)
    places = sample_grid(bits.shape[1], COARSE_PER_MODULE)
    turned = [render(np.rot90(code, k), places, (sigma_modules, sigma_modules)) for code in bits for k in range(4)]
    return np.array(turned).reshape(len(turned), -1)


@functools.cache
def _templates(family: Family, sigma_modules: float) -> NDArray[np.float32]:
    return np.apply_along_axis(_unit, 1, _pictures(family, sigma_modules)).astype(np.float32)


@functools.cache
def _inner_templates(family: Family, sigma_modules: float) -> F64:
    modules = codes(family).shape[1]
    places = sample_grid(modules, COARSE_PER_MODULE)
    inner = np.abs(np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)).max(axis=1) < 1 - 2 / modules
    return np.apply_along_axis(_unit, 1, _pictures(family, sigma_modules)[:, inner])


@functools.cache
def _frame_mask(modules: int) -> NDArray[np.bool_]:
    places = sample_grid(modules, COARSE_PER_MODULE)
    outer = np.abs(np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)).max(axis=1)
    return np.asarray(outer > 1 - 2 / modules)


@functools.cache
def _frame(modules: int) -> F64:
    places = sample_grid(modules, COARSE_PER_MODULE)
    outer = np.abs(np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)).max(axis=1)
    return np.asarray(outer[_frame_mask(modules)] > 1, dtype=np.float64)


def _quarter_turns(count: int) -> F64:
    """Return the turn that undoes `np.rot90(code, count)` in the marker's frame (y down)."""
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][count % 4]
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


def _quadrilaterals(
    image: NDArray[np.uint8], family: Family, upscale: int, inverted: bool, smallest_px: float
) -> list[F64]:
    """Return what OpenCV takes for outlines of markers, accepted or not, in pixels of the picture itself.

    The half-sized picture is searched as well: in it grain and noise no longer fray the outline of a pale marker. A
    large picture is halved further: a module wider than OpenCV's windows has no outline for it.
    """
    import cv2

    found = []
    scales = [float(upscale), 0.5]
    while max(image.shape) * scales[-1] > ENOUGH_SIDE_PX:
        scales.append(scales[-1] / 2)
    for scale in scales:
        if min(image.shape) * scale < smallest_px:
            continue
        how = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
        sized = image if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=how)
        found += [
            (quad + 0.5) / scale - 0.5
            for quad in _outlines(np.ascontiguousarray(sized, dtype=np.uint8), family, inverted, smallest_px)
        ]
    return found


def _outlines(image: NDArray[np.uint8], family: Family, inverted: bool, smallest_px: float) -> list[F64]:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.minMarkerPerimeterRate = 4 * smallest_px / max(image.shape)
    parameters.polygonalApproxAccuracyRate = 0.06
    parameters.adaptiveThreshWinSizeMax = 53
    parameters.adaptiveThreshConstant = 3
    parameters.minMarkerDistanceRate = 0.05
    parameters.detectInvertedMarker = inverted
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family]))
    accepted, _, rejected = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    return [np.asarray(quad, dtype=np.float64).reshape(4, 2) for quad in (*accepted, *rejected)]
