"""Pictures for the camera's figures: ids under given conditions, things that are no marker, cut coupons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from design.pattern.paths import CutPath
from fabctl.vision.coupon import Coupon, mark_strokes, powers_of, strokes_at
from fabctl.vision.ids import id_sheet
from simulators.camera.picture import Studio
from simulators.camera.scene import Beam, Bed, Camera, Pose, Scene, Sheet

F64 = NDArray[np.float64]
Picture = NDArray[np.uint8]
SUPER = 4
UNIT = 16  # pixels of a module in the flat drawing


@dataclass(frozen=True, slots=True)
class Condition:
    """How an id is photographed; the contrast is (white - black) / white in code values."""

    module_px: float
    blur_px: float
    tilt_rad: float
    contrast_frac: float
    turn_rad: float
    tilt_to_rad: float


def draw_id(specimen: str) -> Picture:
    """Return the id as OpenCV draws its two markers, with a margin of two modules."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_MIP_36h12)
    page = np.full((12 * UNIT, 22 * UNIT), 255, np.uint8)
    for k, mark in enumerate(id_sheet(specimen, 1.0).marks):
        left = (2 + 10 * k) * UNIT
        page[2 * UNIT : 10 * UNIT, left : left + 8 * UNIT] = cv2.aruco.generateImageMarker(
            dictionary, mark.id, 8 * UNIT
        )
    return page


def photograph(page: Picture, condition: Condition, rng: np.random.Generator) -> Picture:
    """Return a page seen turned and tilted, blurred, in uneven light with noise of 2 grey levels."""
    c, s = math.cos(condition.turn_rad), math.sin(condition.turn_rad)
    a, b = math.cos(condition.tilt_to_rad), math.sin(condition.tilt_to_rad)
    towards = np.array([[a, -b, 0], [b, a, 0], [0, 0, 1.0]])
    # Seen from thirty pages away, so that the tilt shortens more than it converges.
    far = 1 / (3.0 * max(page.shape))
    lean = np.array([[1, 0, 0], [0, math.cos(condition.tilt_rad), 0], [0, math.sin(condition.tilt_rad) * far, 1.0]])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    h, w = page.shape
    middle = np.array([[1, 0, -(w - 1) / 2], [0, 1, -(h - 1) / 2], [0, 0, 1.0]])
    side = int(condition.module_px * 32)
    jitter = rng.uniform(-0.5, 0.5, 2)
    scale = condition.module_px / UNIT
    place = np.array([[scale, 0, side / 2 + jitter[0]], [0, scale, side / 2 + jitter[1]], [0, 0, 1.0]])
    fine = np.array([[SUPER, 0, (SUPER - 1) / 2], [0, SUPER, (SUPER - 1) / 2], [0, 0, 1.0]])
    M = fine @ place @ towards @ lean @ towards.T @ turn @ middle
    big = cv2.warpPerspective(page, M, (side * SUPER, side * SUPER), borderValue=255)
    light = cv2.resize(big, (side, side), interpolation=cv2.INTER_AREA).astype(np.float64) / 255
    light = cv2.GaussianBlur(light, (0, 0), condition.blur_px)
    slope = 1 - 0.3 * np.linspace(0, 1, side)[None, :]
    grey = 200 * (1 - condition.contrast_frac * (1 - light)) * slope + rng.normal(0, 2, light.shape)
    return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)


def no_marker(kind: int, rng: np.random.Generator) -> Picture:
    """Return a picture of 400 x 300 px without any marker of ours, one of twelve kinds."""
    first = (_blocks, _chessboard, _text, _slits, _foreign, _mirrored, _noise, _frames)
    makers = (*first, _wood, _room, _tilted_board, _mirrored_id)
    picture = makers[kind % len(makers)](rng)
    blurred = cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.3, 1.5)))
    return np.asarray(np.clip(blurred + rng.normal(0, 2, blurred.shape), 0, 255), dtype=np.uint8)


