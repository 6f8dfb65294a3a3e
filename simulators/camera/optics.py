"""The camera's picture of flat things: a lens with distortion, blur, uneven light, glare, dust, smoke and noise.

Machine frame: x right, y up, z towards the camera. Camera frame: OpenCV's, z away from the camera.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.camera.burn import F32, F64, burned, fluence, on_sheet, strokes, to_sheet
from simulators.camera.scene import Camera, Charuco, Mark, Scene, Sheet

FAMILIES = {"5x5_250": cv2.aruco.DICT_5X5_250, "mip_36h12": cv2.aruco.DICT_ARUCO_MIP_36h12}
SUPER = 2  # samples per pixel along each axis
FINE = 32  # grains to a module of a printed mark
PATCH = 4  # samples to a texel while printing it
COARSE_PX = 16  # the lens is inverted on a grid this wide and interpolated


@dataclass(frozen=True, slots=True)
class View:
    """Where the camera is: machine point X is seen at R X + t."""

    K: F64
    distortion: F64
    R: F64
    t_mm: F64

    def project(self, points_mm: F64) -> F64:
        """Return pixels (n, 2) of machine points (n, 3)."""
        seen, _ = cv2.projectPoints(points_mm, cv2.Rodrigues(self.R)[0], self.t_mm, self.K, self.distortion)
        return np.asarray(seen.reshape(-1, 2), dtype=np.float64)


def view_of(camera: Camera) -> View:
    """Return the camera's true geometry."""
    w, h = camera.size_px
    cx, cy = (w - 1) / 2 + camera.centre_offset_px[0], (h - 1) / 2 + camera.centre_offset_px[1]
    K = np.array([[camera.focal_px, 0, cx], [0, camera.focal_px, cy], [0, 0, 1.0]])
    down = np.diag([1.0, -1.0, -1.0])
    R = _tilt(camera.tilt_rad, camera.tilt_to_rad) @ _about_z(camera.turn_rad) @ down
    target = np.array([*(np.array(camera.looks_at_mm) + np.array(camera.shift_mm)), 0.0])
    t = np.array([0, 0, camera.focal_px * camera.mm_per_px]) - R @ target
    return View(K, np.array(camera.distortion_ratio), R, t)


def _about_z(angle_rad: float) -> F64:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _tilt(angle_rad: float, towards_rad: float) -> F64:
    axis = np.array([-math.sin(towards_rad), math.cos(towards_rad), 0.0]) * angle_rad
    return np.asarray(cv2.Rodrigues(axis)[0], dtype=np.float64)


def rays(view: View, size_px: tuple[int, int]) -> tuple[F32, F32]:
    """Return the direction (x/z, y/z) that each sample of the picture looks along, SUPER samples a pixel."""
    return _rays(tuple(view.K.ravel()), tuple(view.distortion), size_px)


