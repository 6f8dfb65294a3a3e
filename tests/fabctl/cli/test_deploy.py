"""`fabctl deploy` takes a design folder and tells what pops up."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from design.bundle import open_bundle
from design.cells.hinges import cells_as_cut
from design.errors import BundleError
from design.meshfiles import read_mesh
from fabctl.cli.deploy import command
from fabctl.deploying import divided, farthest_mm, read_laid, wells_of
from fabctl.designing import build_compensated, build_folder, design_of, read_inputs
from fabctl.errors import RefusedError


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("lab")
    build_folder("cap", home / "cap", home, cell_mm=20.0)
    return home / "cap"


def test_a_design_folder_gives_back_the_shell_it_was_built_with(folder: Path) -> None:
    laid = read_laid(folder, folder.parent)
    facts = open_bundle(folder).manifest["facts"]
    assert facts["residual_ratio"] < 1e-8
    assert facts["response_residual_ratio"] < 1e-8
    assert facts["smallest_eigenvalue_N_mm"] > 0 == facts["response_unstable_count"]
    assert laid.layout.edge_mm == pytest.approx(20.0, abs=1e-4)
    assert laid.design_mm is not None
    assert np.linalg.norm(laid.start_mm - laid.design_mm, axis=1).mean() < 4.0
    assert laid.layout.Y_N_mm.min() > 0


def test_deploying_a_design_writes_shape_pictures_and_numbers(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "popped"
    words = [str(folder), "--gravity", "--support", "held", "--json", "-o", str(out)]
    ran = CliRunner().invoke(command, words, obj=str(folder.parent), catch_exceptions=False)
    assert ran.exit_code == 0
    told = json.loads(ran.stdout)
    assert told["stable"] is True
    assert told["smallest_eigenvalue_N_mm"] > 0
    assert told["residual_ratio"] < 1e-8
    assert told["loaded_residual_ratio"] < 1e-8
    assert 0 < told["sag_mm"] < 5
    laid = read_laid(folder, folder.parent)
    shown = read_mesh(out / "deployed.ply")[0]
    assert farthest_mm(shown, laid.target).max() == pytest.approx(told["loaded_deviation_max_mm"], abs=1e-3)
    assert told["loaded_deviation_mean_mm"] < told["loaded_deviation_max_mm"]
    assert {p.name for p in out.iterdir()} == {"deployed.ply", "deployed.png", "deployment.gif", "deploy.json"}
    assert len(read_mesh(out / "deployed.ply")[0].faces) == told["units_count"]
    assert (out / "deployment.gif").read_bytes()[:4] == b"GIF8"


def test_a_folder_that_was_edited_is_refused(folder: Path) -> None:
    cells = folder / "cells.csv"
    before = cells.read_bytes()
    try:
        cells.write_bytes(before + b"\n")
        with pytest.raises(BundleError):
            read_laid(folder, folder.parent)
    finally:
        cells.write_bytes(before)


def test_cells_that_do_not_stay_open_are_solid_as_in_the_builds_prediction(tmp_path: Path) -> None:
    text = "name: x\ntarget: {make: cap, radius_mm: 40, edge_mm: 4}\nresponse: {steps_count: 4, depth_mm: 2}\n"
    regions = "monostable: [{x_mm: 0, y_mm: 0, radius_mm: 12}]\npassive: [{x_mm: 0, y_mm: 0, radius_mm: 7}]\n"
    (tmp_path / "x.yaml").write_text(text + regions)
    design, _ = build_folder(str(tmp_path / "x.yaml"), tmp_path / "x", tmp_path)
    laid = read_laid(tmp_path / "x", tmp_path)
    closed = np.array([kind != "cut" for kind in design.cells.kind])
    assert {"passive", "monostable"} <= set(design.cells.kind)
    assert (laid.layout.expansion_ratio[closed] == 1).all()
    assert (laid.layout.expansion_ratio[~closed] > 1.1).all()
    solid_N_mm = laid.sheet.E_MPa * laid.sheet.thickness_mm
    assert laid.layout.Y_N_mm[closed] == pytest.approx(solid_N_mm)
    assert (laid.layout.Y_N_mm[~closed] < solid_N_mm).all()


def test_a_compensated_folder_is_nearer_to_its_target_and_says_so(tmp_path: Path) -> None:
    text = "name: x\ntarget: {make: cap, radius_mm: 60, edge_mm: 5}\nresponse: {steps_count: 4, depth_mm: 2}\n"
    (tmp_path / "x.yaml").write_text(text)
    plain, _ = build_folder(str(tmp_path / "x.yaml"), tmp_path / "x", tmp_path)
    words = [str(tmp_path / "x"), "--compensate", "--no-animation", "--json", "-o", str(tmp_path / "popped")]
    ran = CliRunner().invoke(command, words, obj=str(tmp_path), catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)["compensated"]
    assert plain.predicted is not None
    assert told["points_rms_mm"] < 0.9 * plain.predicted.deployed.deviation.points_rms_mm
    assert "before" in told["told"]
    folder = Path(told["folder"])
    assert "compensate: true" in (folder / "spec.yaml").read_text()
    assert read_laid(folder, tmp_path).layout.expansion_ratio == pytest.approx(
        read_laid(tmp_path / "x", tmp_path).layout.expansion_ratio, abs=0.2
    )
    with pytest.raises(BundleError, match="exists already"):
        build_compensated(open_bundle(tmp_path / "x"), folder, tmp_path)


def test_a_sheet_is_compensated_under_its_weight_on_its_rim(tmp_path: Path) -> None:
    text = "name: x\ntarget: {make: cap, radius_mm: 60, edge_mm: 5}\nresponse: {steps_count: 4, depth_mm: 2}\n"
    (tmp_path / "x.yaml").write_text(text)
    build_folder(str(tmp_path / "x.yaml"), tmp_path / "x", tmp_path)
    words = [str(tmp_path / "x"), "--gravity", "--support", "held", "--compensate", "--no-animation", "--json"]
    ran = CliRunner().invoke(command, words, obj=str(tmp_path), catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)["compensated"]["told"]
    before_mm, after_mm = (float(number) for number in re.findall(r"([\d.]+) mm", told)[:2])
    assert told.startswith("under its weight, rim held: ")
    assert after_mm < before_mm / 3
    assert "compensate: held" in (tmp_path / "x-compensated" / "spec.yaml").read_text()


def test_units_may_be_divided_into_several_triangles(folder: Path) -> None:
    laid = read_laid(folder, folder.parent)
    fine = divided(laid, 2)
    assert len(fine.layout.cells) == 4 * len(laid.layout.cells)
    assert fine.design_mm is not None
    assert fine.design_mm[: len(laid.start_mm)] == pytest.approx(laid.design_mm, abs=1e-5)  # cells.csv is rounded
    words = [str(folder), "--parts", "2", "--no-animation", "--json", "-o", str(folder.parent / "fine")]
    ran = CliRunner().invoke(command, words, obj=str(folder.parent), catch_exceptions=False)
    told = json.loads(ran.stdout)
    assert told["units_count"] == len(laid.layout.cells)
    assert told["triangles_count"] == 4 * told["units_count"]
    assert told["residual_ratio"] < 1e-8
    refused = CliRunner().invoke(command, [*words, "--cascade"], obj=str(folder.parent))
    assert refused.exit_code == 2


def test_a_vase_with_its_seam_joined_is_deployed_and_stands_on_its_foot(tmp_path: Path) -> None:
    text = "name: v\ntarget: {make: vase, radius_mm: 30, height_mm: 80}\ncell_mm: 14\n"
    (tmp_path / "v.yaml").write_text(text + "response: {steps_count: 4, depth_mm: 1}\n")
    design, _ = build_folder(str(tmp_path / "v.yaml"), tmp_path / "v", tmp_path)
    assert design.predicted is not None
    laid = read_laid(tmp_path / "v", tmp_path)
    assert laid.layout.rejoined_count() > 3
    assert laid.design_mm is not None
    assert np.linalg.norm(laid.start_mm - laid.design_mm, axis=1).max() < 6.0
    words = [
        str(tmp_path / "v"),
        "--gravity",
        "--support",
        "no-slip",
        "--no-animation",
        "--json",
        "-o",
        str(tmp_path / "popped"),
    ]
    ran = CliRunner().invoke(command, words, obj=str(tmp_path), catch_exceptions=False)
    told = json.loads(ran.stdout)
    assert told["energy_mJ"] == pytest.approx(design.predicted.deployed.equilibrium.energy_mJ, rel=1e-3)
    assert 0 < told["standing_count"] < laid.layout.rejoined_count() * 4
    assert 0 < told["sag_mm"] < 5
    with pytest.raises(RefusedError) as refused:
        wells_of(laid)
    assert [finding.code for finding in refused.value.findings] == ["CASCADE-SEAM"]
    assert design.predicted.response.stiffness_N_mm(1.0) < 1.0  # the lip gives way, only the foot is held


def test_a_sheet_that_compensation_does_not_help_is_refused(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("design.compensated.HELPS_RATIO", 0.0)
    text = "name: x\ntarget: {make: cap, radius_mm: 60, edge_mm: 5}\nresponse: {steps_count: 4, depth_mm: 2}\n"
    (tmp_path / "x.yaml").write_text(text)
    _, bundle = build_folder(str(tmp_path / "x.yaml"), tmp_path / "x", tmp_path)
    with pytest.raises(RefusedError) as refused:
        build_compensated(bundle, tmp_path / "y", tmp_path)
    assert [finding.code for finding in refused.value.findings] == ["COMPENSATE-NOT"]
    assert not (tmp_path / "y").exists()


@pytest.mark.parametrize("kind", ["hinge: {rule: widening}", "cells: contracting\ncell_mm: 18"])
def test_other_cells_are_compensated_with_what_they_are_cut_as(tmp_path: Path, kind: str) -> None:
    text = "name: x\ntarget: {make: cap, radius_mm: 60, edge_mm: 5}\nresponse: {steps_count: 4, depth_mm: 1}\n"
    (tmp_path / "x.yaml").write_text(text + kind + "\ncompensate: true\n")
    design = design_of(read_inputs(str(tmp_path / "x.yaml"), tmp_path, None, None))
    assert "COMPENSATED" in [finding.code for finding in design.findings]
    assert design.predicted is not None
    assert design.predicted.deployed.deviation.points_rms_mm < 0.15  # 0.4 to 0.7 mm without
    choice, hinge = design.cells.choice, design.cells.hinge_mm
    if "widening" in kind:  # a cell's hinge, cut, must be the one that its t and angle were chosen with
        library = read_inputs(str(tmp_path / "x.yaml"), tmp_path, None, None).library
        as_they_are = cells_as_cut(library, choice.t_mm, choice.theta_rad, hinge)["expansion_ratio"]
        assert as_they_are == pytest.approx(choice.expansion_ratio, abs=2e-3)


def test_the_published_rule_says_why_it_is_not_compensated(tmp_path: Path) -> None:
    text = "name: x\ntarget: {make: cap, radius_mm: 60, edge_mm: 5}\nselection: {rule: published}\n"
    (tmp_path / "x.yaml").write_text(text + "cell_mm: 20\ncompensate: true\n")
    design = design_of(read_inputs(str(tmp_path / "x.yaml"), tmp_path, None, None))
    told = [finding.message for finding in design.findings if finding.code == "COMPENSATE-NOT"]
    assert len(told) == 1
    assert "published rule" in told[0]


def test_contracting_cells_are_not_opened_unit_by_unit(tmp_path: Path) -> None:
    text = "name: x\ntarget: {make: cap, radius_mm: 60, edge_mm: 5}\ncells: contracting\ncell_mm: 20\n"
    (tmp_path / "x.yaml").write_text(text + "response: {steps_count: 4, depth_mm: 1}\n")
    build_folder(str(tmp_path / "x.yaml"), tmp_path / "x", tmp_path)
    laid = read_laid(tmp_path / "x", tmp_path)
    assert (laid.layout.expansion_ratio < 1).all()
    with pytest.raises(RefusedError) as refused:
        wells_of(laid)
    assert [finding.code for finding in refused.value.findings] == ["CASCADE-CLOSING"]


def test_a_design_is_opened_unit_by_unit(folder: Path, tmp_path: Path) -> None:
    words = [str(folder), "--cascade", "--json", "-o", str(tmp_path)]
    ran = CliRunner().invoke(command, words, obj=str(folder.parent), catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    way = told["cascade"]
    assert way["residual_ratio"] < 1e-8
    assert 0 < way["open_count"] <= told["units_count"]
    assert len((tmp_path / "cascade.csv").read_text().splitlines()) == 1 + way["pulled_count"] - len(way["failed"])
    assert (tmp_path / "cascade.gif").read_bytes()[:4] == b"GIF8"
