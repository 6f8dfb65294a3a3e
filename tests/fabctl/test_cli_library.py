"""`fabctl library` from the outside."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from design.cells.calibrate import calibrate
from design.cells.library import load_library
from design.cells.select import selection_curve
from design.errors import DesignError
from fabctl.cli.library_parts import CURVE_WHY
from fabctl.cli.main import cli
from fabctl.errors import ClusterAway, UsageError, WorkerDied


def run(*words: str, home: Path) -> Result:
    return CliRunner().invoke(cli, ["--home", str(home), "library", *words], catch_exceptions=True)


def test_show_tells_range_counts_and_reasons(tmp_path: Path) -> None:
    told = json.loads(run("show", "--json", home=tmp_path).stdout)
    assert told["cells_count"] == len(load_library())
    assert sum(told["candidates"].values()) == 7552
    assert told["command"].startswith("fabctl library build")


def test_both_ranges_are_told_with_why_they_differ_by_the_library_and_by_the_check(tmp_path: Path) -> None:
    library = load_library()
    whole, chosen = library.range_ratio(), selection_curve(library).range_ratio()
    assert json.loads(run("show", "--json", home=tmp_path).stdout)["curve_range_ratio"] == list(chosen)
    (line,) = [line for line in run("show", home=tmp_path).stdout.splitlines() if CURVE_WHY in line]
    assert f"{chosen[0]:.4f} to {chosen[1]:.4f}" in line
    check = CliRunner().invoke(cli, ["--home", str(tmp_path), "design", "check", "saddle"]).stdout.splitlines()[0]
    assert f"has {chosen[0]:.3f} to {chosen[1]:.3f}" in check
    assert f"(all its cells {whole[0]:.3f} to {whole[1]:.3f}: {CURVE_WHY})" in check


def test_cell_gives_numbers_slits_and_a_picture(tmp_path: Path) -> None:
    picture = tmp_path / "states.svg"
    told = json.loads(
        run("cell", "--t-mm", "1.2", "--theta-deg", "3", "-o", str(picture), "--json", home=tmp_path).stdout
    )
    there = load_library().at(1.2, math.radians(3))
    assert told["expansion_ratio"] == pytest.approx(float(there.expansion_ratio), abs=2e-4)
    assert told["Y_N_mm"] == pytest.approx(float(there.Y_N_mm), rel=2e-3)
    assert np.shape(told["slits_mm"]) == (3, 4, 2)
    assert "</svg>" in picture.read_text()


@pytest.mark.parametrize(
    ("t_mm", "theta_deg", "verdict"), [("3", "0", "not bistable"), ("-1", "0", "invalid"), ("1", "90", "invalid")]
)
def test_what_is_no_bistable_cell_says_why_and_ends_with_3(
    t_mm: str, theta_deg: str, verdict: str, tmp_path: Path
) -> None:
    words = ("cell", "--t-mm", t_mm, "--theta-deg", theta_deg)
    picture = tmp_path / "states.svg"
    result = run(*words, "-o", str(picture), "--json", home=tmp_path)
    told = json.loads(result.stdout)
    assert result.exit_code == run(*words, home=tmp_path).exit_code == 3
    assert told["verdict"] == verdict and told["reason"] and told["expansion_ratio"] is None
    assert not picture.exists()


def test_a_cell_for_a_person_has_the_digits_it_has(tmp_path: Path) -> None:
    result = run("cell", "--t-mm", "1.2", "--theta-deg", "3", home=tmp_path)
    assert result.exit_code == 0
    assert "expansion_ratio: 1.5263\n" in result.stdout
    assert max(len(line) for line in result.stdout.splitlines()) < 100


def test_plot_draws_the_maps(tmp_path: Path) -> None:
    picture = tmp_path / "maps.svg"
    assert run("plot", "-o", str(picture), home=tmp_path).exit_code == 0
    assert picture.read_text().count('<g id="axes_') >= 4


def test_build_makes_a_library_that_show_reads(tmp_path: Path) -> None:
    file = tmp_path / "small.npz"
    words = ("build", "--theta", "5", "--t-step-mm", "0.5", "--jobs", "1", "-o", str(file), "--json")
    first = json.loads(run(*words, home=tmp_path).stdout)
    body = file.read_bytes()
    assert first["cells_count"] > 0
    assert json.loads(run("show", "--library", str(file), "--json", home=tmp_path).stdout)["hash"] == first["hash"]
    run(*words, home=tmp_path)
    assert file.read_bytes() == body


@pytest.mark.parametrize(
    ("address", "kind", "says"),
    [
        ("nonsense", UsageError, "tcp://HOST:PORT"),
        ("tcp://127.0.0.1", UsageError, "tcp://HOST:PORT"),
        ("tcp://127.0.0.1:1", ClusterAway, "no scheduler answers"),
    ],
)
def test_a_cluster_that_is_not_there_is_told_at_once(
    address: str, kind: type[Exception], says: str, tmp_path: Path
) -> None:
    result = run("build", "--theta", "5", "--cluster", address, home=tmp_path)
    assert isinstance(result.exception, kind) and says in str(result.exception)


def test_a_worker_that_dies_is_told_and_what_is_finished_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object, **__: object) -> None:
        raise BrokenProcessPool

    monkeypatch.setattr("design.cells.sweep.sweep", killed)
    result = run("build", "--theta", "5", home=tmp_path)
    assert isinstance(result.exception, WorkerDied) and "goes on from there" in str(result.exception)


def test_compare_reports_against_a_table(tmp_path: Path) -> None:
    library = load_library()
    rows = [200, 900, 1500, 2200]
    table = tmp_path / "published.csv"
    lines = [
        f"{library.t_mm[k] / 10},{library.theta_rad[k]},{library.expansion_ratio[k]},{library.barrier_mJ[k]},"
        f"{library.stiffness_mJ[k]}"
        for k in rows
    ]
    table.write_text("\n".join(["t_over_l0,theta_rad,expansion_ratio,energy_barrier,stiffness", *lines]))
    told = json.loads(run("compare", str(table), "--jobs", "1", "--json", home=tmp_path).stdout)
    assert told["rows_count"] == 4
    assert told["solved_all"]["expansion"]["worst"] < 1e-6
    assert told["solved_all"]["stiffness"]["worst"] < 1e-6


def test_compare_names_the_rows_without_a_cell_and_why(tmp_path: Path) -> None:
    table = tmp_path / "published.csv"
    table.write_text(
        "t_over_l0,theta_rad,expansion_ratio,energy_barrier,stiffness\n0.12,0.05,1.6,20,300\n0.3,0,1.2,1,9\n"
    )
    told = json.loads(run("compare", str(table), "--jobs", "1", "--json", home=tmp_path).stdout)
    assert [(row["row"], row["verdict"]) for row in told["solved_unanswered"]] == [(2, "not bistable")]
    assert "dE/ds" in told["solved_unanswered"][0]["reason"]
    assert [row["row"] for row in told["interpolated_unanswered"]] == [2]
    assert "row 2" in run("compare", str(table), "--jobs", "1", home=tmp_path).stdout


def test_show_says_how_many_cells_were_decided_on_the_finer_mesh(tmp_path: Path) -> None:
    told = json.loads(run("show", "--json", home=tmp_path).stdout)
    count = len(load_library().shallow_cells()[0])
    assert told["shallow_count"] == count > 100
    assert f"{count} of them were decided at half the mesh size" in run("show", home=tmp_path).stdout


def test_the_command_loads_no_numpy_before_it_has_asked_for_one_thread() -> None:
    code = "import sys, fabctl.cli.library; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_a_table_without_its_columns_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "published.csv"
    table.write_text("a,b\n1,2\n")
    result = run("compare", str(table), home=tmp_path)
    assert "t_over_l0" in str(result.exception)


def test_calibrate_finds_the_modulus_of_a_stiffer_sheet(tmp_path: Path) -> None:
    depth = np.linspace(0, 4, 81)
    predicted = 0.3 * depth + 0.05 * depth**2
    response, measured = tmp_path / "response.csv", tmp_path / "samples.csv"
    rows = "\n".join(f"{d},{f},{f}" for d, f in zip(depth, predicted, strict=True))
    response.write_text(f"# fabctl response 1; indenter_radius_mm=8\ndepth_mm,load_N,unload_N\n{rows}\n")
    noise = 0.002 * np.random.default_rng(5).standard_normal(81)
    rows = "\n".join(f"{d + 0.15},{f}" for d, f in zip(depth, 1.6 * predicted + noise, strict=True))
    measured.write_text(f"depth_mm,force_N\n{rows}\n")
    told = json.loads(run("calibrate", str(measured), str(response), "--json", home=tmp_path).stdout)
    assert told["E_MPa"] == pytest.approx(1.6 * 1.5, rel=0.01)
    assert told["contact_mm"] == pytest.approx(0.15, abs=0.02)
    assert told["E_thickness_N_mm"] == pytest.approx(1.6 * 1.5 * 2.3, rel=0.01)


def rig_curves(folder: Path, points: int = 1) -> tuple[Path, Path]:
    """Write a run's curves.csv, whose first loading is stiffer and whose unloading is softer, and its prediction."""
    depth = np.linspace(0, 4, 81)
    predicted = 0.3 * depth + 0.05 * depth**2
    factors = [(1, "load", 2.0), (1, "unload", 1.0), (2, "load", 1.6), (2, "unload", 0.9)]
    rows = [
        f"{point},{curve},{branch},{d:.4f},{factor * f:.5f}"
        for point in range(points)
        for curve, branch, factor in factors
        for d, f in zip(depth, predicted, strict=True)
    ]
    measured, response = folder / "curves.csv", folder / "response.csv"
    measured.write_text("\n".join(["point,curve,branch,depth_mm,force_N", *rows]) + "\n")
    told = "\n".join(f"{d},{f}" for d, f in zip(depth, predicted, strict=True))
    response.write_text(f"depth_mm,load_N\n{told}\n")
    return measured, response


