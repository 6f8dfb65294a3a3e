"""Fixed pictures of a comparison: the map from three sides, the histogram, and what was cleaned away."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from design.surface import TriMesh
from fabctl.scan.clean import Cleaned
from fabctl.scan.colours import STOPS, colours_of
from fabctl.scan.deviation import Deviation
from fabctl.scan.foreign import open3d

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# name -> azimuth and elevation of the eye, rad
SIDES = {
    "oblique": (-0.9, 0.55),
    "top": (-math.pi / 2, math.pi / 2),
    "front": (-math.pi / 2, 0.0),
    "side": (0.0, 0.0),
}
WIDE_PX, HIGH_PX = 640, 460
CLASSES = {
    "specimen": (46, 125, 80),
    "table": (176, 137, 96),
    "background": (120, 126, 140),
    "stray": (214, 60, 60),
}
BINS = 61


def frame(azimuth_rad: float, elevation_rad: float) -> Floats:
    """Return the rows right, up and towards the eye of a parallel view."""
    ca, sa, ce, se = math.cos(azimuth_rad), math.sin(azimuth_rad), math.cos(elevation_rad), math.sin(elevation_rad)
    eye, right = np.array([ca * ce, sa * ce, se]), np.array([-sa, ca, 0.0])
    return np.stack([right, np.cross(eye, right), eye])


def map_picture(mesh: TriMesh, value_mm: Floats, span_mm: float, side: str) -> Image.Image:
    """Return the surface coloured by the vertices' values, unlit, seen from `side`; cast ray by ray."""
    o3d = open3d()
    axes, size = frame(*SIDES[side]), mesh.diagonal_mm()
    centre = (mesh.vertices_mm.min(axis=0) + mesh.vertices_mm.max(axis=0)) / 2
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(mesh.vertices_mm - centre, dtype=np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)),
    )
    flat = (mesh.vertices_mm - centre) @ axes[:2].T
    step = max(np.ptp(flat[:, 0]) / (0.92 * WIDE_PX), np.ptp(flat[:, 1]) / (0.92 * HIGH_PX))
    middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
    u, v = np.meshgrid(
        middle[0] + (np.arange(WIDE_PX) - WIDE_PX / 2) * step, middle[1] - (np.arange(HIGH_PX) - HIGH_PX / 2) * step
    )
    start = u[..., None] * axes[0] + v[..., None] * axes[1] + size * axes[2]
    rays = np.concatenate([start, np.broadcast_to(-axes[2], start.shape)], axis=-1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor(rays))
    face, uv = hit["primitive_ids"].numpy(), hit["primitive_uvs"].numpy()
    met = np.isfinite(hit["t_hit"].numpy())
    weights = np.stack([1 - uv[met].sum(axis=1), uv[met][:, 0], uv[met][:, 1]], axis=1)
    value = np.einsum("nk,nk->n", weights, value_mm[mesh.faces[face[met]]])
    picture = np.full((HIGH_PX, WIDE_PX, 3), 255, dtype=np.uint8)
    picture[met] = colours_of(value, span_mm)
    return Image.fromarray(picture)


def cleaning_picture(points: Floats, kind: NDArray[np.int64], up: Floats | None) -> Image.Image:
    """Return all points, each in the colour of what it was taken for, from above and from the side.

    `kind` counts through `CLASSES`; `up` is the table's normal where there is one.
    """
    axes = np.eye(3) if up is None else _axes_with_up(up)
    some = np.random.default_rng(0).permutation(len(points))[:250_000]
    placed, colour = points[some] @ axes.T, np.array(list(CLASSES.values()))[kind[some]]
    body = placed[kind[some] == 0] if (kind[some] == 0).any() else placed
    middle = np.median(body, axis=0)
    reach = 1.3 * float(np.linalg.norm(np.ptp(body, axis=0)))
    views = [_dots(placed - middle, colour, reach, (0, 1, 2)), _dots(placed - middle, colour, reach, (0, 2, 1))]
    return Image.fromarray(np.concatenate(views, axis=1))


