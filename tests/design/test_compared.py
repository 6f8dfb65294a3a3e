"""Coupons and comparisons of designs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design.bundle import write_bundle
from design.cells.library import load_library
from design.cells.select import select
from design.cells.sheet import Sheet
from design.compared import compare, coupon, coupon_csv
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.toolpath import ToolOptions, strokes_of
from design.pipeline import build
from design.spec import DesignSpec, Region
from design.targets import cap

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
SPEC = DesignSpec("cap", response=None, placement="centred")
MESH = cap(radius_mm=40, edge_mm=5)


def test_a_coupon_is_uniform_but_for_its_hinges_and_wider_hinges_expand_less() -> None:
    cell = select(load_library(), np.array([1.5]))
    drawing, patches = coupon(float(cell.t_mm[0]), float(cell.theta_rad[0]), [0.25, 0.4], Sheet(), (3, 2))
    assert patches[0].expansion_ratio == pytest.approx(1.5, abs=0.002)  # the library's own hinge
    assert patches[1].expansion_ratio is not None
    assert patches[1].expansion_ratio < patches[0].expansion_ratio - 0.01
    outlines = [path.points_mm for path in drawing.paths if path.layer == "outline"]
    assert len(outlines) == 2
    assert np.ptp(outlines[0], axis=0) == pytest.approx(np.ptp(outlines[1], axis=0))
    assert coupon_csv(patches).splitlines()[1].startswith("A,0.2500,1.5")
    points = np.vstack([path.points_mm for path in drawing.paths])
    assert (points >= 0).all()
    assert (points <= drawing.size_mm).all()
    assert len(strokes_of(drawing.paths, ToolOptions())) == len(drawing.paths)


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


def test_a_sheet_larger_than_the_bed_is_said_so() -> None:
    codes = {finding.code for finding in build(replace(SPEC, bed_mm=(50, 50)), MESH, load_library(), PRESETS).findings}
    assert "SHEET-SPLIT" in codes
