"""The indentation room end to end: command line, simulated rig, records, analysis, exports, calibration, kills."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks._rig_kill import kill_while_loading
from design.meshfiles import write_ply
from design.surface import TriMesh
from fabctl.indent.export import documents, export
from fabctl.indent.resume import points_without_contact
from fabctl.records.folder import open_run, status_of
from fabctl.testing import SimulatedBench
from fabctl.workspace import Workspace
from tests.rig_endpoints import rig_bench, short_method, simulated_rig

STIFFNESS_N_MM = 0.2
METHOD = short_method(
    "step: approach, speed_mm_s: 6, trigger_N: 0.01, clearance_mm: 0.8",
    "step: cycles, cycles_count: 2, depth_mm: 2.6, speed_mm_s: 2, unload_speed_mm_s: 6",
)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedBench]:
    """Return a lab with one specimen that is a spring, and a simulated rig with a frame that gives."""
    home = tmp_path_factory.mktemp("lab")
    design = home / "design"
    design.mkdir()
    rows = "".join(f"{d},{STIFFNESS_N_MM * d},{STIFFNESS_N_MM * d}\n" for d in (0, 5, 10))
    head = "# fabctl response 1; indenter_radius_mm=8; point_mm=0,0,0; direction=0,0,-1\ndepth_mm,load_N,unload_N\n"
    (design / "response.csv").write_text(head + rows)
    (design / "deployed.ply").write_text("ply\n")
    lab = Workspace(home)
    lab.new_specimen(design)
    (home / "short.yaml").write_text(METHOD)
    slot = home / "slot"
    slot.mkdir()
    words = ("--tcp", "0", "--slot", str(slot), "--truth", str(home / "truth"), "--compliance-mm-N", "0.3")
    with simulated_rig(*words, "--gain", "1.02", "--noise-N", "0.0005") as url:
        (home / "bench.yaml").write_text(rig_bench(url, slot=str(slot)) + "simulated: true\n")
        yield SimulatedBench(lab, {"rig": url})


@pytest.fixture(scope="module")
def tested(bench: SimulatedBench) -> dict[str, object]:
    """Calibrate cell and frame, then test the specimen; return the test's JSON."""
    bench.fabctl(
        "rig",
        "calibrate",
        "force",
        "--bench",
        "bench.yaml",
        "--yes",
        "--mass-g",
        "0",
        "--mass-g",
        "100",
        "--mass-g",
        "200",
    )
    bench.fabctl("rig", "calibrate", "frame", "--bench", "bench.yaml", "--yes", "--force-N", "4")
    words = ("indent", "run", "S-0001", "--method", "short.yaml", "--bench", "bench.yaml", "--yes")
    return bench.fabctl(*words, "--batch", "B7", "--rest-h", "24")


def test_gain_and_frame_are_calibrated_to_their_true_values(bench: SimulatedBench, tested: dict[str, object]) -> None:
    found = json.loads((bench.lab.root / "calibrations" / "short.json").read_text())
    assert found["gain_ratio"] == pytest.approx(1.02, abs=max(4 * found["gain_se_ratio"], 5e-4))
    assert found["compliance_mm_N"] == pytest.approx(0.3, abs=0.002)


def test_calibrations_on_simulators_are_listed_as_simulated(bench: SimulatedBench, tested: dict[str, object]) -> None:
    listed = {row["kind"]: row["simulated"] for row in bench.fabctl("run", "list")["runs"]}
    assert listed == {"calibrate": True, "indent": True}


def test_the_stiffness_comes_out_with_gain_and_frame_taken_off(tested: dict[str, object]) -> None:
    # Without them it would read 1.02/(1 + 0.3·0.2)-fold.
    assert tested["stiffness_secant_N_mm"] == pytest.approx(STIFFNESS_N_MM, rel=0.012)
    assert tested["predicted_secant_N_mm"] == pytest.approx(STIFFNESS_N_MM, rel=1e-6)
    assert tested["curves_count"] == 2
    assert tested["hysteresis_ratio"] == pytest.approx(0.06, abs=0.03)


def test_the_run_keeps_method_calibration_and_conditions(bench: SimulatedBench, tested: dict[str, object]) -> None:
    config = open_run(bench.lab.runs / str(tested["run"])).manifest()["config"]
    assert config["method"]["name"] == "short"
    assert config["calibration"]["gain_ratio"] == pytest.approx(1.02, abs=2e-3)
    assert config["conditions"]["temperature_degC"] == pytest.approx(22.5)
    assert (config["conditions"]["batch"], config["conditions"]["rest_h"]) == ("B7", 24.0)
    (told,) = [f for f in config["findings"] if f["code"] == "INDENT-CONDITIONS"]
    assert told["message"] == "not recorded: the sheet's thickness"
    assert config["rig"]["firmware"] == "1.04"


