"""Strokes to DXF R2010 in millimetres: one layer for each way of cutting, polylines only."""

from __future__ import annotations

import io
from collections.abc import Sequence

from design.errors import DesignError
from design.pattern.paths import LAYERS, CutPath, Layer

VERSION = "R2010"
COLOURS: dict[Layer, int] = {"engrave": 5, "mark": 3, "hole": 6, "slit": 1, "outline": 7}  # AutoCAD colour index
HAIRLINE = 0  # hundredths of a millimetre
UNITS_MM = 4  # $INSUNITS


def dxf(paths: Sequence[CutPath], size_mm: tuple[float, float]) -> str:
    """Return the sheet as DXF text that ezdxf's auditor finds nothing in; raise `DesignError` if it does.

    The text carries no date and no random id: the same sheet has the same hash.
    """
    import ezdxf

    dated = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        return _text(paths, size_mm)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = dated


def _text(paths: Sequence[CutPath], size_mm: tuple[float, float]) -> str:
    import ezdxf
    from ezdxf import units

    document = ezdxf.new(VERSION, units=units.MM)
    document.header["$INSUNITS"] = UNITS_MM
    document.header["$MEASUREMENT"] = 1
    document.header["$EXTMIN"], document.header["$EXTMAX"] = (0.0, 0.0, 0.0), (*size_mm, 0.0)
    document.header["$LIMMIN"], document.header["$LIMMAX"] = (0.0, 0.0), size_mm
    for layer in LAYERS:
        document.layers.add(layer.upper(), color=COLOURS[layer], lineweight=HAIRLINE)
    space = document.modelspace()
    for path in paths:
        space.add_lwpolyline(path.points_mm.tolist(), close=path.closed, dxfattribs={"layer": path.layer.upper()})
    auditor = document.audit()
    if auditor.has_errors or auditor.has_fixes:
        faults = [str(fault.message) for fault in (*auditor.errors, *auditor.fixes)]
        raise DesignError(f"the DXF does not pass its audit: {'; '.join(faults[:5])}")
    text = io.StringIO()
    document.write(text)
    return text.getvalue()