def _axes_with_up(up: Floats) -> Floats:
    right = np.cross([0.3, 1.0, 0.2], up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _dots(placed: Floats, colour: NDArray[np.int64], reach: float, order: tuple[int, int, int]) -> Bytes:
    """Return a square picture of dots along axes `order` (right, up, towards the eye), the nearest on top."""
    px = 460
    x = ((placed[:, order[0]] / reach + 0.5) * px).astype(int)
    y = ((0.5 - placed[:, order[1]] / reach) * px).astype(int)
    shown = (x >= 0) & (x < px) & (y >= 0) & (y < px)
    near = np.argsort((1 if order[2] == 2 else -1) * placed[shown, order[2]], kind="stable")
    picture = np.full((px, px, 3), 255, dtype=np.uint8)
    picture[y[shown][near], x[shown][near]] = colour[shown][near].astype(np.uint8)
    return picture


def kinds(cleaned: Cleaned, specimen: Mask) -> NDArray[np.int64]:
    """Return for each point which of `CLASSES` it was taken for."""
    of = cleaned.cells.of_point
    found = np.full(len(of), 2)
    inside = np.flatnonzero(of >= 0)
    found[inside[cleaned.sparse[of[inside]]]] = 3
    found[cleaned.is_table] = 1
    found[specimen] = 0
    return found


def histogram_svg(found: Deviation, span_mm: float, diagonal_mm: float, tolerance_frac: float | None) -> str:
    """Return the share of the compared area by deviation, in the map's colours, with the tolerance marked."""
    edges = np.linspace(-1.5 * span_mm, 1.5 * span_mm, BINS + 1)
    value = np.clip(found.value_mm[found.counts], edges[0], edges[-1])
    share, _ = np.histogram(value, edges, weights=found.area_weight[found.counts])
    wide, high, left, base = 560.0, 230.0, 46.0, 186.0
    top = max(float(share.max()), 1e-9)
    colours = colours_of((edges[1:] + edges[:-1]) / 2, span_mm)

    def across(mm: float) -> float:
        return left + (mm - float(edges[0])) / float(edges[-1] - edges[0]) * (wide - left - 10)

    width = across(float(edges[1])) - across(float(edges[0]))
    bars = [
        f'<rect x="{across(float(a)):.1f}" y="{base - 160 * s / top:.1f}" width="{width:.2f}" '
        f'height="{160 * s / top:.1f}" fill="rgb({red},{green},{blue})" stroke="#8a8f98" stroke-width="0.4"/>'
        for a, s, (red, green, blue) in zip(edges[:-1], share, colours, strict=True)
        if s > 0
    ]
    ticks = []
    for mm in np.linspace(-span_mm, span_mm, 5):
        x, percent = across(float(mm)), 100 * mm / diagonal_mm
        ticks.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{base}" y2="{base + 5}" stroke="#444"/>'
            f'<text x="{x:.1f}" y="{base + 18}" text-anchor="middle">{mm:+.3g} mm</text>'
            f'<text x="{x:.1f}" y="{base + 32}" text-anchor="middle" fill="#666d76">{percent:+.2g} %</text>'
        )
    limits = [
        f'<line x1="{across(s):.1f}" x2="{across(s):.1f}" y1="14" y2="{base}" stroke="#111" stroke-dasharray="4 3"/>'
        for s in ([] if tolerance_frac is None else [-tolerance_frac * diagonal_mm, tolerance_frac * diagonal_mm])
        if edges[0] < s < edges[-1]
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:.0f} {high:.0f}" width="{wide:.0f}" '
        f'font-family="system-ui, sans-serif" font-size="11" role="img" aria-label="histogram of deviations">'
        f'<text x="{left}" y="10">share of area, highest bar {top:.1%}</text>'
        f'<line x1="{left}" x2="{wide - 10:.0f}" y1="{base}" y2="{base}" stroke="#444"/>'
        f"{''.join(bars)}{''.join(ticks)}{''.join(limits)}</svg>"
    )


def write_bar(path: Path, span_mm: float, diagonal_mm: float) -> None:
    """Write the colour scale as SVG, in mm and in percent of the diagonal."""
    stops = "".join(
        f'<stop offset="{k / (len(STOPS) - 1):.3f}" stop-color="rgb({r:.0f},{g:.0f},{b:.0f})"/>'
        for k, (r, g, b) in enumerate(STOPS)
    )
    ticks = "".join(
        f'<text x="{40 + 480 * (t + 1) / 2:.0f}" y="32" text-anchor="middle">{t * span_mm:+.3g} mm</text>'
        f'<text x="{40 + 480 * (t + 1) / 2:.0f}" y="46" text-anchor="middle" fill="#666d76">'
        f"{100 * t * span_mm / diagonal_mm:+.2g} %</text>"
        for t in (-1.0, -0.5, 0.0, 0.5, 1.0)
    )
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 560 52" width="560" font-size="11" '
        f'font-family="system-ui, sans-serif"><defs><linearGradient id="g">{stops}</linearGradient></defs>'
        f'<rect x="40" y="4" width="480" height="14" fill="url(#g)" stroke="#888"/>{ticks}</svg>',
        encoding="utf-8",
    )
