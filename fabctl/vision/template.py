"""How a square marker looks through a blurring lens, and the exact place where a picture shows it.

A marker is a grid of black and white modules with a black frame and a white margin. Blurred by a Gaussian its grey
value has a closed form: each axis alone is a difference of two normal distributions, so the picture of every marker is
two small matrices around the module grid. Fitting that picture to the pixels by Gauss-Newton uses every edge of the
marker, where a corner detector uses four points.

Frames: a marker's own frame has x to the right and y down, the black square spans -1 to 1 in both. Pixel centres lie at
whole numbers.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

F64 = NDArray[np.float64]
MARGIN_MODULES = 1.0  # how much of the white margin takes part
PIXEL_SIGMA_PX = 0.29  # a square pixel blurs like a Gaussian of 1/sqrt(12)
FARTHEST_PX = 1e6
BLUR_STEP_RATIO = 1.15
LEAST_BLUR_PX, MOST_BLUR_PX = 0.1, 20.0
HUBER = 1.5  # residuals beyond this many standard deviations (dust, glare) count less


@dataclass(frozen=True, slots=True)
class Fit:
    """A marker's place: `H` maps its own frame (-1 to 1) to pixels; `score_ratio` is the correlation, 1 at best."""

    H: F64  # (3, 3)
    score_ratio: float
    contrast_frac: float  # white minus black over white, negative where white and black are exchanged
    blur_px: float


def warp(H: F64, points: F64) -> F64:
    """Return `points` (n, 2) mapped by the homography `H`."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:], dtype=np.float64)


def homography(source: F64, target: F64) -> F64:
    """Return the homography that maps four or more points (n, 2) to `target` with the least algebraic residual.

    Both sides are centred and scaled first (Hartley 1997), which the solution's accuracy needs.
    """
    Ns, Nt = _normaliser(source), _normaliser(target)
    s, t = warp(Ns, source), warp(Nt, target)
    one, zero = np.ones(len(s)), np.zeros((len(s), 3))
    h = np.column_stack([s, one])
    rows = np.vstack([np.hstack([h, zero, -t[:, :1] * h]), np.hstack([zero, h, -t[:, 1:] * h])])
    H = np.linalg.inv(Nt) @ np.linalg.svd(rows)[2][-1].reshape(3, 3) @ Ns
    return np.asarray(H / H[2, 2], dtype=np.float64)


def _normaliser(points: F64) -> F64:
    centre = points.mean(axis=0)
    scale = math.sqrt(2) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-12)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])


def sample_grid(modules: int, per_module: int) -> F64:
    """Return sample places (s,) along one axis in the marker's frame, margin included, `per_module` to a module."""
    half = 1 + 2 * MARGIN_MODULES / modules
    count = round((modules + 2 * MARGIN_MODULES) * per_module)
    return (np.arange(count) + 0.5) / count * 2 * half - half


def blur_matrix(places: F64, modules: int, sigma_modules: float) -> F64:
    """Return (s, modules) weights: how much of each module a blurred look at each place sees; the rest is white."""
    x = (places + 1) / 2 * modules
    edges = ndtr((x[:, None] - np.arange(modules + 1)) / max(sigma_modules, 1e-3))
    return np.asarray(edges[:, :-1] - edges[:, 1:], dtype=np.float64)


def render(bits: F64, places: F64, sigma_modules: tuple[float, float]) -> F64:
    """Return grey values (s, s) of a marker with the modules `bits` (1 white), blurred by sigma along x and along y."""
    ink = 1 - bits
    across, down = (blur_matrix(places, len(bits), sigma) for sigma in sigma_modules)
    return np.asarray(1 - down @ ink @ across.T, dtype=np.float64)


def module_px(H: F64, modules: int) -> tuple[float, float]:
    """Return how many pixels a module in the marker's middle is wide along its x and its y."""
    step = 1.0 / modules
    c, x, y = warp(H, np.array([[0.0, 0.0], [2 * step, 0.0], [0.0, 2 * step]]))
    return float(np.linalg.norm(x - c)), float(np.linalg.norm(y - c))


def look(image: F64, points_px: F64) -> F64:
    """Return grey values at `points_px` (n, 2), linear between pixels; the border repeats."""
    return np.asarray(map_coordinates(image, points_px[:, ::-1].T, order=1, mode="nearest"), dtype=np.float64)


