"""What the commands on the library share: options, the sheet they are about, and how a library is told."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import MATERIAL, lab
from fabctl.cli.paths import InFile

if TYPE_CHECKING:
    from design.cells.library import CellLibrary
    from design.cells.sheet import Sheet

material_option = click.option(
    "--material", type=MATERIAL, default="natural-rubber-2.3", show_default=True, help="Material file or its name."
)
file_option = click.option(
    "--library", "file", type=InFile(), help="A library file [the shipped one of the paper's sheet]."
)
t_option = click.option(
    "--t-mm", type=click.FloatRange(-1000, 1000), required=True, help="Where slit 1 starts on its edge."
)
theta_option = click.option("--theta-deg", type=click.FloatRange(-360, 360), required=True, help="Direction of slit 1.")
jobs_option = click.option(
    "--jobs", type=click.IntRange(-1, 1024), default=-1, show_default=True, help="Processes; -1 is one per core."
)
CURVE_WHY = "the smooth curve of cells ends where shallow wells and ragged columns would bend it"


def sheet_named(material: str) -> Sheet:
    """Return the sheet of a material file or name."""
    from fabctl.config.material import load_material, sheet_of

    return sheet_of(load_material(material, lab().root))


def processes_of(jobs: int) -> int:
    """Return how many processes work, each with one thread.

    The matrices of a cell are too small to share: on a busy machine two threads of BLAS cost a column 5.5 s of
    processor time, one costs 3.2 s. Called before NumPy is loaded, which reads these once; workers inherit them.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    return len(os.sched_getaffinity(0)) if jobs == -1 else max(jobs, 1)


def summary(library: CellLibrary) -> dict[str, Any]:
    """Return what a library holds."""
    low, high = library.range_ratio()
    return {
        "cells_count": len(library), "range_ratio": [low, high], "spread_ratio": high / low,
        "curve_range_ratio": _curve_range(library),
        "candidates": library.counts(),
        "reasons": library.reasons(),
        "shallow_count": len(library.shallow_cells()[0]),
        "sheet": asdict(library.sheet),
        "hash": library.hash,
        "command": library.meta["command"],
    }  # fmt: skip


def _curve_range(library: CellLibrary) -> tuple[float, float] | None:
    """Return the range of the smooth curve, or None where none runs through so coarse a library."""
    from design.cells.select import selection_curve
    from design.errors import DesignError

    try:
        return selection_curve(library).range_ratio()
    except DesignError:
        return None


def lines_of(library: CellLibrary) -> Iterator[str]:
    """Yield what a library holds, for a person."""
    from design.cells.homogenise import SHALLOW_WELL_RATIO

    low, high = library.range_ratio()
    sheet = library.sheet
    yield f"{len(library)} bistable cells, expansion {low:.4f} to {high:.4f} (spread {high / low:.3f})"
    if curve := _curve_range(library):
        low, high = curve
        yield f"designs choose from {low:.4f} to {high:.4f} (spread {high / low:.3f}): {CURVE_WHY}"
    if shallow := len(library.shallow_cells()[0]):
        yield (
            f"{shallow} of them were decided at half the mesh size: at the full size their barrier is less than "
            f"{SHALLOW_WELL_RATIO:.1%} of the energy stored"
        )
    yield "candidates: " + ", ".join(f"{count} {verdict}" for verdict, count in library.counts().items() if count)
    yield from (f"  {count:5d} {reason}" for reason, count in library.reasons().items())
    yield (
        f"sheet: edge {sheet.edge_mm:g} mm, slit {sheet.slit_mm:g} mm, hinge {sheet.hinge_mm:g} mm, thickness "
        f"{sheet.thickness_mm:g} mm, E {sheet.E_MPa:g} MPa, ν {sheet.nu_ratio:g}"
    )
    yield f"hash {library.hash[:16]}, made by: {library.meta['command']}"
