"""What is written can be read back: DXF, SVG, G-code; and the program is one GRBL may be given."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks._readback import read_dxf, read_gcode, read_svg
from design.errors import DesignError
from design.export.dxf import dxf
from design.export.gcode import END, LINE_LIMIT, GcodeOptions, gcode
from design.export.svg import svg
from design.job import JobOptions, compose_job
from design.pattern.drawing import Drawing, as_json, from_json
from design.pattern.font import GLYPHS, Anchor, text_strokes, text_width_mm
from design.pattern.paths import LAYERS, CutPath, LayerPreset

PRESETS = {layer: LayerPreset(0.1 * (k + 1), 20.0 + k) for k, layer in enumerate(LAYERS)}
SIZE_mm = (300.0, 200.0)
coordinate = st.floats(0, 199, allow_nan=False)
points = st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=6, unique=True).map(np.array)
path = st.builds(CutPath, st.sampled_from(LAYERS), points, st.booleans())


def drawn(one: CutPath) -> np.ndarray:
    return np.vstack([one.points_mm, one.points_mm[:1]]) if one.closed else one.points_mm


@settings(deadline=None, max_examples=20)
@given(st.lists(path, min_size=1, max_size=5))
def test_dxf_and_svg_read_back_to_the_same_polylines(paths: list[CutPath]) -> None:
    ordered = [one for layer in LAYERS for one in paths if one.layer == layer]
    for found, expected in ((read_dxf(dxf(paths, SIZE_mm)), paths), (read_svg(svg(paths, SIZE_mm)), ordered)):
        assert [line.layer for line in found] == [one.layer for one in expected]
        for line, one in zip(found, expected, strict=True):
            assert line.points_mm == pytest.approx(drawn(one), abs=1e-3)


@settings(deadline=None)
@given(st.lists(path, min_size=1, max_size=5), st.sampled_from([None, 0.2]))
def test_gcode_reads_back_to_the_same_polylines(paths: list[CutPath], longest_s: float | None) -> None:
    long = [one for one in paths if np.ptp(one.points_mm, axis=0).max() > 0.01]
    lines = gcode(long, PRESETS, GcodeOptions(longest_move_s=longest_s))
    found, faults = read_gcode(lines)
    assert not faults
    assert max(map(len, lines)) <= LINE_LIMIT
    assert len(found) == len(long)
    for line, one in zip(found, long, strict=True):
        whole = drawn(one)
        assert line[[0, -1]] == pytest.approx(whole[[0, -1]], abs=1e-3)
        for point in whole:
            assert np.linalg.norm(line - point, axis=1).min() <= 1e-3


def test_long_cuts_are_split_so_that_none_burns_longer_than_asked() -> None:
    stroke = CutPath("slit", np.array([[0.0, 0.0], [100.0, 0.0]]))
    (line,), _ = read_gcode(gcode([stroke], PRESETS, GcodeOptions(longest_move_s=0.2)))
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 0.2 * PRESETS["slit"].feed_mm_s + 1e-3


def test_power_and_speed_ride_on_the_first_cut_of_a_layer_and_the_beam_ends_off() -> None:
    strokes = [
        CutPath("mark", np.array([[0.0, 0.0], [1.0, 0.0]])),
        CutPath("slit", np.array([[5.0, 0.0], [5.0, 0.0]])),  # nothing to cut: must not swallow the power
        CutPath("slit", np.array([[2.0, 0.0], [3.0, 0.0]])),
        CutPath("slit", np.array([[4.0, 0.0], [5.0, 0.0]])),
    ]
    lines = gcode(strokes, PRESETS, GcodeOptions(s_max_count=255))
    assert [line for line in lines if "S" in line] == ["M4S0", "G1X1Y0F1260S51", "G1X3Y0F1380S102"]
    assert lines[-len(END) :] == END
    assert not any("M3" in line or "$" in line or "G10" in line or "G28" in line for line in lines)


def test_remarks_cannot_smuggle_commands_and_stay_short() -> None:
    lines = gcode([], PRESETS, remarks=["$RST=* (!) \x18?" + 100 * "x"])
    assert lines[0].startswith(";")
    assert len(lines[0]) <= LINE_LIMIT
    assert not set(lines[0]) & set("$!?()\x18")


def test_a_layer_without_a_preset_and_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(DesignError, match="slit"):
        gcode([CutPath("slit", np.zeros((2, 2)))], {})
    with pytest.raises(DesignError, match="nan"):
        gcode([CutPath("slit", np.array([[0, 0], [np.nan, 1]]))], PRESETS)


def test_dxf_is_r2010_in_mm_with_a_layer_for_each_way_of_cutting() -> None:
    import ezdxf

    text = dxf([CutPath("slit", np.array([[0.0, 0.0], [1.0, 1.0]]))], SIZE_mm)
    document = ezdxf.read(io.StringIO(text))
    assert document.acad_release == "R2010"
    assert document.header["$INSUNITS"] == 4
    assert {layer.upper() for layer in LAYERS} <= {layer.dxf.name for layer in document.layers}
    assert not document.audit().has_errors
    assert text == dxf([CutPath("slit", np.array([[0.0, 0.0], [1.0, 1.0]]))], SIZE_mm)


def test_a_drawing_survives_its_json() -> None:
    drawing = Drawing(
        SIZE_mm, (CutPath("slit", np.array([[0.1, 0.2], [3, 4]]), cell=7, opens=True),), Anchor(1, 2, 3, 4)
    )
    again = from_json(as_json(drawing))
    assert (again.size_mm, again.id_anchor) == (drawing.size_mm, drawing.id_anchor)
    assert again.paths[0].points_mm == pytest.approx(drawing.paths[0].points_mm)
    assert (again.paths[0].cell, again.paths[0].opens) == (7, True)


@pytest.mark.parametrize("change", [{"format": 2}, {"sheet_mm": [1]}, {"paths": [{"layer": "burn"}]}, {"paths": 3}])
def test_paths_that_are_not_ours_are_refused(change: dict) -> None:
    with pytest.raises(DesignError):
        from_json({**as_json(Drawing(SIZE_mm, ())), **change})


def test_no_two_letters_look_alike_and_text_keeps_to_its_place() -> None:
    shapes = {glyph: letter for letter, glyph in GLYPHS.items()}
    assert len(shapes) == len(GLYPHS)
    strokes = text_strokes("s-0042", Anchor(50, 20, 3, 100))
    low = np.min([stroke.points_mm.min(axis=0) for stroke in strokes], axis=0)
    high = np.max([stroke.points_mm.max(axis=0) for stroke in strokes], axis=0)
    assert high - low == pytest.approx([text_width_mm("S-0042", 3), 3], abs=0.51)
    assert (low + high) / 2 == pytest.approx([50, 20], abs=0.3)
    narrow = text_strokes("S-0042", Anchor(50, 20, 3, 5))
    assert np.ptp(np.vstack([stroke.points_mm for stroke in narrow])[:, 0]) <= 5
    with pytest.raises(DesignError, match="no letter"):
        text_strokes("Ω", Anchor(0, 0, 1, 1))


def test_a_job_engraves_the_id_first_and_cuts_the_outline_last() -> None:
    square = CutPath("outline", np.array([[0.0, 0], [50, 0], [50, 50], [0, 50]]), closed=True)
    slit = CutPath("slit", np.array([[10.0, 10], [15, 12], [20, 10]]))
    drawing = Drawing((60, 60), (square, slit), Anchor(25, 40, 3, 30))
    job = compose_job(drawing, PRESETS, JobOptions(machine=GcodeOptions(origin_mm=(5.0, 7.0))), "S-0001")
    layers = [stroke.layer for stroke in job.strokes]
    assert layers == sorted(layers, key=LAYERS.index)
    assert layers[0] == "engrave"
    found, faults = read_gcode(job.lines)
    assert not faults
    assert len(found) == len(job.strokes)
    everything = np.vstack(found)
    assert everything.min(axis=0) == pytest.approx(job.bounds_mm[:2], abs=1e-3)
    assert everything.max(axis=0) == pytest.approx(job.bounds_mm[2:], abs=1e-3)
    assert job.time_s > job.cut_mm / max(preset.feed_mm_s for preset in PRESETS.values())


def test_an_id_without_a_place_is_refused() -> None:
    with pytest.raises(DesignError, match="no place"):
        compose_job(Drawing((60, 60), ()), PRESETS, id_text="S-0001")
