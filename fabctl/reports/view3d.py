"""A surface with a signed value at each vertex as a view that turns, inside an HTML page and offline.

A viewer of our own (12 kB) instead of a plotting library (5 MB): it draws the colours unlit, picks by ray, shows the
scale in mm and in percent of the diagonal, and leaves the page small enough to mail.
"""

from __future__ import annotations

import base64
import html
import json
import math
from importlib import resources
from string import Template

import numpy as np
from numpy.typing import NDArray

from design.surface import TriMesh
from fabctl.reports.model import Figure
from fabctl.scan.colours import STOPS, UNSEEN

Floats = NDArray[np.float64]

HINT = "drag to turn, wheel to zoom, shift-drag to move, click a point for its value"
VIEWS = {"oblique": (-0.9, 0.55), "top": (-math.pi / 2, math.pi / 2), "front": (-math.pi / 2, 0.0), "side": (0.0, 0.0)}

BOX = Template("""<div class="v3" id="$ident">
<div class="v3-stage"><canvas tabindex="0" role="img" aria-label="$title"></canvas>
<span class="v3-label"></span><span class="v3-pin" hidden></span>
<div class="v3-none" hidden>This browser has no WebGL; the pictures show the same.</div></div>
<div class="v3-bar"><div class="v3-ramp" style="background:linear-gradient(to top,$ramp)"></div>
<div class="v3-ticks"></div></div>
<div class="v3-tools">$buttons
<label>colour span <input class="v3-span" type="range" min="-1" max="1" step="0.05" value="0"></label>
<label><input class="v3-shade" type="checkbox"> shade</label>
<span><span class="v3-key"></span>not seen</span></div>
<script type="application/json">$facts</script></div>""")


def script() -> str:
    """Return script and style of the viewer; goes once into the head of a page, however many views it has."""
    folder = resources.files("fabctl.reports")
    style, code = (folder.joinpath(f"view3d.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    return f"<style>\n{style}</style>\n<script>\n{code}</script>"


def view(mesh: TriMesh, value_mm: Floats, span_mm: float, name: str, caption: str) -> Figure:
    """Return the view of `mesh` coloured by `value_mm`, `(n,)`, NaN where nothing is known.

    The colours reach from `-span_mm` to `span_mm`; percent are of the mesh's bounding-box diagonal. `name` is unique
    in the page. A click or a touch on the surface says the value there.
    """
    low, high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
    facts = {
        "places": _packed(mesh.vertices_mm.astype("<f4")),
        "faces": _packed(mesh.faces.astype("<u4")),
        "values": _packed(value_mm.astype("<f4")),
        "span_mm": span_mm,
        "diagonal_mm": mesh.diagonal_mm(),
        "centre": [float(x) for x in (low + high) / 2],
        "radius": 0.55 * mesh.diagonal_mm(),
        "azimuth": VIEWS["oblique"][0],
        "elevation": VIEWS["oblique"][1],
        "stops": STOPS.tolist(),
        "unseen": list(UNSEEN),
        "hint": HINT,
    }
    ramp = ",".join(f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in STOPS)
    buttons = " ".join(
        f"<button type='button' data-view='[{a:.4f},{e:.4f}]'>{side}</button>" for side, (a, e) in VIEWS.items()
    )
    box = BOX.substitute(
        ident=html.escape(name, quote=True),
        title=html.escape(caption, quote=True),
        ramp=ramp,
        buttons=buttons,
        facts=json.dumps(facts).replace("</", "<\\/"),
    )
    return Figure(f'<div class="live">{box}</div>', caption, wide=True)


def _packed(numbers: NDArray[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode()
