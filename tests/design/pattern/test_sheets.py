"""A design larger than the bed: the sheets fit, hold together, and joined they are the design."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from design.bundle import open_bundle, write_bundle
from design.cells.library import load_library
from design.pattern.border import BorderOptions
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.sheets import parts_of, pieces_of, shared_edges
from design.pattern.tiling import Tiling, tile
from design.pipeline import Design, build
from design.spec import DesignSpec
from design.targets import cap

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
BED_MM = (110.0, 95.0)
SPEC = DesignSpec("cap", response=None, bed_mm=BED_MM)
BARE = BorderOptions(marks=False, id_height_mm=0, sheet_margin_mm=0)


@pytest.fixture(scope="module")
def design() -> Design:
    return build(SPEC, cap(edge_mm=5), load_library(), PRESETS)


def horseshoe() -> Tiling:
    outer = shapely.Point(0, 0).buffer(60).difference(shapely.box(-25, -5, 25, 100))
    whole = tile(np.array([[-60.0, -60], [60, -60], [60, 60], [-60, 60]]), np.array([[0, 1, 2], [0, 2, 3]]), 10.0)
    centres = whole.centres_mm()
    return whole.part(shapely.contains_xy(outer, centres[:, 0], centres[:, 1])).compact()


def test_every_sheet_fits_the_bed_with_its_tag_and_all_cells_are_on_one(design: Design) -> None:
    assert max(design.drawing.size_mm) > max(BED_MM)
    assert len(design.sheets) > 1
    owners: list[set[int]] = []
    for sheet in design.sheets:
        assert sheet.drawing.size_mm[0] <= BED_MM[0]
        assert sheet.drawing.size_mm[1] <= BED_MM[1]
        assert sheet.drawing.id_anchor is not None
        points = np.vstack([path.points_mm for path in sheet.drawing.paths])
        assert (points >= 0).all()
        assert (points <= sheet.drawing.size_mm).all()
        owners.append({p.cell for p in sheet.drawing.paths if p.layer == "slit" and p.cell is not None})
        assert sum(p.layer == "outline" for p in sheet.drawing.paths) == 1  # one piece
    assert sum(map(len, owners)) == len(set.union(*owners)) == len(design.cells.kind)
    (told,) = [finding.message for finding in design.findings if finding.code == "SHEET-SPLIT"]
    assert f"{len(design.sheets)} sheets" in told


def test_joined_sheets_are_the_designed_sheet_slit_for_slit(design: Design) -> None:
    whole = {(p.cell, p.opens): p for p in design.drawing.paths if p.layer == "slit"}
    assert whole
    lengths = [
        sum(shapely.LineString(p.points_mm).length for p in drawing.paths if p.layer == "slit")
        for drawing in (design.drawing, *(sheet.drawing for sheet in design.sheets))
    ]
    assert sum(lengths[1:]) == pytest.approx(lengths[0], abs=1e-3)  # a kink below 0.1 µm may be left out of a half
    # On a join each cell's half slit opens where its neighbour's does: every mouth off the border has its partner.
    labels = defaultdict(list)
    for number, sheet in enumerate(design.sheets):
        for path in sheet.drawing.paths:
            if path.layer == "engrave" and path.cell is not None:
                labels[path.cell].append((number, path.points_mm))
    (told,) = [finding.message for finding in design.findings if finding.code == "SHEET-SPLIT"]
    assert f"1 to {len(labels) // 2}" in told
    assert len(labels) >= 6
    opens = [sum(p.opens for p in d.paths) for d in (design.drawing, *(sheet.drawing for sheet in design.sheets))]
    crossing = opens[0] + 2 * joined_edges_count(design)
    assert sum(opens[1:]) == crossing


def joined_edges_count(design: Design) -> int:
    sheet_of = {p.cell: k for k, s in enumerate(design.sheets) for p in s.drawing.paths if p.layer == "slit"}
    return sum(sheet_of[a] != sheet_of[b] for a, b in zip(*map(list, shared_edges(design.cells.tiling)), strict=True))


def test_the_folder_has_every_sheets_files_under_its_manifest(design: Design, tmp_path: Path) -> None:
    bundle = write_bundle(design, "name: cap\n", tmp_path / "cap")
    for number, sheet in enumerate(design.sheets, start=1):
        for name in (f"paths-{number}.json", f"cut-{number}.dxf", f"cut-{number}.svg", f"cut-{number}.nc"):
            assert name in bundle.manifest["files"]
        assert open_bundle(bundle.path).drawing(number).size_mm == pytest.approx(sheet.drawing.size_mm)
    assert len(bundle.manifest["facts"]["sheets_mm"]) == len(design.sheets)


@pytest.mark.parametrize("grid", [(2, 1), (1, 3), (3, 3), (5, 4)])
def test_parts_hold_together_by_edges_whatever_the_shape(grid: tuple[int, int]) -> None:
    tiling = horseshoe()
    part = parts_of(tiling, *grid)
    a, b = shared_edges(tiling)
    same = part[a] == part[b]
    count = len(tiling.cells)
    graph = coo_array((np.ones(int(same.sum())), (a[same], b[same])), shape=(count, count))
    assert connected_components(graph, directed=False)[0] == part.max() + 1
    assert len(np.unique(part)) == part.max() + 1 > 1


def test_a_rim_to_clamp_goes_around_the_design_and_not_along_its_joins() -> None:
    tiling = horseshoe()
    part = parts_of(tiling, 3, 3)
    plain, rimmed = pieces_of(tiling, part, 0.0), pieces_of(tiling, part, 6.0)
    cells = shapely.union_all(plain)
    for k, (bare, grown) in enumerate(zip(plain, rimmed, strict=True)):
        assert grown.covers(bare.buffer(-1e-6))
        assert all(grown.intersection(other).area < 1e-6 for m, other in enumerate(rimmed) if m != k)
    around = cells.buffer(6, join_style="mitre", mitre_limit=2)
    assert shapely.union_all(rimmed).area == pytest.approx(around.area, rel=1e-3)


def test_a_bed_too_small_for_anything_is_told_and_a_large_one_splits_nothing() -> None:
    tiny = build(replace(SPEC, bed_mm=(30.0, 30.0)), cap(edge_mm=6), load_library(), PRESETS)
    assert tiny.sheets == ()
    assert "SHEET-BED" in {finding.code for finding in tiny.findings}
    large = build(replace(SPEC, bed_mm=(600.0, 400.0), border=BARE), cap(edge_mm=6), load_library(), PRESETS)
    assert large.sheets == ()
    assert not {finding.code for finding in large.findings} & {"SHEET-BED", "SHEET-SPLIT"}