def fit(image: F64, bits: F64, H: F64, blur_px: float, steps: int = 12, per_module: int | None = None) -> Fit | None:
    """Move `H` until the blurred marker matches the picture best; None where it runs away or the picture is flat.

    Unknown besides the eight of the homography: black, white, and a linear change of light over the marker.
    `per_module` is how many samples a module takes along each axis; None lets its size in the picture decide.
    """
    modules = len(bits)
    px = module_px(H, modules)
    if not min(px) > 0.5:
        return None
    places = sample_grid(modules, per_module or int(np.clip(math.ceil(max(px)), 3, 6)))
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    sigma_px = math.hypot(blur_px, PIXEL_SIGMA_PX)
    model = render(bits, places, (sigma_px / px[0], sigma_px / px[1])).ravel()
    fixed = np.column_stack([np.ones(len(grid)), model, grid])
    origin, planes = _patch(image, H, modules)
    if planes.size == 0:
        return None
    moved = _moved(planes, H, origin, grid, fixed, steps, 2.5 * max(px))
    return None if moved is None else _judge(moved, planes[:, :, 0], origin, grid, model, fixed, blur_px)


def fitting_blur_px(image: F64, bits: F64, H: F64, start_px: float) -> float:
    """Return the blur, to a step of `BLUR_STEP_RATIO`, with which the marker at `H` leaves the least unexplained."""
    modules, px = len(bits), module_px(H, len(bits))
    places = sample_grid(modules, int(np.clip(math.ceil(max(px)), 3, 6)))
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    light = np.linalg.qr(np.column_stack([np.ones(len(grid)), grid]))[0]
    grey = _without(light, look(image, warp(H, grid)))

    @functools.cache
    def explained(k: int) -> float:
        sigma_px = math.hypot(start_px * BLUR_STEP_RATIO**k, PIXEL_SIGMA_PX)
        model = _without(light, render(bits, places, (sigma_px / px[0], sigma_px / px[1])).ravel())
        return float(grey @ model) ** 2 / max(float(model @ model), 1e-12)

    best = 0
    for step in (-1, 1):
        while (
            explained(best + step) > explained(best) and LEAST_BLUR_PX < start_px * BLUR_STEP_RATIO**best < MOST_BLUR_PX
        ):
            best += step
    return start_px * BLUR_STEP_RATIO**best


def _without(level: F64, values: F64) -> F64:
    """Return `values` (n,) less what the orthonormal columns `level` (n, m) explain."""
    return np.asarray(values - level @ (level.T @ values), dtype=np.float64)


def _moved(planes: F64, H: F64, origin: F64, grid: F64, fixed: F64, steps: int, most_px: float) -> F64 | None:
    """Return `H` after Gauss-Newton; `fixed` (n, 4) are the columns of light. None where it moves over `most_px`."""
    ground = np.vstack([grid.T, np.ones(len(grid))])
    rows = np.empty((12, len(grid)))
    rows[8:] = -fixed.T
    level = np.linalg.qr(fixed)[0]
    moved_px = 0.0
    for _ in range(steps):
        grey = _steer(rows[:8], planes, H, origin, ground)
        weight = _trust(_without(level, grey))
        step = _solve_normal(rows * weight, -grey * weight)
        if step is None:
            return None
        before = warp(H, CORNERS)
        H = H + np.append(step[:8], 0.0).reshape(3, 3)
        change = float(np.abs(warp(H, CORNERS) - before).max())
        moved_px += change
        if not np.isfinite(change) or moved_px > most_px:
            return None
        if change < 2e-3:
            break
    return H


