"""The deviation on a specimen's page: numbers, a map that turns, a picture, a histogram."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from design.surface import TriMesh
from fabctl.records.folder import RunFolder, status_of
from fabctl.reports.indent_step import as_svg
from fabctl.reports.model import Fact, Figure, Step
from fabctl.reports.view3d import COLOURS, view


def scan_step(run: RunFolder) -> Step:
    """Return the part about one scan."""
    result = run.result() or {}
    notes = tuple(f"{f['level']}: {f['message']}" for f in result.get("findings", []))
    outcome = run.outcome() or {}
    summary = str(outcome.get("message") or "The scan has no result.")
    return Step("Scan against target", status_of(run), summary, tuple(_facts(result)), _figures(run, result), notes)


def _facts(result: Mapping[str, Any]) -> list[Fact]:
    found = []
    deviation = result.get("deviation")
    if deviation:
        for key, label in (
            ("rms_mm", "RMS deviation"),
            ("mean_mm", "mean, signed"),
            ("mean_abs_mm", "mean, absolute"),
            ("p95_abs_mm", "95 % of the area within"),
            ("max_mm", "largest"),
        ):
            if deviation.get(key) is not None:
                share = deviation.get(key.removesuffix("_mm") + "_frac")
                found.append(Fact(label, f"{deviation[key]:.3f} mm", f"{share:.3%} of the diagonal" if share else ""))
        found.append(Fact("coverage of the target", f"{deviation['coverage_frac']:.1%}"))
        out = f"{deviation['border_count']} past the border, {deviation['lone_count']} wrong matches"
        found.append(Fact("points compared", f"{deviation['points_count']}", f"left out: {out}"))
    target = result.get("target", {})
    if target:
        own = ", ".join(map(str, target["symmetries"])) or "none"
        found.append(Fact("target's diagonal", f"{target['diagonal_mm']:.2f} mm", f"its own symmetries: {own}"))
    pose = result.get("pose")
    if pose:
        found.append(Fact("scale", f"{pose['unit_mm']:.6g} mm a unit"))
        found.append(Fact("pose decided by", str(result.get("decided_by"))))
        found.append(Fact("other poses within 10 %", str(len(result.get("alternatives", [])))))
    model = result.get("against_predicted")
    if model:
        found.append(
            Fact("against the prediction, RMS", f"{model['rms_mm']:.3f} mm", f"it knew {model['known_frac']:.0%}")
        )
    cloud = result.get("cloud", {})
    if cloud:
        gone = f"table {cloud['table_count']}, strays {cloud['stray_count']}, background {cloud['background_count']}"
        found.append(Fact("points in the cloud", str(cloud["points_count"]), f"taken off: {gone}"))
    return found


def _figures(run: RunFolder, result: Mapping[str, Any]) -> tuple[Figure, ...]:
    path = run.path / "artefacts" / "map.npz"
    if not path.is_file():
        return ()
    with np.load(path) as found:
        mesh = TriMesh(found["vertices_mm"], found["faces"].astype(np.int64))
        value_mm = found["deviation_mm"]
    span = float(result.get("colour_span_mm") or np.nanmax(np.abs(value_mm)))
    caption = "Signed deviation from the target, red outside. Drag to turn, wheel to zoom, click for a value."
    return (
        view(mesh, value_mm, span, "deviation", caption),
        Figure(_still(mesh, value_mm, span), "The same from above and from the side, for print."),
        Figure(_histogram(value_mm, span), "How often each deviation occurs on the target's vertices."),
    )


def _still(mesh: TriMesh, value_mm: np.ndarray[Any, Any], span_mm: float) -> str:
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure as Canvas

    colours = LinearSegmentedColormap.from_list("deviation", list(COLOURS))
    seen = np.array([np.isfinite(value_mm[face]).all() for face in mesh.faces], dtype=bool)
    canvas = Canvas(figsize=(4.4, 5.0), layout="constrained")
    extent = np.ptp(mesh.vertices_mm, axis=0)
    heights = [max(extent[1], 1e-9), max(extent[2], 0.25 * extent[1])]
    above, beside = canvas.subplots(2, 1, height_ratios=heights)
    for axes, (a, b), label in ((above, (0, 1), "from above"), (beside, (0, 2), "from the side")):
        flat = mesh.vertices_mm[:, [a, b]]
        if (~seen).any():
            axes.tripcolor(*flat.T, np.zeros(len(flat)), triangles=mesh.faces[~seen], cmap="Greys", vmin=-1, vmax=3)
        drawn = axes.tripcolor(
            *flat.T,
            np.nan_to_num(value_mm),
            triangles=mesh.faces[seen],
            cmap=colours,
            vmin=-span_mm,
            vmax=span_mm,
            shading="gouraud",
            rasterized=True,
        )
        axes.set_aspect("equal")
        axes.set_title(label, fontsize=9, loc="left")
        axes.set_xlabel(f"{'xyz'[a]} [mm]", fontsize=8)
        axes.set_ylabel(f"{'xyz'[b]} [mm]", fontsize=8)
        axes.tick_params(labelsize=7)
    canvas.colorbar(drawn, ax=[above, beside], label="deviation [mm]", shrink=0.7)
    return as_svg(canvas, dpi=150)


def _histogram(value_mm: np.ndarray[Any, Any], span_mm: float) -> str:
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(4.4, 3.0), layout="constrained")
    axes = canvas.add_subplot()
    known = value_mm[np.isfinite(value_mm)]
    axes.hist(known, bins=np.linspace(-span_mm, span_mm, 61).tolist(), color="#5b6875")
    axes.axvline(0, color="#16202a", lw=0.8)
    axes.axvline(float(known.mean()), color="#b2182b", lw=1.0, ls="--", label=f"mean {known.mean():+.3f} mm")
    axes.set_xlabel("deviation [mm]")
    axes.set_ylabel("vertices")
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    return as_svg(canvas)
