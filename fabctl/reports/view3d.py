"""A surface that turns in the page, coloured by a signed deviation. Offline: plotly.js goes into the page once.

Colours are drawn unlit, so that one colour means one value wherever the surface points.
"""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.surface import TriMesh
from fabctl.reports.model import Figure

TICKS_COUNT = 7
# Blue below, grey on target, red above: readable with red–green blindness and in print.
COLOURS = ((0.0, "#2166ac"), (0.25, "#92c5de"), (0.5, "#f2f2f2"), (0.75, "#f4a582"), (1.0, "#b2182b"))


def script() -> str:
    """Return the drawing library as a `<script>` for the page's head."""
    from plotly.offline import get_plotlyjs

    return f"<script>{get_plotlyjs()}</script>"


def view(mesh: TriMesh, value_mm: NDArray[np.float64], span_mm: float, name: str, caption: str) -> Figure:
    """Return `mesh` with one value a vertex `(n,)`; NaN is drawn grey. `name` is unique in the page.

    A click or a touch on the surface says the value there in mm and as a share of the bounding box's diagonal.
    """
    seen = np.isfinite(value_mm)
    known = np.array([seen[face].all() for face in mesh.faces], dtype=bool)
    diagonal_mm = mesh.diagonal_mm()
    ticks = np.linspace(-span_mm, span_mm, TICKS_COUNT)
    traces = [_unknown(mesh, mesh.faces[~known])] if (~known).any() else []
    traces.append(
        {
            **_corners(mesh, mesh.faces[known]),
            "intensity": _packed(np.nan_to_num(value_mm)),
            "cmin": -span_mm,
            "cmax": span_mm,
            "colorscale": [list(pair) for pair in COLOURS],
            "customdata": _packed(100 * np.nan_to_num(value_mm) / diagonal_mm),
            "hovertemplate": "%{intensity:+.3f} mm<br>%{customdata:+.3f} % of the diagonal<extra></extra>",
            "colorbar": {
                "title": {"text": "mm (% of diagonal)", "side": "right"},
                "tickvals": [float(t) for t in ticks],
                "ticktext": [f"{t:+.2f} ({100 * t / diagonal_mm:+.2f} %)" for t in ticks],
                "thickness": 14,
                "len": 0.85,
            },
        }
    )
    layout = {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 430,
        "paper_bgcolor": "#ffffff",
        "scene": {
            "aspectmode": "data",
            "xaxis": {"title": {"text": "x [mm]"}},
            "yaxis": {"title": {"text": "y [mm]"}},
            "zaxis": {"title": {"text": "z [mm]"}},
            "camera": {"eye": {"x": 0.9, "y": -1.25, "z": 0.95}},
        },
    }
    data = json.dumps([traces, layout], separators=(",", ":")).replace("</", "<\\/")
    markup = (
        f'<div class="live" id="{name}"></div><div class="pick" id="{name}-pick">click the surface for its value</div>'
        f"<script>(function(){{const [traces, layout] = {data};"
        f'Plotly.newPlot("{name}", traces, layout, {{responsive: true, displaylogo: false}}).then(function(plot){{'
        f'plot.on("plotly_click", function(event){{const p = event.points[0];'
        f'document.getElementById("{name}-pick").textContent = p.customdata === undefined ? "not seen by the scan" :'
        f'"(" + [p.x, p.y, p.z].map(v => v.toFixed(1)).join(", ") + ") mm: " + Number(p.intensity).toFixed(3) + " mm, "'
        f' + Number(p.customdata).toFixed(3) + " % of the diagonal";}});'
        f'plot.setAttribute("data-drawn", "yes");}});}})();</script>'
    )
    return Figure(markup, caption, wide=True)


def _corners(mesh: TriMesh, faces: NDArray[np.int64]) -> dict[str, Any]:
    x, y, z = mesh.vertices_mm.T
    i, j, k = faces.T.astype(np.int32)
    return {
        "type": "mesh3d",
        "x": _packed(x),
        "y": _packed(y),
        "z": _packed(z),
        "i": _packed(i),
        "j": _packed(j),
        "k": _packed(k),
        "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0, "roughness": 1.0},
        "flatshading": False,
    }


def _unknown(mesh: TriMesh, faces: NDArray[np.int64]) -> dict[str, Any]:
    return {**_corners(mesh, faces), "color": "#b9c0c7", "opacity": 0.6, "hovertemplate": "not seen<extra></extra>"}


def _packed(values: NDArray[Any]) -> dict[str, str]:
    kind = "i4" if values.dtype.kind == "i" else "f4"
    return {"dtype": kind, "bdata": base64.b64encode(values.astype(f"<{kind}").tobytes()).decode()}
