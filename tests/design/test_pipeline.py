"""From a surface to a design folder: scale, placement, consistency of the files, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design.bundle import open_bundle, write_bundle
from design.cells.library import load_library
from design.cells.select import selection_curve
from design.errors import BundleError, DesignError, OutOfLibrary
from design.pattern.assign import ScaleOptions
from design.pattern.border import BorderOptions
from design.pattern.paths import LAYERS, LayerPreset
from design.pipeline import Design, build
from design.spec import DesignSpec, ResponseOptions
from design.surface import TriMesh
from design.targets import cap, spike

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}
SPEC = DesignSpec("cap", cell_mm=10.0, response=None, placement="centred")


@pytest.fixture(scope="module")
def design() -> Design:
    spec = replace(SPEC, response=ResponseOptions(depth_mm=2.0, steps_count=4))
    return build(spec, cap(radius_mm=40, edge_mm=4), load_library(), PRESETS)


@pytest.mark.parametrize("end", ["high", "low", "middle"])
def test_the_expansions_lie_where_the_scale_wants_them(end: str) -> None:
    made = build(replace(SPEC, scale=ScaleOptions(end)), cap(edge_mm=5), load_library(), PRESETS)
    low, high = selection_curve(load_library()).range_ratio()
    wanted = made.cells.wanted_ratio
    if end == "high":
        assert wanted.max() == pytest.approx(high, abs=0.002)
    elif end == "low":
        assert wanted.min() == pytest.approx(low, abs=0.002)
    else:
        assert high / wanted.max() == pytest.approx(wanted.min() / low, abs=0.002)
    # The flat is scaled with them: area on the sheet times expansion squared is the target's area.
    a, b, c = (made.flattening.flat_mm[made.flattening.faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    flat_mm2 = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    deployed_mm2 = flat_mm2 * made.flattening.expansion_ratio**2
    assert deployed_mm2 == pytest.approx(made.mesh.face_areas_mm2())


def test_every_cell_expands_by_what_its_place_on_the_target_asks(design: Design) -> None:
    assert design.cells.choice.expansion_ratio == pytest.approx(design.cells.wanted_ratio)
    centre = np.linalg.norm(design.cells.tiling.centres_mm() - design.flattening.flat_mm.mean(axis=0), axis=1)
    order = np.argsort(centre)
    assert design.cells.wanted_ratio[order[:5]].min() > design.cells.wanted_ratio[order[-5:]].max()  # most at the apex


def test_a_surface_that_asks_for_too_much_is_refused_with_both_ranges() -> None:
    with pytest.raises(OutOfLibrary, match="the library has"):
        build(SPEC, spike(), load_library(), PRESETS)


def test_everything_lies_on_the_sheet_and_the_tag_clears_the_cells(design: Design) -> None:
    points = np.vstack([path.points_mm for path in design.drawing.paths])
    assert (points >= 0).all()
    assert (points <= design.drawing.size_mm).all()
    anchor, code = design.drawing.id_anchor, design.drawing.code_box
    assert anchor is not None
    assert code is not None
    lowest = design.cells.tiling.vertices_mm[:, 1].min()
    assert anchor.y_mm + anchor.height_mm / 2 < lowest
    assert code.y_mm + code.height_mm < anchor.y_mm - anchor.height_mm / 2


def test_the_folder_is_whole_and_says_when_it_was_edited(design: Design, tmp_path: Path) -> None:
    bundle = write_bundle(design, "name: cap\n", tmp_path / "cap")
    names = {path.name for path in bundle.path.iterdir()}
    wanted = "spec.yaml target.ply flat.ply cells.csv paths.json cut.dxf cut.svg cut.nc deployed.ply response.csv"
    assert names == {*wanted.split(), "findings.json", "preview.png", "manifest.json"}
    assert len(bundle.cells()) == len(design.cells.wanted_ratio)
    assert bundle.drawing().size_mm == design.drawing.size_mm
    (bundle.path / "cut.nc").write_text("G0X0\n")
    (bundle.path / "cells.csv").unlink()
    with pytest.raises(BundleError) as fault:
        open_bundle(bundle.path)
    assert {finding.code: finding.where for finding in fault.value.findings} == {
        "BUNDLE-EDITED": "cut.nc",
        "BUNDLE-MISSING": "cells.csv",
    }


def test_a_file_named_in_no_manifest_and_another_format_are_refused(design: Design, tmp_path: Path) -> None:
    bundle = write_bundle(design, "", tmp_path / "cap")
    manifest = bundle.path / "manifest.json"
    body = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**body, "files": {k: v for k, v in body["files"].items() if k != "paths.json"}}))
    with pytest.raises(BundleError, match=r"paths\.json"):
        open_bundle(bundle.path)
    manifest.write_text(json.dumps({**body, "format": 99}))
    with pytest.raises(BundleError, match="format"):
        open_bundle(bundle.path)
    with pytest.raises(BundleError, match="no design"):
        open_bundle(tmp_path)


def test_a_folder_is_replaced_only_when_asked_and_a_failed_write_leaves_nothing(
    design: Design, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "cap"
    first = write_bundle(design, "a: 1\n", folder)
    with pytest.raises(BundleError, match="exists"):
        write_bundle(design, "a: 2\n", folder)
    again = write_bundle(design, "a: 1\n", folder, replace=True)
    assert again.manifest["files"] == first.manifest["files"]  # the same design gives the same bytes

    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("design.bundle.svg", full)
    with pytest.raises(OSError, match="space"):
        write_bundle(design, "a: 3\n", folder, replace=True)
    assert open_bundle(folder).manifest == again.manifest
    assert [path.name for path in tmp_path.iterdir()] == ["cap"]


def test_without_a_tag_there_is_no_place_for_an_id() -> None:
    made = build(
        replace(SPEC, border=BorderOptions(id_height_mm=0)), cap(radius_mm=40, edge_mm=5), load_library(), PRESETS
    )
    assert made.drawing.id_anchor is None


def test_a_target_in_wrong_units_is_refused_before_millions_of_cells_are_laid() -> None:
    mesh = cap(edge_mm=12)
    huge = TriMesh(mesh.vertices_mm * 1000, mesh.faces)
    with pytest.raises(DesignError, match="units"):
        build(DesignSpec("huge", response=None), huge, load_library(), PRESETS)
