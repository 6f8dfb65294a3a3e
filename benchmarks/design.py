"""Pattern, selection and whole designs: `python -m benchmarks design`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from benchmarks import Figure
from benchmarks._published import SHEET_OFFSET_MM, PublishedMap, flat, half_map, table
from design.cells.library import CellLibrary, load_library
from design.cells.select import SelectionOptions, on_curve, select, selection_curve
from design.pattern.assign import averaged
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.slits import slits_of
from design.pattern.tiling import tile
from design.pattern.tubes import period_mm, seam_gap_mm
from design.pipeline import build
from design.spec import DesignSpec
from design.targets import vase

ROOT = Path(__file__).resolve().parents[1]
STEP_RATIO = 0.002
SAME_ENTRY = 1e-5  # mm and rad: the digits in which maps are printed; steps are a thousand times that
CELLS_COUNT = 20_000
MANY_CELLS = """
import json, resource, time
from design.cells.library import load_library
from design.cells.sheet import Sheet
from design.export.dxf import dxf
from design.export.svg import svg
from design.pattern.paths import LAYERS, LayerPreset
from design.pipeline import build
from design.spec import DesignSpec
from design.targets import cap

edge = 0.98
sheet = Sheet(edge_mm=edge, slit_mm=0.0125 * edge, hinge_mm=0.025 * edge)
library = load_library().scaled(sheet)
presets = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
spec = DesignSpec("many", cell_mm=edge, response=None)
build(DesignSpec("few", cell_mm=8 * edge, response=None), cap(edge_mm=8), load_library().scaled(
    Sheet(edge_mm=8 * edge, slit_mm=0.1 * edge, hinge_mm=0.2 * edge)), presets)  # compiles the kernels
began = time.process_time()
made = build(spec, cap(edge_mm=2), library, presets)
built = time.process_time()
texts = [dxf(made.drawing.paths, made.drawing.size_mm), svg(made.drawing.paths, made.drawing.size_mm)]
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
print(json.dumps([len(made.cells.wanted_ratio), built - began, time.process_time() - began, peak]))
"""


def selection_figures(name: str, library: PublishedMap | CellLibrary) -> list[Figure]:
    """Return bias, greatest jump and lost stiffness of the smooth curve; the bias of other rules for comparison."""
    curve = selection_curve(library)
    low, high = curve.range_ratio()
    wanted = np.random.default_rng(0).uniform(low, high, 20_000)
    figures = []
    for rule, target in (("smooth", "<= 0.0005"), ("stiffest", "<= 0.0005"), ("published", "")):
        chosen = select(library, wanted, SelectionOptions(rule))  # type: ignore[arg-type]
        if isinstance(library, CellLibrary):
            true = library.at(chosen.t_mm, chosen.theta_rad).expansion_ratio
        else:
            places = np.column_stack([library.t_mm, 10 * library.theta_rad])
            true = LinearNDInterpolator(places, library.expansion_ratio)(chosen.t_mm, 10 * chosen.theta_rad)
        bias = float(np.nanmean(true - wanted))
        met = abs(bias) <= 5e-4 if target else None
        figures.append(Figure(f"{name}: bias of the {rule} rule", float(f"{bias:.2g}"), "", target, met, len(wanted)))
    steps = on_curve(curve, np.arange(low, high, STEP_RATIO))
    jump = float(np.abs(np.diff(steps.t_mm)).max())
    lost = float((1 - curve.stiffness_mJ / curve.best_stiffness_mJ).max())
    span = f"{low:.4f} to {high:.4f}"
    return [
        *figures,
        Figure(
            f"{name}: greatest jump of t per 0.002", round(jump, 4), "mm", "<= 0.02 mm", jump <= 0.02, len(steps.t_mm)
        ),
        Figure(
            f"{name}: greatest loss of stiffness", round(lost, 4), "", "<= 0.05", lost <= 0.05 + 1e-9, len(curve.t_mm)
        ),
        Figure(f"{name}: range of the smooth curve", span, "", "", None, len(curve.t_mm)),
    ]


def published_figures(shared: Path, whole_map: Path | None = None) -> list[Figure]:
    """Return how the double dome's pattern comes out by the published rules."""
    points, faces, ratio = flat(shared, "double_dome")
    cells = table(shared / "published" / "double_dome_pattern_cells.csv")
    library = load_library(whole_map or shared / "published" / "cell_library_half.csv")
    tiling = tile(points, faces, 10.0)
    places = cKDTree(np.column_stack([cells["cx_mm"], cells["cy_mm"]]))
    row = places.query(tiling.centres_mm() + SHEET_OFFSET_MM)[1]
    mine = cells[row]
    wanted = averaged(tiling, points, faces, ratio, "published")
    wanted *= 1.75 / wanted.max()
    chosen = select(library, wanted, SelectionOptions("published"))
    theirs = np.column_stack([10 * mine["t_over_l0_lib"], mine["theta_rad_lib"]])
    entries = cKDTree(np.column_stack([library.t_mm, library.theta_rad]))
    in_half = entries.query(theirs)[0] < SAME_ENTRY
    same = np.abs(np.column_stack([chosen.t_mm, chosen.theta_rad]) - theirs).max(axis=1) < SAME_ENTRY
    hits = int((same & in_half).sum())
    off = float(np.abs(chosen.expansion_ratio - wanted)[~in_half].max(initial=0.0))
    every = int(same.sum())
    apart = np.abs(mine["lambda_lib"] - wanted)
    slits = slits_of(tiling, mine["t_mm"], np.radians(mine["theta_deg"]), mine["hinge_width_mm"], 0.125)
    rows = table(shared / "published" / "double_dome_pattern_slits.csv").reshape(-1, 3)[row]
    inner = np.stack([rows["inner_x"], rows["inner_y"]], axis=-1) - SHEET_OFFSET_MM
    which = np.linalg.norm(slits.inner_mm[:, :, None] - inner[:, None], axis=-1).argmin(axis=2)
    rows = np.take_along_axis(rows, which, axis=1)
    gaps = []
    for name, found in (("edge", slits.edge_mm), ("kink", slits.kink_mm), ("inner", slits.inner_mm)):
        at = np.stack([rows[f"{name}_x"], rows[f"{name}_y"]], axis=-1) - SHEET_OFFSET_MM
        gaps.append(np.linalg.norm(found - at, axis=-1).ravel())
    gap = np.concatenate(gaps)
    median = float(np.nanmedian(gap))
    count = len(wanted)
    if whole_map is not None:
        return [Figure("double_dome: cells that come out the same", every, "", ">= 327 of 332", every >= 327, count)]
    return [
        Figure("double_dome: cells in the half map that come out the same", hits, "", "157 of 157", hits == 157, 157),
        Figure("double_dome: others, chosen from wanted", round(off, 5), "", "within 0.005", off <= 0.005, count - 157),
        Figure("double_dome: wanted within 0.0051 of published", int((apart <= 0.0051).sum()), "", "", None, count),
        Figure("double_dome: slit points, median", round(median, 6), "mm", "<= 0.001 mm", median <= 1e-3, len(gap)),
        Figure("double_dome: slit points, worst", round(float(np.nanmax(gap)), 6), "mm", "", None, len(gap)),
    ]


