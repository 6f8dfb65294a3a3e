"""Before anything is built: can a sheet become this surface, where not, what would help, and what would it cost."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from design.cells.library import CellLibrary
from design.cells.select import selection_curve
from design.errors import DesignError
from design.findings import Finding
from design.flatten import FeasibilityReport, Flattening, Limits, feasibility
from design.flatten.ladder import Remedy
from design.pattern.paths import Layer, LayerPreset
from design.pipeline import Design, build, cells_on_offer
from design.preview import few_ticks
from design.spec import DesignSpec
from design.surface import TriMesh, boundary_loops
from design.watch import Watch, unwatched


@dataclass(frozen=True, slots=True)
class Check:
    """What can be said of a target: its topology, the ladder climbed, and the sheet it would take if it fits."""

    topology: str
    report: FeasibilityReport
    design: Design | None
    findings: tuple[Finding, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the check as plain JSON."""
        found: dict[str, Any] = {"topology": self.topology, **self.report.as_dict()}
        if self.design is not None:
            job, drawing = self.design.job, self.design.drawing
            found |= {
                "cells_count": len(self.design.cells.wanted_ratio),
                "sheet_mm": list(drawing.size_mm),
                "cut_mm": job.cut_mm,
                "cut_time_s": job.time_s,
            }
        found["findings"] = [finding.as_dict() for finding in self.findings]
        return found

    def flattening(self) -> Flattening:
        """Return the flat as the sheet would be built, else in the scale that suits the library best."""
        if self.design is not None:
            return self.design.flattening
        return self.report.flattening().scaled(self.report.scale_ratio)


def check(
    spec: DesignSpec,
    mesh: TriMesh,
    library: CellLibrary,
    presets: Mapping[Layer, LayerPreset],
    remedy: Remedy | None = None,
    watch: Watch = unwatched,
) -> Check:
    """Return what speaks for and against building `mesh`; a surface that does not fit is a finding, not an error.

    `remedy` is tried where no single cone-free sheet fits; None: the one that the specification asks for.
    """
    curve = cells_on_offer(spec, library)[2] or selection_curve(library)
    low, high = curve.range_ratio()
    limits = Limits(low, high, spec.cell_mm)
    asked = remedy or spec.remedy()
    report = feasibility(mesh, limits, spec.flatten, asked, lambda done, text: watch(text, 0.6 * done))
    found = list(report.findings)
    design = None
    if report.best() is not None:
        try:
            design = build(
                replace(spec, response=None),
                mesh,
                library,
                presets,
                lambda text, done: watch(f"the sheet: {text}", 0.6 + 0.4 * done),
                report=report,
            )
            found += [finding for finding in design.findings if finding not in found]
        except DesignError as fault:
            found.append(Finding("CHECK-SHEET", fault.message, "error"))
    return Check(topology_of(mesh), report, design, tuple(found))


def topology_of(mesh: TriMesh) -> str:
    """Return in words what kind of surface a mesh is."""
    edges = np.sort(np.vstack([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    euler = len(np.unique(mesh.faces)) - len(np.unique(edges, axis=0)) + len(mesh.faces)
    loops = len(boundary_loops(mesh))
    handles = (2 - loops - euler) // 2
    if handles:
        return f"a surface with {loops} rims and {handles} handles"
    return {0: "a closed surface", 1: "a disk", 2: "a tube, or a disk with a hole"}.get(
        loops, f"a disk with {loops - 1} holes"
    )


def misfit_png(mesh: TriMesh, found: Check, title: str) -> bytes:
    """Return a picture of where the surface fits the library: on the surface, and on its flat."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 6), layout="constrained")
    FigureCanvasAgg(figure)
    report, flat = found.report, found.flattening()
    expansion = flat.expansion_ratio
    colours = report.colors(mesh)[mesh.faces].mean(axis=1) / 255
    space = figure.add_subplot(1, 2, 1, projection="3d")
    x, y, z = mesh.vertices_mm.T
    surface = space.plot_trisurf(x, y, z, triangles=mesh.faces, linewidth=0)
    surface.set_facecolor(colours)
    space.set_aspect("equal")
    few_ticks(space)
    space.set_title(f"{title}: grey fits, red asks for too much expansion, blue for too little", fontsize=9)
    plane = figure.add_subplot(1, 2, 2)
    faces = PolyCollection(list(flat.flat_mm[flat.faces]), array=expansion, cmap="viridis", linewidths=0)
    plane.add_collection(faces)
    plane.autoscale()
    if found.design is not None:
        width, height = found.design.drawing.size_mm
        plane.set(xlim=(0, width), ylim=(0, height))
    plane.set(aspect="equal", xlabel="x, mm", ylabel="y, mm")
    low, high = report.limits.low_ratio, report.limits.high_ratio
    least, most = float(expansion.min()), float(expansion.max())
    plane.set_title(
        f"the flat's faces: spread {most / least:.3f} ({least:.3f} to {most:.3f}), "
        f"the library has {high / low:.3f} ({low:.3f} to {high:.3f})",
        fontsize=9,
    )
    figure.colorbar(faces, ax=plane, label="expansion, deployed over flat length", shrink=0.7)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
    return file.getvalue()