def _trust(plain: F64) -> F64:
    """Return the square roots of Huber's weights of residuals (n,)."""
    size = np.abs(plain)
    spread = max(1.4826 * float(np.partition(size, len(size) // 2)[len(size) // 2]), 1e-6)
    return np.asarray(np.sqrt(np.minimum(1.0, HUBER * spread / np.maximum(size, 1e-9))), dtype=np.float64)


CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def _solve(rows: F64, right: F64) -> F64:
    """Return the least squares by the normal equations: a few unknowns, thousands of rows, and steps that correct."""
    return np.asarray(np.linalg.lstsq(rows.T @ rows, rows.T @ right, rcond=None)[0], dtype=np.float64)


def _solve_normal(rows: F64, right: F64) -> F64 | None:
    """Return the least squares of `rows` (unknowns, n), each unknown scaled to one; None where they do not suffice."""
    normal = rows @ rows.T
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    try:
        return np.asarray(np.linalg.solve(normal / np.outer(scale, scale), rows @ right / scale) / scale)
    except np.linalg.LinAlgError:
        return None


def _patch(image: F64, H: F64, modules: int) -> tuple[F64, F64]:
    """Return the corner (2,) of the surroundings, and (h, w, 3): grey there, its slope along x, its slope along y."""
    reach = warp(H, CORNERS * (1 + 6 / modules))
    if not np.abs(reach).max() < FARTHEST_PX:  # a horizon runs through it
        return np.zeros(2), np.empty((0, 0, 3))
    low = np.maximum(np.floor(reach.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(reach.max(axis=0)).astype(int) + 3, np.array(image.shape[::-1]))
    if np.any(high - low < 4):
        return np.zeros(2), np.empty((0, 0, 3))
    patch = image[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    slope_y, slope_x = np.gradient(patch)
    return low.astype(np.float64), np.stack([patch, slope_x, slope_y], axis=-1)


def _steer(rows: F64, planes: F64, H: F64, origin: F64, ground: F64) -> F64:
    """Return the grey values (n,) at the places `ground` (3, n); write into `rows` (8, n) how each changes with `H`."""
    mapped = H @ ground
    scale = 1 / mapped[2]
    x, y = mapped[0] * scale, mapped[1] * scale
    grey, slope_x, slope_y = _look_deep(planes, x - origin[0], y - origin[1]).T
    np.multiply(ground, slope_x * scale, out=rows[:3])
    np.multiply(ground, slope_y * scale, out=rows[3:6])
    np.multiply(ground[:2], -(slope_x * x + slope_y * y) * scale, out=rows[6:])
    return np.asarray(grey, dtype=np.float64)


def _look_deep(planes: F64, x: F64, y: F64) -> F64:
    """Return (n, 3): all planes at places, linear between pixels; the border repeats."""
    h, w, depth = planes.shape
    x, y = np.fmin(np.fmax(x, 0.0), w - 1.0), np.fmin(np.fmax(y, 0.0), h - 1.0)  # also where the place is no number
    i, j = np.minimum(x.astype(np.intp), w - 2), np.minimum(y.astype(np.intp), h - 2)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    flat, at = planes.reshape(h * w, depth), j * w + i
    upper, lower = flat[at], flat[at + w]
    upper += (flat[at + 1] - upper) * fx
    lower += (flat[at + w + 1] - lower) * fx
    upper += (lower - upper) * fy
    return np.asarray(upper, dtype=np.float64)


def _judge(H: F64, patch: F64, origin: F64, grid: F64, model: F64, fixed: F64, blur_px: float) -> Fit | None:
    grey = look(patch, warp(H, grid) - origin)
    levels = np.linalg.lstsq(fixed, grey, rcond=None)[0]
    light = fixed[:, [0, 2, 3]] @ levels[[0, 2, 3]]
    score = correlation(grey - (light - levels[0]), model)
    white = float(levels[0] + levels[1])
    if not np.isfinite(score) or white <= 0:
        return None
    return Fit(H / H[2, 2], score, float(levels[1]) / max(white, float(levels[0])), blur_px)


def worst_module(image: F64, bits: F64, found: Fit) -> float:
    """Return how wrong the marker's worst module is: 0 as it should be, 1 as if it were of the other colour.

    What a wrong module would show, averaged over its own square, is what blur leaves of it along both axes.
    """
    modules, per_module = len(bits), 6
    places = (np.arange(modules * per_module) + 0.5) / (modules * per_module) * 2 - 1
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    sigma = math.hypot(found.blur_px, PIXEL_SIGMA_PX) / np.array(module_px(found.H, modules))
    model = render(bits, places, (float(sigma[0]), float(sigma[1]))).ravel()
    fixed = np.column_stack([np.ones(len(grid)), model, grid])
    grey = look(image, warp(found.H, grid))
    levels = _solve(fixed, grey)
    rest = (grey - fixed @ levels).reshape(modules, per_module, modules, per_module).mean(axis=(1, 3)) / abs(levels[1])
    left = [blur_matrix(places, modules, s)[:, modules // 2].reshape(modules, -1).mean(axis=1).max() for s in sigma]
    return float(np.abs(rest).max() / (left[0] * left[1]))


def correlation(a: F64, b: F64) -> float:
    """Return Pearson's correlation of two arrays; NaN where one is flat."""
    a, b = a - a.mean(), b - b.mean()
    size = math.sqrt(float((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / size) if size > 0 else math.nan
