"""Strokes of the beam: kerf on analytic shapes, slit widths, lead-in, overcut, tabs, order, heat, travel."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks._travel_bound import bound_mm
from design.errors import DesignError
from design.pattern.order import floor_mm, greedy_with_flips, tour, travel_mm
from design.pattern.paths import CutPath
from design.pattern.sequence import sequence
from design.pattern.toolpath import ToolOptions, signed_area_mm2, strokes_of

SQUARE_mm = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 40.0], [0.0, 40.0]])
KERF_mm = 0.2


def burnt(strokes: list[CutPath]) -> shapely.Geometry:
    """What the beam takes away: a disk of the kerf along every stroke."""
    lines = [shapely.LineString(stroke.points_mm) for stroke in strokes]
    return shapely.union_all([line.buffer(KERF_mm / 2, quad_segs=64) for line in lines])


def rest(sheet: shapely.Geometry, strokes: list[CutPath]) -> list[shapely.Geometry]:
    left = sheet.difference(burnt(strokes))
    return sorted(getattr(left, "geoms", [left]), key=lambda part: part.area)


def circle(radius_mm: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    return radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("loop_mm", [SQUARE_mm, SQUARE_mm[[0, 1, 2]]])
def test_what_is_cut_out_has_the_drawn_size(loop_mm: np.ndarray) -> None:
    strokes = strokes_of([CutPath("outline", loop_mm, closed=True)], ToolOptions(KERF_mm))
    piece, _ = rest(shapely.box(-30, -30, 90, 70), strokes)
    assert piece.area == pytest.approx(shapely.Polygon(loop_mm).area, abs=0.01)
    assert piece.bounds == pytest.approx(shapely.Polygon(loop_mm).bounds, abs=0.001)


def test_a_disk_keeps_its_radius_and_a_hole_too() -> None:
    disk = strokes_of([CutPath("outline", circle(15), closed=True)], ToolOptions(KERF_mm))
    piece, _ = rest(shapely.box(-30, -30, 30, 30), disk)
    assert np.sqrt(piece.area / np.pi) == pytest.approx(15, abs=0.005)
    hole = strokes_of([CutPath("hole", circle(15), closed=True)], ToolOptions(KERF_mm))
    _, frame = rest(shapely.box(-30, -30, 30, 30), hole)
    assert np.sqrt(shapely.Polygon(frame.interiors[0]).area / np.pi) == pytest.approx(15, abs=0.005)


def test_an_opening_in_the_piece_is_cut_from_its_inside() -> None:
    strokes = strokes_of([CutPath("outline", SQUARE_mm[::-1], closed=True)], ToolOptions(KERF_mm))
    _, frame = rest(shapely.box(-30, -30, 90, 70), strokes)
    assert shapely.Polygon(frame.interiors[0]).area == pytest.approx(60 * 40, abs=0.01)


@given(st.floats(0.2, 1.5))
def test_a_slit_is_as_wide_and_as_long_as_drawn(width_mm: float) -> None:
    line = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]])
    options = ToolOptions(KERF_mm, slit_width_mm=width_mm, slit_sides="both" if width_mm > KERF_mm + 0.01 else "auto")
    void = burnt(strokes_of([CutPath("slit", line)], options))
    low_x, low_y, high_x, high_y = shapely.Polygon(void.exterior).bounds
    assert high_x - low_x == pytest.approx(8, abs=0.01)
    expected = width_mm if options.slit_sides == "both" else KERF_mm
    assert high_y - low_y == pytest.approx(expected, abs=0.01)


def test_a_half_slit_stays_open_at_the_border_and_keeps_its_hinge() -> None:
    (stroke,) = strokes_of([CutPath("slit", np.array([[0.0, 0.0], [5.0, 0.0]]), opens=True)], ToolOptions(KERF_mm))
    assert stroke.points_mm.tolist() == [[KERF_mm / 2, 0.0], [5.0, 0.0]]


def test_two_sides_need_a_beam_finer_than_the_slit() -> None:
    with pytest.raises(DesignError, match="both sides"):
        strokes_of([CutPath("slit", SQUARE_mm[:3])], ToolOptions(KERF_mm, slit_width_mm=0.1, slit_sides="both"))


def test_a_slit_that_bends_close_to_its_end_is_shortened_round_the_bend() -> None:
    line = np.array([[0.0, 0.0], [0.04, 0.0], [0.04, 5.0]])
    (stroke,) = strokes_of([CutPath("slit", line)], ToolOptions(KERF_mm))
    assert stroke.points_mm == pytest.approx(np.array([[0.04, 0.06], [0.04, 4.9]]))


@pytest.mark.parametrize("loop_mm", [SQUARE_mm[::-1] * [1, 0.02], SQUARE_mm[::-1] * 0.01])
def test_a_lead_in_never_burns_the_other_side_of_a_narrow_opening(loop_mm: np.ndarray) -> None:
    path = CutPath("hole", loop_mm, closed=True)
    void = shapely.Polygon(loop_mm).buffer(1e-6)
    assert burnt(strokes_of([path], ToolOptions(KERF_mm, lead_in_mm=1.0, overcut_mm=0.3))).within(void)


def test_a_lead_in_begins_where_there_is_room_beside_the_piece() -> None:
    tag = shapely.box(0, 0, 40, 10).union(shapely.box(18, 10, 22, 11)).union(shapely.box(0, 11, 40, 30))  # a 1 mm gap
    loop_mm = np.asarray(tag.exterior.coords)[:-1]
    loop_mm = loop_mm if signed_area_mm2(loop_mm) > 0 else loop_mm[::-1]
    for first in range(len(loop_mm)):
        path = CutPath("outline", np.roll(loop_mm, first, axis=0), closed=True)
        (stroke,) = strokes_of([path], ToolOptions(KERF_mm, lead_in_mm=1.5))
        assert np.linalg.norm(stroke.points_mm[1] - stroke.points_mm[0]) == pytest.approx(1.5)
        assert burnt([stroke]).intersection(tag).area < 1e-4


def test_the_lead_in_starts_in_the_waste_and_the_overcut_passes_the_start() -> None:
    options = ToolOptions(KERF_mm, lead_in_mm=1.5, overcut_mm=0.8)
    for loop, layer in ((SQUARE_mm, "outline"), (SQUARE_mm[::-1], "outline"), (SQUARE_mm, "hole")):
        (stroke,) = strokes_of([CutPath(layer, loop, closed=True)], options)
        start, first = stroke.points_mm[:2]
        assert np.linalg.norm(start - first) == pytest.approx(1.5)
        inside = shapely.Polygon(loop).contains(shapely.Point(start))
        assert inside == (layer == "hole" or signed_area_mm2(loop) < 0)
        assert np.linalg.norm(stroke.points_mm[-1] - first) == pytest.approx(0.8)


def test_tabs_leave_bridges_of_the_asked_width() -> None:
    strokes = strokes_of([CutPath("outline", SQUARE_mm, closed=True)], ToolOptions(KERF_mm, tabs_count=5, tab_mm=0.6))
    assert len(strokes) == 5
    whole = shapely.LinearRing(
        strokes_of([CutPath("outline", SQUARE_mm, closed=True)], ToolOptions(KERF_mm))[0].points_mm
    )
    bare = whole.length - sum(shapely.LineString(s.points_mm).length for s in strokes)
    assert bare == pytest.approx(5 * (0.6 + KERF_mm))
    assert len(rest(shapely.box(-30, -30, 90, 70), strokes)) == 1  # the piece still hangs in the sheet


def test_a_hole_narrower_than_the_beam_is_refused() -> None:
    with pytest.raises(DesignError, match="narrower"):
        strokes_of([CutPath("hole", circle(0.05), closed=True)], ToolOptions(KERF_mm))


def random_ends(count: int, seed: int, length_mm: float = 5.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    start, angle = rng.uniform(0, 2.3 * np.sqrt(count), (count, 2)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([start, start + length_mm * np.column_stack([np.cos(angle), np.sin(angle)])], axis=1).reshape(-1, 2)


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 60), st.integers(0, 1000))
def test_a_tour_meets_every_stroke_once_and_beats_neither_the_floor_nor_loses_to_greedy(count: int, seed: int) -> None:
    ends = random_ends(count, seed)
    order = tour(ends)
    assert sorted(order.tolist()) == list(range(2 * count))
    assert (order[::2] ^ 1 == order[1::2]).all()
    if count > 2:
        closed = lambda o: travel_mm(ends, o) + np.linalg.norm(ends[o[0]]) + np.linalg.norm(ends[o[-1]])  # noqa: E731
        assert closed(order) <= closed(greedy_with_flips(ends)) + 1e-6


def test_the_tour_is_the_shortest_of_all_on_a_few_strokes() -> None:
    from itertools import permutations, product

    ends = random_ends(5, 3)

    def length(order: list[int]) -> float:
        points = np.vstack([[0, 0], ends[order], [0, 0]])
        return float(np.linalg.norm(points[1::2] - points[::2], axis=1).sum())

    everything = (
        [end for k, flip in zip(rank, flips, strict=True) for end in (2 * k + flip, 2 * k + 1 - flip)]
        for rank in permutations(range(5))
        for flips in product((0, 1), repeat=5)
    )
    assert length(tour(ends).tolist()) == pytest.approx(min(map(length, everything)))


@pytest.mark.parametrize("seed", range(4))
def test_no_order_travels_less_than_the_bound(seed: int) -> None:
    ends = np.random.default_rng(seed).uniform(0, 50, (400, 2))
    found = travel_mm(ends, tour(ends))
    bound = bound_mm(ends, found)
    assert floor_mm(ends) < bound <= found
    assert bound > 0.85 * found  # the floor is at 0.8


def test_travel_is_a_quarter_shorter_than_greedy() -> None:
    ends = random_ends(3000, 1)
    ratio = travel_mm(ends, tour(ends)) / travel_mm(ends, greedy_with_flips(ends))
    assert ratio <= 0.75
    assert travel_mm(ends, tour(ends)) >= floor_mm(ends)


def test_rings_that_an_exchange_closes_are_opened_again_where_that_pays() -> None:
    rng = np.random.default_rng(2)
    start, angle = rng.uniform(0, 105, (2000, 2)), rng.uniform(0, 2 * np.pi, 2000)
    ends = np.stack([start, start + np.column_stack([np.cos(angle), np.sin(angle)])], axis=1).reshape(-1, 2)
    ratio = travel_mm(ends, tour(ends, kicks_count=0)) / travel_mm(ends, greedy_with_flips(ends))
    assert ratio <= 0.76  # 0.771 by exchanges that close no ring


def test_once_enough_ends_were_turned_chains_stay_short_and_the_order_is_still_a_good_one() -> None:
    ends = random_ends(3000, 1, length_mm=8.0)
    greedy_mm = travel_mm(ends, greedy_with_flips(ends))
    orders = {limit: tour(ends, turned_limit_count=limit) for limit in (0, 10**9)}
    ratio = {limit: travel_mm(ends, order) / greedy_mm for limit, order in orders.items()}
    assert ratio[10**9] < ratio[0] - 0.005
    assert ratio[0] <= 0.8
    assert (tour(ends, turned_limit_count=0) == orders[0]).all()
    assert sorted(orders[0].tolist()) == list(range(len(ends)))


def test_layers_come_in_order_and_the_inner_contour_before_the_outer() -> None:
    outer = CutPath("outline", SQUARE_mm, closed=True)
    inner = CutPath("outline", (SQUARE_mm / 4 + 20)[::-1], closed=True)
    slit = CutPath("slit", np.array([[5.0, 5.0], [9.0, 5.0], [12.0, 6.0]]))
    mark = CutPath("mark", np.array([[1.0, 1.0], [2.0, 1.0]]))
    found = sequence(strokes_of([outer, slit, inner, mark]))
    assert [stroke.layer for stroke in found] == ["mark", "slit", "outline", "outline"]
    assert shapely.Polygon(found[3].points_mm).contains(shapely.Polygon(found[2].points_mm))


def test_passes_go_over_a_whole_layer_and_back() -> None:
    strokes = [CutPath("slit", np.array([[x, 0.0], [x + 1, 0.0]])) for x in (0.0, 3.0, 6.0)]
    found = sequence(strokes, {"slit": 2})
    assert [s.points_mm.tolist() for s in found[3:]] == [s.points_mm[::-1].tolist() for s in reversed(found[:3])]


def test_spreading_heat_keeps_strokes_that_follow_each_other_apart() -> None:
    strokes = [CutPath("slit", np.array([[x, y], [x + 0.5, y]])) for x in np.arange(12.0) for y in np.arange(12.0)]
    middles = np.array([stroke.points_mm.mean(axis=0) for stroke in sequence(strokes, spread_mm=1.6)])
    steps = np.linalg.norm(np.diff(middles, axis=0), axis=1)
    assert (steps <= 1.6).sum() <= 8  # only where a round over the sheet ends
    assert len(middles) == 144