@pytest.mark.parametrize("kind", ["csv", "parquet", "hdf5", "bluesky"])
def test_every_export_holds_every_row(
    bench: SimulatedBench, tested: dict[str, object], kind: str, tmp_path: Path
) -> None:
    run = open_run(bench.lab.runs / str(tested["run"]))
    path = tmp_path / f"samples.{kind}"
    assert export(run, kind, path)["rows_count"] == tested["rows_count"]
    own = [float(line.split(",")[4]) for line in (run.path / "samples.csv").read_text().splitlines()[1:]]
    if kind == "csv":
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        assert lines[1].split(",")[4] == "N"
        forces = [float(line.split(",")[4]) for line in lines[2:]]
    elif kind == "parquet":
        import pyarrow.parquet as pq

        forces = pq.read_table(path)["force_N"].to_pylist()
        assert pq.read_schema(path).field("force_N").metadata[b"unit"] == b"N"
    elif kind == "hdf5":
        import h5py

        with h5py.File(path) as file:
            forces = list(file["samples/force_N"])
            assert file["samples/force_N"].attrs["unit"] == "N"
    else:
        pages = [json.loads(line) for line in path.read_text().splitlines()]
        forces = next(document for name, document in pages if name == "event_page")["data"]["force_N"]
    np.testing.assert_allclose(forces, own)


def test_the_documents_are_valid_for_the_real_event_model(bench: SimulatedBench, tested: dict[str, object]) -> None:
    event_model = pytest.importorskip("event_model")
    from fabctl.indent.export import _columns

    run = open_run(bench.lab.runs / str(tested["run"]))
    names = []
    for name, document in documents(run, _columns(run)):
        event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
        names.append(name)
    assert names == ["start", "descriptor", "event_page", "stop"]


def test_a_run_that_is_analysed_anew_says_the_same(bench: SimulatedBench, tested: dict[str, object]) -> None:
    again = bench.fabctl("indent", "analyse", str(tested["run"]))
    result = again["groups"][tested["run"]]["runs"][0]["result"]
    assert result["stiffness_secant_N_mm"] == tested["stiffness_secant_N_mm"]


def test_a_method_beyond_the_limits_is_refused_before_anything_moves(bench: SimulatedBench) -> None:
    deep = METHOD.replace("depth_mm: 2.6", "depth_mm: 26")
    (bench.lab.root / "deep.yaml").write_text(deep.replace("force_N: 4,", "force_N: 1.5,"))
    before = (bench.lab.root / "truth" / "rig-events.jsonl").read_text()
    bench.fabctl("indent", "run", "S-0001", "--method", "deep.yaml", "--bench", "bench.yaml", "--yes", expect=3)
    assert (bench.lab.root / "truth" / "rig-events.jsonl").read_text() == before


GRID_STEPS = (
    "step: tare, time_s: 0.3",
    "step: approach, speed_mm_s: 8, trigger_N: 0.01, clearance_mm: 0.8, travel_mm: 12",
    "step: cycles, cycles_count: 1, depth_mm: 2.8, speed_mm_s: 2, unload_speed_mm_s: 6",
)
GRID = f"step: grid, x_mm: [X], y_mm: [0], speed_mm_s: 20, steps: [{', '.join(f'{{{step}}}' for step in GRID_STEPS)}]"


def test_a_grid_point_beside_the_specimen_is_told_in_the_result_and_the_others_are_measured(
    bench: SimulatedBench,
) -> None:
    design = bench.lab.root / "plate"
    design.mkdir()
    shutil.copy(bench.lab.root / "design" / "response.csv", design)
    corners = np.array([[-20.0, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]])
    write_ply(design / "deployed.ply", TriMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
    specimen = bench.lab.new_specimen(design).name
    (bench.lab.root / "two.yaml").write_text(short_method(GRID.replace("X", "0, 60"), name="two"))
    (bench.lab.root / "beside.yaml").write_text(short_method(GRID.replace("X", "60"), name="beside"))
    words = ("indent", "run", specimen, "--bench", "bench.yaml", "--yes", "--method")
    found = bench.fabctl(*words, "two.yaml")
    assert found["status"] == "done"
    assert [(curve["point"], curve["curve"]) for curve in found["curves"]] == [(1, 1)]
    assert found["stiffness_secant_N_mm"] == pytest.approx(STIFFNESS_N_MM, rel=0.1)
    (without,) = found["points_without_contact"]
    assert (without["point"], without["at_mm"]) == (2, [60.0, 0.0])
    assert "INDENT-POINT-NO-CONTACT" in [finding["code"] for finding in found["findings"]]
    assert points_without_contact(open_run(bench.lab.runs / str(found["run"]))) == [2]
    bench.fabctl(*words, "beside.yaml", expect=3)
    (run,) = [one for one in bench.lab.runs_of(specimen, "indent") if one.run_id != found["run"]]
    assert status_of(run) == "failed"


def test_a_killed_host_leaves_a_stage_that_stops_and_every_acknowledged_row(tmp_path: Path) -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    found = kill_while_loading(tmp_path, 2)
    assert found.not_stopped_count == 0
    assert found.rows_lost_count == 0
    assert len(found.stop_ms) == 2
    assert max(found.stop_ms) <= 250
    assert max(found.overshoot_N) <= found.overshoot_allowed_N
