"""A whole vase: one sheet whose two sides meet cell to cell when it is rolled up."""

from __future__ import annotations

import numpy as np
import pytest

from design.cells.library import load_library
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.slits import slits_of
from design.pattern.tubes import period_mm, seam_gap_mm
from design.pipeline import Design, build
from design.predicted import lifted
from design.spec import DesignSpec
from design.targets import vase

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}


@pytest.fixture(scope="module")
def design() -> Design:
    return build(DesignSpec("vase", response=None), vase(edge_mm=5), load_library(), PRESETS)


def seam(design: Design) -> tuple[np.ndarray, np.ndarray]:
    twins = design.cells.tiling.twins
    assert twins is not None
    right = np.flatnonzero(twins != np.arange(len(twins)))
    return right, twins[right]


def test_the_seams_sides_coincide_after_the_translation_of_whole_cells(design: Design) -> None:
    period = period_mm(design.flattening)
    assert period is not None
    assert period / 10 == pytest.approx(round(period / 10), abs=1e-9)
    assert len(seam(design)[0]) > 3
    assert seam_gap_mm(design.cells.tiling, period) <= 0.01
    right, left = (lifted(design.flattening, design.cells.tiling.vertices_mm)[side] for side in seam(design))
    assert np.abs(right - left).max() <= 0.01  # on the vase itself


def test_slits_run_on_across_the_joined_seam(design: Design) -> None:
    cells = design.cells
    slits = slits_of(cells.tiling, cells.choice.t_mm, cells.choice.theta_rad, cells.hinge_mm, 0.125)
    period = np.array([period_mm(design.flattening), 0.0])
    neighbours, centres = cells.tiling.neighbours(), cells.tiling.centres_mm()
    joined = 0
    for cell, k in zip(*np.nonzero(neighbours >= 0), strict=True):
        other = neighbours[cell, k]
        if centres[cell, 0] - centres[other, 0] > period[0] / 2:
            m = int(np.flatnonzero(neighbours[other] == cell)[0])
            assert slits.edge_mm[cell, k] - slits.edge_mm[other, m] == pytest.approx(period, abs=1e-6)
            joined += 1
    assert joined > 3
    # Only the foot and the lip are border.
    assert (neighbours < 0).sum() == 2 * round(period[0] / 10)
