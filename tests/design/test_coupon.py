"""The coupon: uniform patches that say what they are when they have left the sheet, in a folder that is cut."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from design.bundle import Bundle, open_bundle, write_coupon_bundle
from design.cells.library import load_library
from design.cells.select import select
from design.cells.sheet import Sheet
from design.coupon import Coupon, coupon, coupon_csv
from design.errors import BundleError, DesignError
from design.job import compose_job
from design.pattern.drawing import as_json, from_json
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.toolpath import ToolOptions, strokes_of
from design.preview import coupon_png, draw_gauge

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
COLUMNS, ROWS = 3, 2


@pytest.fixture(scope="module")
def made() -> Coupon:
    cell = select(load_library(), np.array([1.5]))
    return coupon(float(cell.t_mm[0]), float(cell.theta_rad[0]), [0.25, 0.4], Sheet(), (COLUMNS, ROWS))


@pytest.fixture
def folder(made: Coupon, tmp_path: Path) -> Bundle:
    job = compose_job(made.drawing, PRESETS)
    return write_coupon_bundle(made, job, "hinges_mm: [0.25, 0.4]\n", "key", 10.0, tmp_path / "coupon")


def test_a_coupon_is_uniform_but_for_its_hinges_and_wider_hinges_expand_less(made: Coupon) -> None:
    a, b = made.patches
    assert a.expansion_ratio == pytest.approx(1.5, abs=0.002)  # the library's own hinge
    assert b.expansion_ratio is not None
    assert b.expansion_ratio < a.expansion_ratio - 0.01
    outlines = [path.points_mm for path in made.drawing.paths if path.layer == "outline"]
    assert len(outlines) == 2
    assert np.ptp(outlines[0], axis=0) == pytest.approx(np.ptp(outlines[1], axis=0))
    assert coupon_csv(made.patches).splitlines()[-2].startswith("A,0.2500,1.5")
    points = np.vstack([path.points_mm for path in made.drawing.paths])
    assert (points >= 0).all()
    assert (points <= made.drawing.size_mm).all()
    assert len(strokes_of(made.drawing.paths, ToolOptions())) == len(made.drawing.paths)


def test_the_length_to_measure_lies_between_the_notches_of_both_borders(made: Coupon) -> None:
    tiling = made.tilings[0]
    middle = np.unique(tiling.vertices_mm[:, 1].round(6))[1]  # the row of corners between the two rows of cells
    x = tiling.vertices_mm[np.isclose(tiling.vertices_mm[:, 1], middle), 0]
    assert np.ptp(x) == pytest.approx(made.patches[0].gauge_mm) == COLUMNS * 10
    assert made.patches[0].notches_mm == pytest.approx(np.array([[x.min(), middle], [x.max(), middle]]))


def test_the_picture_names_both_notches_of_every_patch(made: Coupon, monkeypatch: pytest.MonkeyPatch) -> None:
    named: dict[str, tuple[float, float]] = {}

    def note(_axes: Axes, text: str, xy: tuple[float, float], *_words: object, **_more: object) -> None:
        named[text] = xy

    monkeypatch.setattr(Axes, "annotate", note)
    assert coupon_png(made).startswith(b"\x89PNG")
    assert list(named) == ["A1", "A2", "B1", "B2"]
    for patch in made.patches:
        assert [named[f"{patch.label[0]}{k}"] for k in (1, 2)] == pytest.approx(patch.notches_mm)


def test_the_names_of_notches_lie_inside_their_patch(made: Coupon) -> None:
    axes = Figure(figsize=(7.5, 4)).add_subplot()
    axes.set(xlim=(0, made.drawing.size_mm[0]), ylim=(0, made.drawing.size_mm[1]), aspect="equal")
    for patch in made.patches:
        draw_gauge(axes, patch)
    FigureCanvasAgg(axes.figure).draw()
    for patch, names in zip(made.patches, (axes.texts[:2], axes.texts[2:]), strict=True):
        low, high = axes.transData.transform(patch.notches_mm)[:, 0]
        assert all(low < box.x0 and box.x1 < high for box in (name.get_window_extent() for name in names))


def test_every_patch_carries_its_letter_and_the_id_on_a_tag_of_its_own(made: Coupon) -> None:
    pieces = [shapely.Polygon(p.points_mm) for p in made.drawing.paths if p.layer == "outline"]
    bare, told = (
        [shapely.LineString(s.points_mm) for s in compose_job(made.drawing, PRESETS, id_text=name).strokes
         if s.layer == "engrave"]
        for name in ("", "S-0001")
    )  # fmt: skip
    assert len(told) > len(bare) > 0
    for piece in pieces:
        added = sum(piece.contains(line) for line in told) - sum(piece.contains(line) for line in bare)
        assert added == (len(told) - len(bare)) / 2
    assert all(any(piece.contains(line) for piece in pieces) for line in told)
    assert from_json(json.loads(json.dumps(as_json(made.drawing)))).more_ids == made.drawing.more_ids


def test_the_form_may_be_filled_in_but_nothing_else_of_the_folder_changed(folder: Bundle) -> None:
    assert folder.kind == "coupon"
    (folder.path / "coupon.csv").write_text("filled in")
    assert open_bundle(folder.path).drawing().size_mm == folder.drawing().size_mm
    with pytest.raises(BundleError, match=r"this coupon has no target\.ply"):
        folder.file("target.ply")
    rows = list(csv.DictReader((folder.path / "cells.csv").read_text().splitlines()))
    assert {row["hinge_mm"] for row in rows} == {"0.250000", "0.400000"}
    (folder.path / "cut.nc").write_text("M4S1000")
    with pytest.raises(BundleError, match=r"cut\.nc"):
        open_bundle(folder.path)


def test_a_folder_of_an_unknown_kind_is_refused(folder: Bundle) -> None:
    path = folder.path / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"kind": "kite"}))
    with pytest.raises(BundleError, match="kite"):
        open_bundle(folder.path)


@pytest.mark.parametrize("hinges", [[], [9.0], [0.25, 9.0], [0.25] * 27])
def test_hinges_that_leave_no_slit_or_no_letter_are_refused(hinges: list[float]) -> None:
    cell = select(load_library(), np.array([1.5]))
    with pytest.raises(DesignError):
        coupon(float(cell.t_mm[0]), float(cell.theta_rad[0]), hinges, Sheet(), (COLUMNS, ROWS))


def test_a_coupon_tells_which_hinge_is_being_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("design.coupon.solve_cell", lambda *_: SimpleNamespace(expansion_ratio=1.5))
    told: list[tuple[str, float]] = []
    cell = select(load_library(), np.array([1.5]))
    place = float(cell.t_mm[0]), float(cell.theta_rad[0])
    coupon(*place, [0.25, 0.4], Sheet(), (COLUMNS, ROWS), watch=lambda *event: told.append(event))
    assert [done_frac for _, done_frac in told] == [0.0, 0.5]
    assert "0.4 mm" in told[1][0]


def test_a_sheet_that_there_is_not_is_told_with_those_there_are(folder: Bundle) -> None:
    with pytest.raises(BundleError, match="there is no sheet 2; this coupon is one sheet"):
        folder.drawing(2)