def vase_figures() -> list[Figure]:
    """Return how well the two sides of a whole vase's sheet meet."""
    presets = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
    made = build(DesignSpec("vase", response=None), vase(), load_library(), presets)
    period = period_mm(made.flattening)
    assert period is not None
    gap, count = seam_gap_mm(made.cells.tiling, period), len(made.cells.kind)
    return [Figure("whole vase: seam gap after the translation", gap, "mm", "<= 0.01 mm", gap <= 0.01, count)]


def many_cells_figures() -> list[Figure]:
    """Return time and memory of a design of 20,000 cells in a process of its own, the kernels compiled before."""
    done = subprocess.run([sys.executable, "-c", MANY_CELLS], capture_output=True, text=True, cwd=ROOT, check=True)
    count, build_s, whole_s, peak_GB = json.loads(done.stdout)
    return [
        Figure("cells of the large design", count, "", ">= 20000", count >= CELLS_COUNT, 1),
        Figure("the large design, without export", round(build_s, 1), "s CPU", "", None, count),
        Figure("the large design with DXF, SVG, G-code", round(whole_s, 1), "s CPU", "<= 20 s", whole_s <= 20, count),
        Figure("the large design, peak memory", round(peak_GB, 2), "GB", "<= 2 GB", peak_GB <= 2, count),
    ]


def measure(words: list[str]) -> list[Figure]:
    """Return all figures, or with `--map FILE` that of the published rule with a whole map.

    Those against the published data only where `FABCTL_SHARED` or ../shared has them.
    """
    shared = Path(os.environ.get("FABCTL_SHARED", ROOT.parent / "shared"))
    if words[:1] == ["--map"]:
        return published_figures(shared, Path(words[1]))
    figures = selection_figures("own map", load_library())
    if shared.is_dir():
        figures += selection_figures("published half map", half_map(shared)) + published_figures(shared)
    return figures + vase_figures() + many_cells_figures()
