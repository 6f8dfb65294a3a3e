"""Compute the shipped maps of bending stiffness anew: `python scripts/build_bending.py [--open]` (a few minutes)."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from design.cells.bending_map import SHIPPED, SHIPPED_OPEN, compute_map, save_map
from design.cells.contracting import load_contracting
from design.cells.library import load_library


def main() -> None:
    """Compute and write."""
    is_open = "--open" in sys.argv[1:]
    library = load_contracting() if is_open else load_library()
    table, failures = compute_map(library, watch=lambda done, name: print(f"{done:6.1%}  {name}", flush=True))
    save_map(SHIPPED_OPEN if is_open else SHIPPED, library, table, failures)
    print(f"{len(table['t_mm'])} cells, {len(failures)} without an answer")
    for line in failures:
        print(line)


if __name__ == "__main__":
    main()
