"""Boards and marks as PDF (to print) and DXF (to engrave): text in, text out, true to size.

The PDF is written by hand because a drawing of black polygons needs a dozen lines, and no library rounds it.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from design.pattern.paths import CutPath
from fabctl.vision.boards import Charuco, MarkSheet, Rectangle, charuco_ink, sheet_ink

POINTS_PER_MM = 72 / 25.4
MARGIN_MM = 12.0
TEXT_MM = 3.0


@dataclass(frozen=True, slots=True)
class Drawing:
    """Black rectangles on a white page, with the distance a person measures after printing."""

    title: str
    size_mm: tuple[float, float]  # of the sheet's own frame
    ink: tuple[Rectangle, ...]


def drawing_of(board: Charuco | MarkSheet) -> Drawing:
    """Return the board or sheet as ink."""
    ink = charuco_ink(board) if isinstance(board, Charuco) else sheet_ink(board)
    kind = (
        f"ChArUco {board.columns_count} x {board.rows_count}, square {board.square_mm:g} mm"
        if isinstance(board, Charuco)
        else f"{len(board.marks)} marks"
    )
    return Drawing(f"{board.name}: {kind}", board.size_mm, tuple(ink))


def pdf(drawing: Drawing) -> bytes:
    """Return a one-page PDF, true to size, with two rulers from 0 to the sheet's width and height."""
    w, h = drawing.size_mm
    page = ((w + 2 * MARGIN_MM) * POINTS_PER_MM, (h + 2 * MARGIN_MM) * POINTS_PER_MM)
    body = "\n".join(_content(drawing)).encode()
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 %.4f %.4f] /Contents 4 0 R "
        b"/Resources << /Font << /F1 5 0 R >> >> >>" % page,
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(body), body),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = io.BytesIO(), []
    out.write(b"%PDF-1.4\n")
    for number, text in enumerate(objects, start=1):
        places.append(out.tell())
        out.write(b"%d 0 obj\n%s\nendobj\n" % (number, text))
    table = out.tell()
    out.write(b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1))
    out.write(b"".join(b"%010d 00000 n \n" % place for place in places))
    out.write(b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table))
    return out.getvalue()


def _content(drawing: Drawing) -> list[str]:
    corner = MARGIN_MM * POINTS_PER_MM
    lines = [
        f"{POINTS_PER_MM:.9f} 0 0 {POINTS_PER_MM:.9f} {corner:.6f} {corner:.6f} cm",
        "0 g",
    ]
    for polygon in _merged(drawing.ink):
        for ring in polygon:
            start, *rest = ring
            lines.append(f"{start[0]:.5f} {start[1]:.5f} m " + " ".join(f"{x:.5f} {y:.5f} l" for x, y in rest) + " h")
        lines.append("f*")
    return lines + _rulers(drawing)


def _rulers(drawing: Drawing) -> list[str]:
    w, h = drawing.size_mm
    d = -MARGIN_MM / 2
    strokes = [(0, d, w, d), (0, d - 1.5, 0, d + 1.5), (w, d - 1.5, w, d + 1.5)]
    strokes += [(d, 0, d, h), (d - 1.5, 0, d + 1.5, 0), (d - 1.5, h, d + 1.5, h)]
    lines = ["0.1 w"] + [f"{a:.4f} {b:.4f} m {c:.4f} {e:.4f} l S" for a, b, c, e in strokes]
    advice = f"Print at 100 %. Measure both rulers ({w:g} mm across, {h:g} mm up), then: fabctl camera board measured"
    text = f"{drawing.title}. {advice}"
    safe = text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    size = min(TEXT_MM, w / (0.5 * len(text)))
    return [*lines, f"BT /F1 {size:.3f} Tf 0 {h + MARGIN_MM / 3:.3f} Td ({safe}) Tj ET"]


def _merged(ink: Sequence[Rectangle]) -> list[list[np.ndarray]]:
    """Return the union of the rectangles as polygons, each a list of rings: no seams between neighbours."""
    from shapely import Polygon, set_precision, unary_union

    joined = unary_union([set_precision(Polygon(rectangle), 1e-6) for rectangle in ink])
    parts = [part for part in getattr(joined, "geoms", [joined]) if part.area > 0]
    return [[np.asarray(ring.coords)[:-1] for ring in (part.exterior, *part.interiors)] for part in parts]


def dxf(drawing: Drawing, strokes: Sequence[CutPath] = ()) -> str:
    """Return a DXF (R2010, mm): black as closed outlines on layer `engrave-fill`, `strokes` on their own layers."""
    import ezdxf

    document = ezdxf.new("R2010", units=4)
    for name in sorted({"engrave-fill", *(path.layer for path in strokes)}):
        document.layers.add(name)
    space = document.modelspace()
    for polygon in _merged(drawing.ink):
        for ring in polygon:
            space.add_lwpolyline([tuple(p) for p in ring], close=True, dxfattribs={"layer": "engrave-fill"})
    for path in strokes:
        space.add_lwpolyline([tuple(p) for p in path.points_mm], close=path.closed, dxfattribs={"layer": path.layer})
    text = io.StringIO()
    document.write(text)
    return text.getvalue()
