"""Cutting one sheet of a design that is split over several."""

from __future__ import annotations

from pathlib import Path

import pytest

from design.bundle import write_bundle
from design.cells.library import load_library
from design.errors import BundleError
from design.pattern.paths import LAYERS, LayerPreset
from design.pipeline import build
from design.spec import DesignSpec
from design.targets import cap
from fabctl.config.material import load_material
from fabctl.cut.compose import composer, open_design
from fabctl.cut.program import read_program

ROOT = Path(__file__).resolve().parents[2]
BED_MM = (110.0, 95.0)
TEXT = "name: cap\ntarget: {make: cap}\nbed_mm: [110, 95]\n"


def test_the_program_of_each_sheet_stays_on_the_bed_and_others_are_refused(tmp_path: Path) -> None:
    presets = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
    made = build(DesignSpec("cap", response=None, bed_mm=BED_MM), cap(edge_mm=6), load_library(), presets)
    write_bundle(made, TEXT, tmp_path / "cap")
    bundle, spec = open_design(tmp_path / "cap")
    material = load_material(spec.material, ROOT)
    programs = {composer(bundle, spec, material, k + 1)("S-0001", 1000.0) for k in range(len(made.sheets))}
    assert len(programs) == len(made.sheets) > 1
    for lines in programs:
        x_mm, y_mm = reach(lines)
        assert x_mm <= BED_MM[0]
        assert y_mm <= BED_MM[1]
    assert reach(composer(bundle, spec, material)("S-0001", 1000.0))[0] > BED_MM[0]
    with pytest.raises(BundleError, match="no sheet 99"):
        composer(bundle, spec, material, 99)


def reach(lines: tuple[str, ...]) -> tuple[float, float]:
    targets = [step.end_mm for step in read_program(lines).steps]
    return max(x for x, _ in targets), max(y for _, y in targets)
