"""Contracting cells on the sheet: holes that are the deployed outlines of slit cells, closed, and matched on edges."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from design.cells.contracting import at_cells, load_contracting, openings
from design.cells.select import selection_curve
from design.cells.sheet import Sheet
from design.errors import DesignError
from design.pattern.border import BorderOptions
from design.pattern.holes import Holes, holes_of
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.sequence import sequence
from design.pattern.slits import outline_loops
from design.pattern.tiling import Tiling, lattice
from design.pattern.toolpath import ToolOptions, strokes_of
from design.pipeline import Design, build
from design.spec import DesignSpec, Region
from design.targets import cap

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
EDGE_mm = 14.0
SHEET = Sheet(edge_mm=EDGE_mm, slit_mm=0.0125 * EDGE_mm, hinge_mm=0.025 * EDGE_mm)
SPEC = DesignSpec("cap", cells="contracting", cell_mm=EDGE_mm, response=None)


def patch(t_mm: tuple[float, float] = (1.2, 1.2)) -> tuple[Tiling, Holes, np.ndarray]:
    whole = lattice(np.zeros(2), np.array([40.0, 40.0]), 10.0)
    tiling = whole.part(np.linalg.norm(whole.centres_mm() - [20, 20], axis=1) < 22).compact()
    count = len(tiling.cells)
    t = np.where(np.arange(count) % 2, *t_mm)
    cut = np.ones(count, dtype=bool)
    return tiling, holes_of(tiling, openings(t, np.full(count, 0.05), Sheet()), cut), cut


@pytest.fixture(scope="module")
def design() -> Design:
    return build(SPEC, cap(edge_mm=8), load_contracting().scaled(SHEET), PRESETS)


def test_holes_take_the_area_by_which_the_cell_had_opened() -> None:
    tiling, holes, cut = patch()
    inside = holes.inside(tiling, cut)
    (opened,) = set(np.round(at_cells(load_contracting(), "open_ratio", np.array([1.2]), np.array([0.05])), 6))
    slits_share = 3 * 0.125 * 0.9 * 4.5 / 43.3  # what the slits themselves had taken, roughly
    area = np.median([shapely.Polygon(path.points_mm).area for path in inside.paths])
    cell_mm2 = math.sqrt(3) / 4 * 100
    share = 1.5 * area / cell_mm2  # a cell has three halves
    assert share == pytest.approx(1 - (1 - slits_share) / opened**2, abs=0.03)


def test_a_sheet_of_holes_holds_together_and_no_two_holes_meet() -> None:
    tiling, holes, cut = patch((1.1, 1.3))
    inside = holes.inside(tiling, cut)
    rings = [shapely.Polygon(path.points_mm) for path in inside.paths]
    rings += [shapely.Polygon(half.ring_mm) for half in inside.halves]
    assert all(ring.is_valid for ring in rings)
    union = shapely.union_all(rings)
    assert union.area == pytest.approx(sum(ring.area for ring in rings), rel=1e-9)
    piece = shapely.union_all([shapely.Polygon(loop) for loop in outline_loops(tiling)])
    left = piece.difference(shapely.union_all([ring.buffer(1e-6) for ring in rings]))
    assert left.geom_type == "Polygon"


def test_hinges_have_the_slit_cells_width_shrunk_with_it() -> None:
    tiling, holes, cut = patch()
    rings = [shapely.Polygon(path.points_mm) for path in holes.inside(tiling, cut).paths]
    opened = at_cells(load_contracting(), "open_ratio", np.array([1.2]), np.array([0.05]))[0]
    tree = shapely.STRtree(rings)
    gaps = [min(rings[k].distance(rings[m]) for m in tree.query(rings[k].buffer(1)) if m != k) for k in (20, 25, 30)]
    assert gaps == pytest.approx(np.full(3, 0.25 / opened), abs=0.03)


def test_neighbours_that_differ_meet_halfway_on_their_edge() -> None:
    tiling, holes, _ = patch((1.1, 1.3))
    alone = [one.border[0] for one in openings(np.array([1.1, 1.3]), np.full(2, 0.05), Sheet())]
    wanted = 10 * np.mean([np.linalg.norm(point) for point in alone])
    shared = np.flatnonzero((tiling.neighbours() >= 0).ravel())
    corners = tiling.vertices_mm[tiling.cells].reshape(-1, 2)
    mixed = [np.linalg.norm(holes.halves_mm[k][0] - corners[k]) for k in shared if _differ(tiling, k)]
    assert mixed and np.allclose(mixed, wanted, atol=1e-9)


def _differ(tiling: Tiling, slot: int) -> bool:
    other = int(tiling.neighbours().ravel()[slot])
    return (slot // 3) % 2 != other % 2


def test_a_contracting_design_is_larger_than_its_target_and_has_no_slits(design: Design) -> None:
    ratio = design.cells.choice.expansion_ratio
    assert (ratio < 1).all()
    assert {path.layer for path in design.drawing.paths} == {"hole", "outline", "mark"}
    assert all(path.closed for path in design.drawing.paths if path.layer in ("hole", "outline"))
    flat, deployed = design.flattening.flat_mm, design.mesh.vertices_mm
    assert np.ptp(flat, axis=0).max() > 1.1 * np.ptp(deployed, axis=0).max()
    own = design.flattening.expansion_ratio
    assert own.min() > 0.55 and own.max() < 0.95
    assert "CELLS-CONTACT" in {finding.code for finding in design.findings}


def test_the_beam_runs_inside_holes_and_every_hole_before_the_outline(design: Design) -> None:
    layers = [stroke.layer for stroke in design.job.strokes]
    assert layers.index("outline") > max(k for k, layer in enumerate(layers) if layer == "hole")
    holes = [path for path in design.drawing.paths if path.layer == "hole"]
    for path in holes[:40]:
        (stroke,) = strokes_of([path], ToolOptions(kerf_mm=0.125))
        burnt = shapely.LineString(stroke.points_mm).buffer(0.0625, quad_segs=32)
        drawn = shapely.Polygon(path.points_mm)
        assert burnt.difference(drawn.buffer(1e-3)).area < 1e-3
        assert drawn.difference(shapely.Polygon(burnt.exterior)).area < 0.01 * drawn.area


def test_half_holes_are_closed_by_a_rim_and_by_solid_cells_and_open_on_a_bare_border(design: Design) -> None:
    library = load_contracting().scaled(SHEET)
    rim = build(replace(SPEC, border=BorderOptions(margin_mm=8)), cap(edge_mm=8), library, PRESETS)
    solid = build(replace(SPEC, passive=(Region(0, 0, 25),)), cap(edge_mm=8), library, PRESETS)

    def count(made: Design) -> int:
        return sum(path.layer == "hole" for path in made.drawing.paths)

    neighbours = design.cells.tiling.neighbours()
    assert count(design) == (neighbours >= 0).sum() // 2
    assert count(rim) == count(design) + (neighbours < 0).sum()
    assert count(design) > count(solid)
    cells = solid.cells
    for path in solid.drawing.paths:
        if path.layer == "hole":
            ring = shapely.Polygon(path.points_mm)
            touched = [k for k in np.flatnonzero(~cells.cut()).tolist() if _overlap(cells.tiling, k, ring) > 1e-6]
            assert touched == []


def _overlap(tiling: Tiling, cell: int, ring: shapely.Polygon) -> float:
    return float(shapely.Polygon(tiling.vertices_mm[tiling.cells[cell]]).intersection(ring).area)


def test_a_contracting_design_larger_than_the_bed_parts_through_its_holes(design: Design) -> None:
    width, height = design.drawing.size_mm
    parted = build(
        replace(SPEC, bed_mm=(width * 0.7, height)), cap(edge_mm=8), load_contracting().scaled(SHEET), PRESETS
    )
    assert len(parted.sheets) >= 2

    def material_mm2(drawings: list) -> float:
        total = 0.0
        for drawing in drawings:
            for path in drawing.paths:
                if path.layer in ("hole", "outline"):
                    area = shapely.Polygon(path.points_mm).area
                    ccw = shapely.LinearRing(path.points_mm).is_ccw
                    total += area if path.layer == "outline" and ccw else -area
        return total

    bare = replace(SPEC, border=BorderOptions(id_height_mm=0), bed_mm=(width * 0.7, height))
    parted = build(bare, cap(edge_mm=8), load_contracting().scaled(SHEET), PRESETS)
    whole = material_mm2([parted.drawing])
    assert material_mm2([sheet.drawing for sheet in parted.sheets]) == pytest.approx(whole, rel=1e-3)


def test_the_curve_of_contracting_cells_runs_without_jumps_and_cells_solved_agree() -> None:
    from design.cells.open_cells import solve_open_cell

    library = load_contracting()
    curve = selection_curve(library)
    assert np.abs(np.diff(curve.t_mm)).max() < 0.01
    for k in (40, 150, 260):
        cell, _ = solve_open_cell(curve.t_mm[k], curve.theta_rad[k], Sheet())
        assert cell.expansion_ratio == pytest.approx(curve.expansion_ratio[k], abs=1.5e-3)  # steps of 0.05 mm
        assert cell.open_ratio is not None and cell.stiffness_mm2 is not None
        energy = Sheet().E_MPa * Sheet().thickness_mm
        assert curve.stiffness_mJ[k] == pytest.approx(cell.stiffness_mm2 / cell.open_ratio**2 * energy, rel=0.02)


def test_a_cell_that_does_not_open_is_told() -> None:
    with pytest.raises(DesignError, match="does not open"):
        openings(np.array([3.0]), np.array([0.0]), Sheet())


def test_many_holes_are_ordered_in_a_moment() -> None:
    tiling, holes, cut = patch()
    strokes = strokes_of(holes.inside(tiling, cut).paths, ToolOptions(kerf_mm=0.1))
    assert len(sequence(strokes)) == len(strokes)
