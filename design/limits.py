"""What a design may ask of the machine it is made on."""

from __future__ import annotations

from design.errors import DesignError
from design.findings import Finding
from design.flatten import Flattening

CELLS_LIMIT_COUNT = 500_000  # extrapolated from 20,000 cells, some 10 GB


def check_count(flat: Flattening, cell_mm: float, found: list[Finding]) -> None:
    """Raise `DesignError` where a flat would take more cells than can be designed: mostly a mistake in units."""
    count = float(flat.mesh.face_areas_mm2().sum() / flat.expansion_ratio.mean() ** 2) / (cell_mm**2 * 0.75**0.5 / 2)
    if count > CELLS_LIMIT_COUNT:
        text = f"about {count:,.0f} cells of {cell_mm:g} mm would be needed, {CELLS_LIMIT_COUNT:,} is the limit"
        raise DesignError(f"{text}; take larger cells, or check the target's units (they are mm)", found)