@pytest.mark.parametrize(("options", "factor"), [((), 1.6), (("--curve", "1"), 2.0)])
def test_a_rigs_curves_are_calibrated_by_one_loading_alone(
    options: tuple[str, ...], factor: float, tmp_path: Path
) -> None:
    measured, response = rig_curves(tmp_path)
    told = json.loads(run("calibrate", str(measured), str(response), *options, "--json", home=tmp_path).stdout)
    assert told["factor_ratio"] == pytest.approx(factor, rel=1e-3)
    assert told["misfit_ratio"] < 1e-3 and told["curve"].startswith("point 0, curve")


def test_of_several_points_one_must_be_named(tmp_path: Path) -> None:
    measured, response = rig_curves(tmp_path, points=2)
    assert "points 0, 1" in str(run("calibrate", str(measured), str(response), home=tmp_path).exception)
    told = run("calibrate", str(measured), str(response), "--point", "1", "--json", home=tmp_path).stdout
    assert json.loads(told)["factor_ratio"] == pytest.approx(1.6, rel=1e-3)
    result = run("calibrate", str(measured), str(response), "--point", "7", home=tmp_path)
    assert "no point 7" in str(result.exception)


def test_too_short_a_curve_calibrates_nothing() -> None:
    depth = np.linspace(0, 1, 5)
    with pytest.raises(DesignError, match="measure deeper"):
        calibrate(depth, depth, np.linspace(0, 4, 50), np.linspace(0, 4, 50))
