"""The operator's side of the rig: by hand, Ctrl-C, a killed host, and going on afterwards."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fabctl.indent.analysis import read_samples
from fabctl.records.folder import RunFolder, open_run, status_of
from fabctl.testing import SimulatedBench
from fabctl.workspace import Workspace
from tests.rig_endpoints import ROOT, rig_bench, short_method, simulated_rig

METHOD = short_method(
    "step: approach, speed_mm_s: 8, trigger_N: 0.02, clearance_mm: 0.8",
    "step: cycles, cycles_count: 2, depth_mm: 2.8, speed_mm_s: 2, unload_speed_mm_s: 6",
    watchdog_s=0.5,
)
TEST = ("indent", "run", "S-0001", "--method", "short.yaml", "--bench", "bench.yaml", "--yes")
ON = ("--bench", "bench.yaml")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[SimulatedBench]:
    """Return a lab with one specimen on a simulated rig: a spring of 0.5 N/mm from 6 mm on."""
    (tmp_path / "design").mkdir()
    lab = Workspace(tmp_path)
    lab.new_specimen(tmp_path / "design")
    (tmp_path / "short.yaml").write_text(METHOD)
    words = ("--tcp", "0", "--truth", str(tmp_path / "truth"), "--specimen", "linear", "--contact-mm", "6")
    with simulated_rig(*words, "--compliance-mm-N", "0", "--gain", "1", "--zero-N", "0.01") as url:
        (tmp_path / "bench.yaml").write_text(rig_bench(url))
        yield SimulatedBench(lab, {"rig": url})


def test_by_hand_the_stage_is_homed_jogged_to_the_first_touch_and_drawn_back(bench: SimulatedBench) -> None:
    assert bench.fabctl("rig", "info", *ON)["state"] == "disarmed"
    assert bench.fabctl("rig", "tare", *ON)["zero_N"] == pytest.approx(0.01, abs=2e-3)
    assert bench.fabctl("rig", "home", *ON, "--yes")["position_mm"] == pytest.approx(0.0, abs=0.01)
    bench.fabctl("rig", "jog", "3", *ON, expect=5)  # nobody said yes
    assert bench.fabctl("rig", "info", *ON)["position_mm"] == pytest.approx(0.0, abs=0.01)
    assert bench.fabctl("rig", "jog", "3", *ON, "--yes")["position_mm"] == pytest.approx(3.0, abs=0.01)
    assert bench.fabctl("rig", "jog", "-1", *ON, "--yes")["position_mm"] == pytest.approx(2.0, abs=0.01)
    touched = bench.fabctl("rig", "jog", "20", *ON, "--yes", "--speed-mm-s", "4")
    assert touched["force_gross_N"] == pytest.approx(1.05, abs=0.08)  # it brakes
    assert touched["position_mm"] == pytest.approx(8.1, abs=0.2)
    bench.fabctl(*TEST, expect=3)  # a test must not begin on a pressed specimen
    command = [sys.executable, "-m", "fabctl", "--home", str(bench.lab.root), "rig", "retract", *ON, "--yes"]
    drawn = subprocess.run(command, capture_output=True, text=True, cwd=bench.lab.root, env=ENVIRONMENT, check=True)
    assert "retract: at 0.000 mm" in drawn.stdout
    shares = [float(line.split("%")[0]) for line in drawn.stderr.splitlines() if "% " in line]
    assert len(shares) > 5  # eight seconds, and not in silence
    assert shares == sorted(shares)
    assert bench.fabctl("rig", "info", *ON)["position_mm"] == pytest.approx(0.0, abs=0.01)


def broken_off(bench: SimulatedBench, number: signal.Signals) -> tuple[int, RunFolder]:
    """Begin a test, send it a signal while it loads the second time; return its exit code and run."""
    command = [sys.executable, "-m", "fabctl", "--home", str(bench.lab.root), *TEST]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=bench.lab.root, env=ENVIRONMENT
    )
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("load") and "curve 2" in line:
            break
    (run,) = bench.lab.runs_of("S-0001", "indent")
    while not _pressed(run):
        time.sleep(0.02)
    process.send_signal(number)
    code = process.wait(timeout=60)
    process.stderr.close()
    return code, run


def _pressed(run: RunFolder) -> bool:
    """Tell whether the second loading has met the specimen."""
    samples = read_samples(run.path / "samples.csv")
    return bool(np.any((samples.step == "load") & (samples.curve == 2) & (samples.force_N > 0.2)))


def _standing(bench: SimulatedBench) -> dict[str, Any]:
    """Return how the rig stands once its watchdog has had its time."""
    while (found := bench.fabctl("rig", "info", *ON))["state"] == "moving":
        pass
    return found


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, "stopped"), (signal.SIGKILL, "interrupted")])
def test_a_test_that_was_broken_off_stands_where_it_is_and_goes_on_at_the_next_curve(
    bench: SimulatedBench, number: signal.Signals, status: str
) -> None:
    code, first = broken_off(bench, number)
    assert code == (5 if number == signal.SIGINT else -signal.SIGKILL)
    assert status_of(first) == status
    stands = _standing(bench)
    assert stands["position_mm"] > 5.5
    assert stands["state"] == ("disarmed" if number == signal.SIGINT else "faulted")
    told = [json.loads(row) for row in (bench.lab.root / "truth" / "rig-events.jsonl").read_text().splitlines()]
    assert [one["bit"] for one in told if one["event"] == "fault"] == ([] if number == signal.SIGINT else [2])
    bench.fabctl(*TEST, "--resume", first.run_id, expect=3)  # it stands on the specimen, or a fault is latched
    bench.fabctl("rig", "clear", *ON, "--yes")
    bench.fabctl("rig", "retract", *ON, "--yes", "--speed-mm-s", "10")

    (bench.lab.root / "short.yaml").write_text(METHOD.replace("2.8", "2.7"))
    bench.fabctl(*TEST, "--resume", first.run_id, expect=3)  # another method
    (bench.lab.root / "short.yaml").write_text(METHOD)
    found = bench.fabctl(*TEST, "--resume", first.run_id)
    second = open_run(bench.lab.runs / str(found["run"]))
    config = second.manifest()["config"]
    assert config["resumes"] == first.run_id
    assert [(a["kind"], a["curve"]) for a in config["plan"]] == [
        ("tare", 0),
        ("approach", 0),
        ("load", 2),
        ("unload", 2),
    ]
    assert [(curve["point"], curve["curve"]) for curve in found["curves"]] == [(0, 2)]
    assert found["stiffness_secant_N_mm"] == pytest.approx(0.5, rel=0.02)
    bench.fabctl(*TEST, "--resume", str(found["run"]), expect=3)  # that one came to its end
    whole = bench.fabctl("indent", "analyse", first.run_id)["groups"][first.run_id]["runs"][0]
    assert whole["status"] == status
    assert whole["result"]["stiffness_secant_N_mm"] == pytest.approx(0.5, rel=0.02)  # of what was kept


FLOW = """
import sys
from pathlib import Path
from fabctl.bench import open_bench
from fabctl.config.bench import load_bench
from fabctl.flow import runner
from fabctl.workspace import Workspace

lab = Workspace(Path(sys.argv[1]))
with open_bench(lab, load_bench("bench.yaml", lab.root), "flow") as held:
    print(runner(lab, held)(sys.argv[2:])[0])
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP])
def test_a_step_whose_flow_dies_stops_by_itself(bench: SimulatedBench, number: signal.Signals) -> None:
    command = [sys.executable, "-c", FLOW, str(bench.lab.root), *TEST]
    flow = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=bench.lab.root, env=ENVIRONMENT
    )
    assert flow.stderr is not None
    for line in flow.stderr:
        if line.startswith("load"):
            break
    flow.send_signal(number)
    flow.stderr.read()  # until the step, which has it too, has ended
    flow.stderr.close()
    flow.wait()
    (run,) = bench.lab.runs_of("S-0001", "indent")
    assert status_of(run) == "stopped"
    assert _standing(bench)["state"] == "disarmed"
