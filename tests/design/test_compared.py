"""Comparisons of designs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from design.bundle import write_bundle
from design.cells.library import load_library
from design.compared import compare, compared_lines
from design.pattern.paths import LAYERS, LayerPreset
from design.pipeline import build
from design.spec import DesignSpec, Region
from design.targets import cap

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
SPEC = DesignSpec("cap", response=None, placement="centred")
MESH = cap(radius_mm=40, edge_mm=5)


def test_passive_cells_are_not_cut_and_a_comparison_counts_what_is_shared(tmp_path: Path) -> None:
    plain = build(SPEC, MESH, load_library(), PRESETS)
    stiff = build(replace(SPEC, passive=(Region(0, 0, 8),)), MESH, load_library(), PRESETS)
    passive = [k for k, kind in enumerate(stiff.cells.kind) if kind == "passive"]
    assert passive
    assert not any(path.cell in passive for path in stiff.drawing.paths)
    found = compare(write_bundle(plain, "", tmp_path / "a"), write_bundle(stiff, "", tmp_path / "b"))
    assert found["b_over_a_ratio"]["cut_mm"] < 1
    assert found["cells_at_the_same_place_count"] == len(plain.cells.kind)
    assert found["largest_difference_t_mm"] == 0
    assert "target.ply" in found["same_files"]
    told = "\n".join(compared_lines(found))
    for words in ("sheet width, mm", "cutting time, min", "cut, m", "t 0 mm", "both from the same library"):
        assert words in told
    assert not any(f"{key} " in told for key in found["a"])
    assert "off the target" not in told  # neither design was deployed


def test_a_sheet_larger_than_the_bed_is_said_so() -> None:
    codes = {finding.code for finding in build(replace(SPEC, bed_mm=(50, 50)), MESH, load_library(), PRESETS).findings}
    assert "SHEET-SPLIT" in codes
