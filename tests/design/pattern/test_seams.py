"""Labels along seams: the same on both sides, at the same place of the target, clear of slits."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
import shapely

from design.cells.library import load_library
from design.flatten import FlattenOptions
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.seams import Pair, seam_pairs
from design.pipeline import Design, build
from design.predicted import lifted
from design.spec import DesignSpec
from design.surface import TriMesh
from design.targets import cap, vase

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
TUBE = DesignSpec("vase", response=None), vase(edge_mm=5)
CONES = DesignSpec("cones", response=None, flatten=FlattenOptions(cones_count=2)), cap(edge_mm=5)


@pytest.fixture(scope="module", params=[TUBE, CONES], ids=["tube", "cones"])
def design(request: pytest.FixtureRequest) -> Design:
    spec, mesh = request.param
    assert isinstance(spec, DesignSpec)
    assert isinstance(mesh, TriMesh)
    return build(spec, mesh, load_library(), PRESETS)


def pairs_of(design: Design) -> list[Pair]:
    return seam_pairs(design.cells.tiling, design.flattening)


def test_the_two_cells_of_a_label_are_one_place_of_the_target_and_not_of_the_sheet(design: Design) -> None:
    pairs, tiling = pairs_of(design), design.cells.tiling
    assert len(pairs) >= 3
    assert len({pair.label for pair in pairs}) == len(pairs)
    assert len({cell for pair in pairs for cell in (pair.left, pair.right)}) == 2 * len(pairs)
    on_target = lifted(design.flattening, tiling.centres_mm())
    expansion = float(design.cells.wanted_ratio.max())
    for pair in pairs:
        apart = float(np.linalg.norm(on_target[pair.left] - on_target[pair.right]))
        assert apart < 2 * tiling.edge_mm * expansion, pair
        if tiling.twins is None:  # a seam lies between them: no shared corner
            assert not set(tiling.cells[pair.left]) & set(tiling.cells[pair.right])
        else:
            assert pair.right in tiling.neighbours()[pair.left]


def test_both_sides_carry_the_same_strokes_clear_of_every_slit(design: Design) -> None:
    strokes = defaultdict(list)
    for path in design.drawing.paths:
        if path.layer == "engrave":
            strokes[path.cell].append(path.points_mm)
    slits = shapely.union_all([shapely.LineString(p.points_mm) for p in design.drawing.paths if p.layer == "slit"])
    engraved, centres = 0, design.cells.tiling.centres_mm()
    for pair in pairs_of(design):
        if pair.left not in strokes:
            continue
        engraved += 1
        for left, right in zip(strokes[pair.left], strokes[pair.right], strict=True):
            assert left - centres[pair.left] == pytest.approx(right - centres[pair.right])
            for line in (left, right):
                assert slits.distance(shapely.LineString(line)) > 0.05
    assert engraved >= 3
    assert len(strokes) == 2 * engraved
    assert "SEAM-LABELS" in {finding.code for finding in design.findings}
    assert {stroke.layer for stroke in design.job.strokes[: len(strokes)]} == {"engrave"}  # before anything is loose


def test_a_sheet_without_seams_has_no_labels() -> None:
    made = build(DesignSpec("cap", response=None), cap(edge_mm=6), load_library(), PRESETS)
    assert not any(path.layer == "engrave" for path in made.drawing.paths)
    assert "SEAM-LABELS" not in {finding.code for finding in made.findings}
