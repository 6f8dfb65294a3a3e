"""Sweep the shipped hinge widths anew: `python scripts/build_hinges.py [FOLDER FOR PARTS]`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from design.cells.hinges import SHIPPED_HINGES, save_hinges
from design.cells.sheet import Sheet
from design.cells.sweep import plan_of, sweep

WIDTHS_MM = (0.2, 0.3, 0.4, 0.5)
STEP_MM = 0.02


def main() -> None:
    """Sweep and write; finished columns are kept, as by `fabctl library build`."""
    parts = Path(sys.argv[1] if len(sys.argv) > 1 else "library-cache")
    parts.mkdir(exist_ok=True)
    swept = {w: sweep(plan_of(Sheet(hinge_mm=w), t_step_mm=STEP_MM), parts) for w in WIDTHS_MM}
    save_hinges(SHIPPED_HINGES, Sheet(), swept)
    for width, cells in swept.items():
        print(f"{width:g} mm: {sum(cell.verdict == 'bistable' for cell in cells)} of {len(cells)} bistable")


if __name__ == "__main__":
    main()