def _blocks(rng: np.random.Generator) -> Picture:
    size = int(rng.integers(5, 16))
    cells = rng.integers(0, 2, (300 // size + 1, 400 // size + 1)).astype(np.uint8) * 170 + 40
    return np.asarray(np.kron(cells, np.ones((size, size), np.uint8))[:300, :400], dtype=np.uint8)


def _chessboard(rng: np.random.Generator) -> Picture:
    size = int(rng.integers(8, 40))
    y, x = np.mgrid[0:300, 0:400] // size
    return np.asarray((x + y) % 2 * 180 + 30, dtype=np.uint8)


def _text(rng: np.random.Generator) -> Picture:
    page = np.full((300, 400), 220, np.uint8)
    letters = np.array(list("ABEFHKMNRSTXZ0123456789#"))
    for row in range(12):
        line = "".join(rng.choice(letters, 18))
        cv2.putText(page, line, (4, 24 + 24 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 30, int(rng.integers(1, 4)))
    return page


def _slits(rng: np.random.Generator) -> Picture:
    page = np.full((300, 400), 170, np.uint8)
    step = float(rng.uniform(18, 40))
    for r in range(int(300 / step / 0.866) + 1):
        for q in range(int(400 / step) + 1):
            centre = np.array([step * (q + 0.5 * (r % 2)), step * 0.866 * r])
            for k in range(3):
                d = np.array([math.cos(k * math.pi / 3 + 0.2), math.sin(k * math.pi / 3 + 0.2)]) * step * 0.45
                ends = np.rint(np.array([centre - d, centre + d]) * 16).astype(np.int32)
                cv2.polylines(page, [ends], False, 40, int(rng.integers(1, 3)), cv2.LINE_AA, 4)
    return page


def _foreign(rng: np.random.Generator) -> Picture:
    page = np.full((300, 400), 215, np.uint8)
    families = (cv2.aruco.DICT_4X4_50, cv2.aruco.DICT_6X6_50, cv2.aruco.DICT_7X7_50, cv2.aruco.DICT_APRILTAG_36h11)
    for k in range(6):
        drawn = cv2.aruco.generateImageMarker(
            cv2.aruco.getPredefinedDictionary(families[int(rng.integers(4))]), int(rng.integers(30)), 90
        )
        page[25 + 135 * (k // 3) : 115 + 135 * (k // 3), 25 + 125 * (k % 3) : 115 + 125 * (k % 3)] = np.maximum(
            drawn, 30
        )
    return page


def _mirrored(rng: np.random.Generator) -> Picture:
    page = np.full((300, 400), 215, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    for k in range(6):  # of the sheets' own ids; the family's id 129 is its own mirror image and on no sheet
        drawn = cv2.aruco.generateImageMarker(dictionary, int(rng.integers(50, 80)), 84)[:, ::-1]
        page[25 + 135 * (k // 3) : 109 + 135 * (k // 3), 25 + 125 * (k % 3) : 109 + 125 * (k % 3)] = np.maximum(
            drawn, 30
        )
    return page


def _noise(rng: np.random.Generator) -> Picture:
    small = rng.integers(0, 256, (int(rng.integers(20, 150)), int(rng.integers(20, 200)))).astype(np.uint8)
    return np.asarray(cv2.resize(small, (400, 300), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def _frames(rng: np.random.Generator) -> Picture:
    """Return black frames with random modules that spell no code: the hardest near misses."""
    from fabctl.vision.markers import codes

    page = np.full((300, 400), 215, np.uint8)
    for k in range(6):
        family = codes("5x5_250") if rng.integers(2) else codes("mip_36h12")
        n = family.shape[1]
        while True:
            bits = np.zeros((n, n))
            bits[1:-1, 1:-1] = rng.integers(0, 2, (n - 2, n - 2))
            apart = min(int(np.abs(np.rot90(bits, t) - family).sum(axis=(1, 2)).min()) for t in range(4))
            if apart >= 4:
                break
        drawn = np.kron(bits, np.ones((12, 12))) * 185 + 30
        row, column = 25 + 135 * (k // 3), 25 + 125 * (k % 3)
        page[row : row + 12 * n, column : column + 12 * n] = drawn
    return page


def _wood(rng: np.random.Generator) -> Picture:
    """Return planks: rings of an off-axis trunk, knots, dark joints."""
    y, x = np.mgrid[0:300, 0:400].astype(np.float64)
    page = np.zeros((300, 400))
    for k in range(4):
        wobble = 12 * np.sin(x / rng.uniform(40, 120) + rng.uniform(0, 6))
        rings = np.hypot((x - rng.uniform(0, 400)) / 9, y - 75 * k + wobble - rng.uniform(-200, 275))
        grain = 150 + 45 * np.sin(rings / rng.uniform(1.0, 3.5)) + 10 * rng.standard_normal((300, 400))
        page[75 * k : 75 * k + 75] = grain[75 * k : 75 * k + 75]
        page[75 * k : 75 * k + 2] = 40
    return np.asarray(np.clip(page, 0, 255), dtype=np.uint8)


def _room(rng: np.random.Generator) -> Picture:
    """Return what a photograph of things has: soft light of many scales, and dark and light boxes turned anyhow."""
    page = np.zeros((300, 400), np.float32)
    for size in (4, 8, 16, 32, 64):
        small = rng.standard_normal((size, size)).astype(np.float32)
        page += cv2.resize(small, (400, 300), interpolation=cv2.INTER_CUBIC) * 40 / math.sqrt(size)
    page = page - page.min()
    page *= 200 / float(page.max())
    for _ in range(int(rng.integers(15, 40))):
        x, y, w, h = (float(value) for value in rng.uniform([0, 0, 10, 10], [400, 300, 90, 90]))
        corners = cv2.boxPoints(((x, y), (w, h), float(rng.uniform(0, 90))))
        width = int(rng.choice([-1, 1, 3, 6]))
        grey = float(rng.uniform(0, 255))
        if width < 0:
            cv2.fillPoly(page, [np.rint(corners).astype(np.int32)], grey)
        else:
            cv2.polylines(page, [np.rint(corners).astype(np.int32)], True, grey, width)
    return np.asarray(np.clip(page, 0, 255), dtype=np.uint8)


def _tilted_board(rng: np.random.Generator) -> Picture:
    """Return a chessboard in perspective, some of its fields lost."""
    size = int(rng.integers(14, 40))
    y, x = np.mgrid[0:600, 0:800] // size
    fields = (x + y) % 2
    fields[rng.random((600 // size + 1, 800 // size + 1))[y, x] < 0.15] = 1
    corners = np.array([[0, 0], [800, 0], [800, 600], [0, 600]], np.float32)
    seen = np.array([[0, 0], [400, 0], [400, 300], [0, 300]]) + rng.uniform(-70, 70, (4, 2))
    H = cv2.getPerspectiveTransform(corners, seen.astype(np.float32))
    flat = (fields * 180 + 35).astype(np.uint8)
    return np.asarray(cv2.warpPerspective(flat, H, (400, 300), borderValue=120), dtype=np.uint8)


def _mirrored_id(rng: np.random.Generator) -> Picture:
    """Return two ids seen in a mirror."""
    page = np.full((300, 400), 215, np.uint8)
    for k in range(2):
        drawn = draw_id(f"S-{int(rng.integers(0, 15000)):04d}")[:, ::-1]
        page[6 + 146 * k : 6 + 146 * k + 144, 60:324] = cv2.resize(drawn, (264, 144), interpolation=cv2.INTER_AREA)
    return page


def trace_of(jobs: Sequence[tuple[CutPath, float, float]]) -> F64:
    """Return the burn trace of (stroke, power, speed), one after the other."""
    rows: list[list[float]] = []
    now_s = 0.0
    for stroke, power_frac, speed_mm_s in jobs:
        points = np.vstack([stroke.points_mm, stroke.points_mm[:1]]) if stroke.closed else stroke.points_mm
        steps_s = np.r_[0.01, np.linalg.norm(np.diff(points, axis=0), axis=1) / speed_mm_s]
        for k, (point, step_s) in enumerate(zip(points, steps_s, strict=True)):
            now_s += float(step_s)
            rows.append([now_s, float(point[0]), float(point[1]), 0.0 if k == len(points) - 1 else power_frac])
    return np.array(rows)


def photograph_coupon(coupon: Coupon, beam: Beam, over_light: bool, seed: int) -> Picture:
    """Return the cut coupon at 0.05 mm a pixel, over a light table or lit from the front."""
    w, h = coupon.size_mm
    rng = np.random.default_rng([seed, 9])
    grey, opened = (float(rng.uniform(0.04, 0.12)), 0.8) if over_light else (0.55, 0.03)
    sheet = Sheet(coupon.size_mm, poses=(Pose(),), grey_frac=grey, open_frac=opened, beam=beam)
    camera = Camera(
        size_px=(round(22 * w), round(22 * h)),
        mm_per_px=0.049,
        focal_px=3000.0,
        looks_at_mm=(w / 2, h / 2),
        tilt_rad=float(rng.uniform(0, 0.06)),
        tilt_to_rad=float(rng.uniform(0, 6)),
        turn_rad=float(rng.uniform(-0.1, 0.1)),
        blur_px=float(rng.uniform(0.6, 1.3)),
        distortion_ratio=(-0.02, 0.0, 0.0, 0.0, 0.0),
    )
    jobs = [(stroke, 0.12, 60.0) for stroke in mark_strokes(coupon, 0.15)]
    for power in powers_of(coupon):
        jobs += [(stroke, power, coupon.feed_mm_s) for stroke in strokes_at(coupon, power)]
    scene = Scene(camera=camera, bed=Bed((w, h)), sheet=sheet, texel_mm=0.0125, seed=seed)
    return Studio(scene).frame(0, trace_of(jobs))
