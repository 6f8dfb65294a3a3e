"""The material's kerf reaches the machine: another kerf, another program."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from design.pattern.drawing import Drawing
from design.pattern.paths import CutPath
from fabctl.config.loader import load
from fabctl.config.material import load_material
from fabctl.config.spec import SpecConfig
from fabctl.cut.compose import composer
from fabctl.cut.program import read_program

SQUARE = np.array([[10.0, 10.0], [40.0, 10.0], [40.0, 40.0], [10.0, 40.0], [10.0, 10.0]])
DRAWING = Drawing((60.0, 60.0), (CutPath("outline", SQUARE, closed=True),))


def program(kerf_mm: float) -> tuple[str, ...]:
    """Return the job of a square of 30 mm with this kerf in the material's file."""
    material = load_material("natural-rubber-2.3", Path())
    assert material.laser is not None
    changed = material.model_copy(update={"laser": material.laser.model_copy(update={"kerf_mm": kerf_mm})})
    spec = load(Path("configs/specs/cap.yaml"), SpecConfig)
    bundle = SimpleNamespace(drawing=lambda sheet: DRAWING)
    return composer(bundle, spec, changed)("S-0001", 1000.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("kerf_mm", [0.1, 0.23, 0.3])
def test_a_part_is_cut_outside_its_line_by_half_the_materials_kerf(kerf_mm: float) -> None:
    burns = [step for step in read_program(program(kerf_mm)).steps if step.burns]
    points = np.array([step.end_mm[:2] for step in burns])
    assert np.ptp(points, axis=0) == pytest.approx([30 + kerf_mm, 30 + kerf_mm], abs=0.002)
    assert points.min(axis=0) == pytest.approx([10 - kerf_mm / 2] * 2, abs=0.002)
