"""What can be said of a target before anything is built."""

from __future__ import annotations

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
    assert not [finding for finding in found.findings if finding.level == "error"]


def test_a_surface_that_no_sheet_can_become_is_proven_so_and_pictured() -> None:
    mesh = spike(edge_mm=6)
    found = check(SPEC, mesh, load_library(), PRESETS)
    assert found.design is None
    assert found.report.proven_infeasible
    assert {"FIT-PROVEN", "FIT-WHERE"} <= {finding.code for finding in found.findings}
    assert misfit_png(mesh, found.report, "spike").startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("mesh", "says"), [(cap(edge_mm=10), "disk"), (cylinder(edge_mm=10), "tube"), (pierced_cap(), "hole")]
)
def test_topology_is_said_in_words(mesh, says: str) -> None:
    assert says in topology_of(mesh)
