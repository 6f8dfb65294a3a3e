"""Strokes to SVG in millimetres: hairlines, a colour for each layer, as laser programs expect."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import escape, quoteattr

from design.pattern.paths import LAYERS, CutPath, Layer

COLOURS: dict[Layer, str] = {
    "engrave": "#0000ff",
    "mark": "#00a000",
    "hole": "#ff00ff",
    "slit": "#ff0000",
    "outline": "#000000",
}
HAIRLINE_MM = 0.01
DECIMALS = 4


def svg(paths: Sequence[CutPath], size_mm: tuple[float, float], title: str = "") -> str:
    """Return an SVG document of the sheet, one group a layer; y points up on the sheet, down in the file."""
    width, height = size_mm
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.{DECIMALS}f}mm" height="{height:.{DECIMALS}f}mm" '
        f'viewBox="0 0 {width:.{DECIMALS}f} {height:.{DECIMALS}f}">',
        f"<title>{escape(title)}</title>",
    ]
    for layer in LAYERS:
        mine = [path for path in paths if path.layer == layer]
        if not mine:
            continue
        lines.append(
            f'<g id={quoteattr(layer)} fill="none" stroke="{COLOURS[layer]}" stroke-width="{HAIRLINE_MM}" '
            'stroke-linecap="round" stroke-linejoin="round">'
        )
        lines += [_element(path, height) for path in mine]
        lines.append("</g>")
    lines.append("</svg>")
    return "\n".join(lines) + "\n"


def _element(path: CutPath, height_mm: float) -> str:
    name = "polygon" if path.closed else "polyline"
    points = " ".join(f"{x:.{DECIMALS}f},{height_mm - y:.{DECIMALS}f}" for x, y in path.points_mm.tolist())
    return f'<{name} points="{points}"/>'