@functools.lru_cache(maxsize=1)  # one lens takes many pictures, and the arrays are large
def _rays(K: tuple[float, ...], distortion: tuple[float, ...], size_px: tuple[int, int]) -> tuple[F32, F32]:
    w, h = size_px
    us, vs = np.arange(-COARSE_PX, w + 2 * COARSE_PX, COARSE_PX), np.arange(-COARSE_PX, h + 2 * COARSE_PX, COARSE_PX)
    grid = np.stack(np.meshgrid(us, vs), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
    bare = cv2.undistortPoints(grid, np.reshape(K, (3, 3)), np.array(distortion), criteria=criteria).reshape(
        len(vs), len(us), 2
    )
    from scipy.interpolate import RectBivariateSpline

    fine_u = (np.arange(w * SUPER) + 0.5) / SUPER - 0.5
    fine_v = (np.arange(h * SUPER) + 0.5) / SUPER - 0.5
    x, y = (RectBivariateSpline(vs, us, bare[..., k])(fine_v, fine_u).astype(np.float32) for k in (0, 1))
    return x, y


def plane_points(view: View, x: F32, y: F32, origin_mm: F64, axes: F64) -> tuple[F32, F32]:
    """Return where rays meet a plane: coordinates along its unit `axes` (2, 3) from `origin_mm`, machine frame."""
    back = np.column_stack([view.R @ axes[0], view.R @ axes[1], view.R @ origin_mm + view.t_mm])
    H = np.linalg.inv(back).astype(np.float32)
    depth = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    return (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / depth, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / depth


def draw_mark(texture: F32, mark: Mark, texel_mm: float, white: float | None, black: float) -> None:
    """Print a mark into a texture (row 0 up at its height); `white` also prints the paper around it."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[mark.family])
    cells = dictionary.markerSize + 2
    bits = cv2.aruco.generateImageMarker(dictionary, mark.id, cells)
    reach = mark.side_mm * (0.5 + 1 / cells) * 1.5
    height_mm = texture.shape[0] * texel_mm
    c0, c1 = (int((mark.x_mm + s * reach) / texel_mm) for s in (-1, 1))
    r0, r1 = (int((height_mm - mark.y_mm + s * reach) / texel_mm) for s in (-1, 1))
    c0, r0, c1, r1 = max(c0, 0), max(r0, 0), min(c1, texture.shape[1]), min(r1, texture.shape[0])
    ink = np.pad(np.kron(bits == 0, np.ones((FINE, FINE))), FINE).astype(np.float32)
    # From a quarter texel of the patch to a grain of the drawing, pixel centres at whole numbers on both sides.
    step, grain_mm = texel_mm / PATCH, mark.side_mm / cells / FINE
    c, s = math.cos(mark.turn_rad) / grain_mm, math.sin(mark.turn_rad) / grain_mm
    middle = len(ink) / 2 - 0.5
    x0, y0 = c0 * texel_mm + step / 2 - mark.x_mm, height_mm - r0 * texel_mm - step / 2 - mark.y_mm
    back = np.array([[c * step, -s * step, c * x0 + s * y0], [s * step, c * step, -(c * y0 - s * x0)]])
    back[:, 2] += middle
    size = ((c1 - c0) * PATCH, (r1 - r0) * PATCH)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shares = [cv2.warpAffine(drawn, back, size, flags=flags) for drawn in (ink, np.ones_like(ink))]
    ink_share, paper_share = (cv2.resize(share, (c1 - c0, r1 - r0), interpolation=cv2.INTER_AREA) for share in shares)
    spot = texture[r0:r1, c0:c1]
    if white is not None:
        spot[:] = spot * (1 - paper_share) + white * paper_share
    spot[:] = spot * (1 - ink_share) + black * ink_share


def plain(size_mm: tuple[float, float], texel_mm: float, grey: float, texture: float, rng: np.random.Generator) -> F32:
    """Return a surface of about one grey with a soft grain."""
    shape = (math.ceil(size_mm[1] / texel_mm), math.ceil(size_mm[0] / texel_mm))
    small = rng.standard_normal((shape[0] // 4 + 1, shape[1] // 4 + 1)).astype(np.float32)
    grain = cv2.resize(cv2.GaussianBlur(small, (0, 0), 1.0), shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(grey * (1 + texture * grain / max(float(grain.std()), 1e-6)), dtype=np.float32)


def bed_texture(scene: Scene, texel_mm: float) -> F32:
    """Return the bed with its printed marks."""
    rng = np.random.default_rng([scene.seed, 1])
    surface = plain(scene.bed.size_mm, texel_mm, scene.bed.grey_frac, scene.bed.texture_frac, rng)
    for mark in scene.bed.marks:
        draw_mark(surface, mark, texel_mm, scene.bed.marks_grey_frac, 0.05)
    return surface


def sheet_texture(scene: Scene, sheet: Sheet, trace: F64, texel_mm: float) -> F32:
    """Return the sheet in its own frame, with its marks and what was burned into it."""
    rng = np.random.default_rng([scene.seed, 2])
    surface = plain(sheet.size_mm, texel_mm, sheet.grey_frac, sheet.texture_frac, rng)
    for mark in sheet.marks:
        draw_mark(surface, mark, texel_mm, None, 0.05)
    found = strokes(trace)
    if not len(found):
        return surface
    return burned(surface, fluence(on_sheet(found, sheet), sheet.size_mm, texel_mm, sheet.beam), sheet, texel_mm)


def charuco_texture(board: Charuco, texel_mm: float) -> F32:
    """Return a printed ChArUco board with a white border of half a square."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    ids = board.first_id + np.arange(board.columns_count * board.rows_count // 2, dtype=np.int32)
    size = (board.columns_count, board.rows_count)
    print_ = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary, ids)
    texels = round(board.square_mm / texel_mm)
    drawn = print_.generateImage((size[0] * texels, size[1] * texels), marginSize=0)
    half = texels // 2
    page = cv2.copyMakeBorder(drawn, half, half, half, half, cv2.BORDER_CONSTANT, value=255)
    return np.asarray(0.05 + page.astype(np.float32) / 255 * 0.8, dtype=np.float32)


Layer = tuple[F32, Callable[[F32, F32], tuple[F32, F32]]]


def develop(light: F32, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the 8-bit picture of linear `light` (h, w): weather, blur, noise, sRGB."""
    h, w = light.shape
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    x, y = (x - w / 2) / w, (y - h / 2) / w
    light = light * (1 - camera.vignette_frac * (x**2 + y**2) / 0.35) * (1 - camera.slope_frac * (x + 0.6 * y))
    if camera.smoke_frac:
        plume = cv2.resize(rng.random((5, 7)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
        veil = np.clip(plume, 0, 1) * camera.smoke_frac
        light = light * (1 - veil) + 0.6 * veil
    for _ in range(camera.glare_count):
        u, v, r = rng.uniform(-0.45, 0.45), rng.uniform(-0.3, 0.3), rng.uniform(0.01, 0.03)
        light = light + 1.5 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / r**2)
    for _ in range(camera.dust_count):
        spot = (int(rng.integers(w)), int(rng.integers(h)))
        cv2.circle(light, spot, int(rng.integers(1, 4)), float(rng.uniform(0, 0.8)), -1, cv2.LINE_AA)
    light = np.ascontiguousarray(light * camera.exposure_ratio, dtype=np.float32)
    if camera.blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), camera.blur_px)
    grey = 255 * srgb(np.clip(light, 0, 1)) + camera.noise_count * rng.standard_normal((h, w), dtype=np.float32)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def srgb(linear: F32) -> F32:
    """Return the sRGB code value (0 to 1) of linear light (IEC 61966-2-1)."""
    return np.asarray(
        np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    )


def compose(view: View, size_px: tuple[int, int], layers: list[Layer]) -> F32:
    """Return linear light (h, w): the last layer on top; where there is none, the dark of the machine."""
    w, h = size_px
    x, y = rays(view, size_px)
    light = np.full(x.shape, 0.02, dtype=np.float32)
    for texture, locate in layers:
        column, row = locate(x, y)
        reach = (column > -0.5) & (row > -0.5) & (column < texture.shape[1] - 0.5) & (row < texture.shape[0] - 0.5)
        seen = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        light = np.where(reach, seen, light)
    return np.asarray(cv2.resize(light, (w, h), interpolation=cv2.INTER_AREA), dtype=np.float32)


def flat_layer(view: View, texture: F32, texel_mm: float, height_mm: float, sheet: Sheet | None = None) -> Layer:
    """Return a texture lying at `height_mm` over the bed: the bed itself, or the sheet where it lies last."""

    def locate(x: F32, y: F32) -> tuple[F32, F32]:
        X, Y = plane_points(view, x, y, np.array([0, 0, height_mm]), np.eye(3)[:2])
        if sheet is not None:
            places = to_sheet(np.column_stack([X.ravel(), Y.ravel()]), sheet.poses[-1], sheet.size_mm)
            X, Y = (places[:, k].reshape(X.shape).astype(np.float32) for k in (0, 1))
        return X / texel_mm - 0.5, texture.shape[0] - Y / texel_mm - 0.5

    return texture, locate


def board_layer(view: View, texture: F32, texel_mm: float, turn: F64, place_mm: F64) -> Layer:
    """Return a board in the machine's frame: its middle at `place_mm`, its axes the first two columns of `turn`."""

    def locate(x: F32, y: F32) -> tuple[F32, F32]:
        X, Y = plane_points(view, x, y, place_mm, np.ascontiguousarray(turn.T[:2]))
        h, w = texture.shape
        return X / texel_mm + w / 2 - 0.5, h / 2 - Y / texel_mm - 0.5

    return texture, locate
