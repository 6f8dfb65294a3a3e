"""`fabctl cut run` as a person uses it: processes, a port, signals, records."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fabctl.workspace import Workspace

ROOT = Path(__file__).resolve().parents[2]
SLITS = 20
DUMMIES = ("target.ply", "flat.ply", "cells.csv", "cut.dxf", "cut.svg", "cut.nc", "deployed.ply", "response.csv")


def make_design(path: Path, slits: int = SLITS, id_anchor: dict[str, float] | None = None) -> Path:
    """Write a small design folder by hand: some slits, a border, an id where it has an anchor."""
    path.mkdir()
    paths: list[dict[str, Any]] = [
        {"layer": "slit", "points_mm": [[10 + 2 * k, 10], [10 + 2 * k, 16]], "closed": False, "cell": k}
        for k in range(slits)
    ]
    border = {"layer": "outline", "points_mm": [[5, 5], [95, 5], [95, 25], [5, 25]], "closed": True, "cell": None}
    drawing = {"format": 1, "sheet_mm": [100, 30], "id_anchor": id_anchor, "paths": [*paths, border]}
    (path / "paths.json").write_text(json.dumps(drawing))
    (path / "spec.yaml").write_text("name: small\ntarget: cap.obj\nmaterial: natural-rubber-2.3\n")
    for name in DUMMIES:
        (path / name).write_text(f"{name}\n")
    files = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in path.iterdir()}
    (path / "manifest.json").write_text(json.dumps({"format": 1, "files": files}))
    return path


@dataclass
class Lab:
    home: Path
    simulator: subprocess.Popen[str]
    bench: Path
    trace: Path

    def start(self, *words: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "fabctl", "--home", str(self.home), *words]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, cwd=ROOT, env={**os.environ})

    def run(self, *words: str) -> tuple[int, str, str]:
        process = self.start(*words)
        out, err = process.communicate(timeout=120)
        return process.returncode, out, err

    def cut(self, design: Path, *more: str) -> list[str]:
        return ["cut", "run", str(design), "--bench", str(self.bench), "--yes", "--json", *more]

    def only_run(self) -> Path:
        (found,) = Workspace(self.home).runs.iterdir()
        return found

    def beam(self) -> list[tuple[float, float, float, float]]:
        whole, _, _ = self.trace.read_text().rpartition("\n")  # what follows is half written
        rows = [row.split(",") for row in whole.splitlines()[1:]]
        return [(float(t), float(x), float(y), float(power)) for t, x, y, power in rows]


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    trace = tmp_path / "trace.csv"
    command = [sys.executable, "-m", "simulators", "grbl", "--lab", "--speed", "4", "--pty", str(tmp_path / "port")]
    simulator = subprocess.Popen(
        [*command, "--trace", str(trace)], stdout=subprocess.PIPE, text=True, cwd=ROOT, env={**os.environ}
    )
    assert simulator.stdout is not None
    url = simulator.stdout.readline().split()[1]
    bench = tmp_path / "bench.yaml"
    bench.write_text(
        f"name: small\nlaser:\n  url: {url}\n  travel_mm: [300, 200]\n  max_run_on_s: 5\n"
        "specimen_slot: '{state}/slot'\n"
    )
    try:
        yield Lab(tmp_path, simulator, bench, trace)
    finally:
        simulator.terminate()
        simulator.communicate(timeout=10)


def wait_for_tenth(process: subprocess.Popen[str], tenth: int) -> None:
    """Return once the cut says that so many tenths of its time are over."""
    assert process.stderr is not None
    said = []
    for line in process.stderr:
        said.append(line)
        if (match := re.match(r" *(\d+)\.\d%", line)) and int(match[1]) >= 10 * tenth:
            return
    pytest.fail(f"it ended: {''.join(said)}")


def burnt_length_mm(beam: list[tuple[float, float, float, float]]) -> float:
    return sum(math.hypot(b[1] - a[1], b[2] - a[2]) for a, b in itertools.pairwise(beam) if a[3] > 0)


def assert_dark(lab: Lab) -> None:
    before = lab.beam()
    assert before[-1][3] == 0
    for a, b in itertools.pairwise(before):
        assert not (a[3] > 0 and a[1:3] == b[1:3] and b[0] - a[0] > 0.02), "lit while standing"


def test_what_is_told_before_a_cut_is_what_is_cut_with_its_id(lab: Lab, tmp_path: Path) -> None:
    design = make_design(tmp_path / "design", 2, {"x_mm": 50.0, "y_mm": 20.0, "height_mm": 3.0, "width_mm": 30.0})
    foretold, facts = (json.loads(lab.run(*lab.cut(design, *more))[1]) for more in (["--dry-run"], []))
    assert facts["specimen"] == "S-0001"
    for key in ("lines_count", "burnt_mm", "job_sha256"):
        assert facts[key] == foretold[key], key


def test_a_cut_is_recorded_and_laid_on_the_bench(lab: Lab, tmp_path: Path) -> None:
    design = make_design(tmp_path / "design")
    code, out, err = lab.run(*lab.cut(design))
    assert code == 0, err
    facts = json.loads(out)
    run = lab.only_run()
    assert facts["run"] == run.name
    assert facts["specimen"] == "S-0001"
    assert json.loads((run / "outcome.json").read_text())["status"] == "done"
    job = (run / "artefacts" / "job.nc").read_bytes()
    assert hashlib.sha256(job).hexdigest() == facts["job_sha256"]
    assert (tmp_path / "bench-state" / "small" / "slot" / "response.csv").is_file()
    designed_mm = SLITS * (6 - 0.125) + 2 * (90 + 20)
    assert burnt_length_mm(lab.beam()) == pytest.approx(designed_mm, rel=0.02)
    assert_dark(lab)


def test_a_dry_run_moves_nothing_and_leaves_nothing(lab: Lab, tmp_path: Path) -> None:
    code, out, _ = lab.run(*lab.cut(make_design(tmp_path / "design"), "--dry-run"))
    assert code == 0
    assert json.loads(out)["estimate_s"] > 10
    assert not Workspace(tmp_path).runs.exists()
    assert not Workspace(tmp_path).specimens.exists()
    assert len(lab.beam()) <= 1


def test_an_edited_design_is_refused(lab: Lab, tmp_path: Path) -> None:
    design = make_design(tmp_path / "design")
    (design / "paths.json").write_text((design / "paths.json").read_text().replace("16", "17"))
    code, _, err = lab.run(*lab.cut(design))
    assert code == 3
    assert "changed after the build" in err


def test_dangerous_material_is_refused_with_everything_else_at_once(lab: Lab, tmp_path: Path) -> None:
    code, out, err = lab.run(*lab.cut(make_design(tmp_path / "design"), "--material", "neoprene-2.0"))
    assert code == 3
    assert "CUT-MATERIAL-DANGER" in err
    assert "CUT-SHEET" in err
    told = {finding["code"]: finding for finding in json.loads(out)["findings"]}
    assert told["CUT-SHEET"].keys() >= {"what", "value", "unit", "limit", "remedy"}
    outcome = json.loads((lab.only_run() / "outcome.json").read_text())
    assert outcome["status"] == "refused"
    assert {finding["code"] for finding in outcome["findings"]} == set(told)
    assert json.loads((lab.only_run() / "manifest.json").read_text())["specimen"] is None


def test_without_a_yes_nothing_moves(lab: Lab, tmp_path: Path) -> None:
    words = [word for word in lab.cut(make_design(tmp_path / "design")) if word != "--yes"]
    code, out, err = lab.run(*words)
    assert code == 5
    assert json.loads(out)["exit_code"] == 5
    assert "keys:" not in err, "there is no keyboard here"
    assert json.loads((lab.only_run() / "outcome.json").read_text())["status"] == "stopped"
    assert not Workspace(tmp_path).specimens.exists()
    assert len(lab.beam()) <= 1


def test_a_port_in_use_or_missing_is_said(lab: Lab, tmp_path: Path) -> None:
    design = make_design(tmp_path / "design")
    first = lab.start(*lab.cut(design))
    wait_for_tenth(first, 1)
    first.send_signal(signal.SIGSTOP)  # however long the second takes, the first is there
    other = tmp_path / "other.yaml"
    other.write_text(lab.bench.read_text().replace("name: small", "name: other"))
    code, _, err = lab.run("laser", "info", "--bench", str(other))
    assert code == 4
    assert "in use" in err
    first.send_signal(signal.SIGINT)
    first.send_signal(signal.SIGCONT)
    first.communicate(timeout=60)
    other.write_text(lab.bench.read_text().replace("/port", "/nowhere"))
    code, _, err = lab.run("laser", "info", "--bench", str(other))
    assert code == 4
    assert "no such port" in err


@pytest.mark.parametrize("word", [signal.SIGTERM, signal.SIGHUP])  # Ctrl-C ends the cut in the test above
def test_stopping_is_dark_and_recorded(lab: Lab, tmp_path: Path, word: signal.Signals) -> None:
    process = lab.start(*lab.cut(make_design(tmp_path / "design")))
    wait_for_tenth(process, 1)
    process.send_signal(word)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 5, err
    outcome = json.loads((lab.only_run() / "outcome.json").read_text())
    assert outcome["status"] == "stopped"
    assert outcome["beam_off_confirmed"]
    assert outcome["position_known"]
    assert_dark(lab)


def test_a_killed_cut_is_resumed_and_every_slit_is_burnt_once(lab: Lab, tmp_path: Path) -> None:
    design = make_design(tmp_path / "design")
    process = lab.start(*lab.cut(design))
    wait_for_tenth(process, 2)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    run = lab.only_run()
    assert not (run / "outcome.json").exists()
    code, out, err = lab.run(*lab.cut(design, "--resume", run.name))
    assert code == 0, err
    assert json.loads(out)["resumed"] == run.name
    designed_mm = SLITS * (6 - 0.125) + 2 * (90 + 20)
    assert burnt_length_mm(lab.beam()) == pytest.approx(designed_mm, abs=6)


def test_a_finished_cut_is_not_resumed(lab: Lab, tmp_path: Path) -> None:
    design = make_design(tmp_path / "design", slits=1)
    assert lab.run(*lab.cut(design))[0] == 0
    code, _, err = lab.run(*lab.cut(design, "--resume", lab.only_run().name))
    assert code == 3
    assert "is done" in err
