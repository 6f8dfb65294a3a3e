"""What can be said of a target before anything is built."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from design.cells.library import load_library
from design.checking import check, misfit_png, topology_of
from design.pattern.paths import LAYERS, LayerPreset
from design.spec import DesignSpec
from design.targets import cap, cylinder, pierced_cap, spike

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
SPEC = DesignSpec("target", placement="centred")


def test_a_surface_that_fits_is_laid_out_and_timed() -> None:
    found = check(SPEC, cap(radius_mm=40, edge_mm=5), load_library(), PRESETS)
    assert found.design is not None
    assert found.design.predicted is None
    assert found.as_dict()["cut_time_s"] > 30
    drawn, cells = found.flattening(), found.design.cells
    assert np.ptp(drawn.flat_mm, axis=0) == pytest.approx(np.ptp(cells.tiling.vertices_mm, axis=0), rel=0.25)
    assert drawn.expansion_ratio.mean() == pytest.approx(cells.wanted_ratio.mean(), rel=0.02)
    assert not [finding for finding in found.findings if finding.level == "error"]


def test_a_surface_that_no_sheet_can_become_is_proven_so_and_pictured() -> None:
    mesh = spike(edge_mm=6)
    found = check(SPEC, mesh, load_library(), PRESETS)
    assert found.design is None
    assert found.report.proven_infeasible
    assert {"FIT-PROVEN", "FIT-WHERE"} <= {finding.code for finding in found.findings}
    assert misfit_png(mesh, found, "spike").startswith(b"\x89PNG")


def test_the_remedy_is_the_specifications_own_and_the_ladder_is_climbed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def again(*_: object) -> None:
        raise AssertionError("climbed twice")

    monkeypatch.setattr("design.pipeline.feasibility", again)
    steep = cap(radius_mm=60, half_angle_rad=1.45, edge_mm=6)
    assert check(SPEC, steep, load_library(), PRESETS).design is None
    found = check(replace(SPEC, infeasible="nearest"), steep, load_library(), PRESETS)
    assert found.report.nearest is not None and found.design is not None


@pytest.mark.parametrize(
    ("mesh", "says"), [(cap(edge_mm=10), "disk"), (cylinder(edge_mm=10), "tube"), (pierced_cap(), "hole")]
)
def test_topology_is_said_in_words(mesh, says: str) -> None:
    assert says in topology_of(mesh)
