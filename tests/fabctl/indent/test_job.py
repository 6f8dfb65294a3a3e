"""A whole test on a rig in memory: how its record ends, whatever breaks it off, and what it refuses to begin."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from benchmarks._rig_memory import REGISTERS, MemoryBus
from design.findings import Finding
from drivers.rig.indenter import Indenter
from drivers.rig.registers import RegisterMap
from fabctl.bench import Bench
from fabctl.cli.main import cli
from fabctl.config.bench import BenchConfig, RigConfig
from fabctl.errors import REFUSED, RefusedError, Stopped, UsageError
from fabctl.events import Event
from fabctl.indent import job
from fabctl.indent.analysis import read_samples
from fabctl.indent.groups import analyse_groups
from fabctl.indent.job import IndentPlan, Steering, plan_test, refuse, run_test
from fabctl.indent.run import NoContact
from fabctl.indent.sampling import Wish
from fabctl.records.ending import undisturbed
from fabctl.records.folder import RunFolder, start_run, status_of
from fabctl.reports.indent_step import indent_step
from fabctl.workspace import Specimen, Workspace
from simulators.rig.controller import Controller, Machine
from simulators.specimens import curve
from simulators.specimens.analytic import linear
from tests.rig_endpoints import rig_bench, short_method

METHOD = short_method(
    "step: approach, speed_mm_s: 4, trigger_N: 0.02, clearance_mm: 0.8",
    "step: cycles, cycles_count: 2, depth_mm: 2.6, speed_mm_s: 3, unload_speed_mm_s: 6",
)
RIG = RigConfig(url="memory:", map="reference", travel_mm=60, force_limit_N=20, indenter_radius_mm=8)
BENCH = BenchConfig(name="here", rig=RIG)
MACHINE = Machine(noise_N=0.001, contact_mm=2.0, parked_mm=0.2, backlash_mm=0.0)


class Lab:
    """A lab with one specimen, a spring, on a simulated controller in memory."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.place = Workspace(root)
        (root / "design").mkdir()
        self.specimen: Specimen = self.place.new_specimen(root / "design")
        (root / "short.yaml").write_text(METHOD)
        self.device = Controller(MACHINE, curve.Specimen(linear(0.5)))
        self.bus = MemoryBus(self.device)
        monkeypatch.setattr(job, "open_indenter", self.connected)

    def connected(self, _url: str, _registers: RegisterMap) -> Indenter:
        return Indenter(self.bus, REGISTERS, now_s=self.bus.now_s, sleep=self.bus.sleep)

    def plan(self, method: str = METHOD, bench: BenchConfig = BENCH, resume: RunFolder | None = None) -> IndentPlan:
        path = self.place.root / "short.yaml"
        path.write_text(method)
        return plan_test(self.place, self.specimen, str(path), bench, resume)

    def broken_off(self, resume: RunFolder | None = None) -> RunFolder:
        """Test until a curve is done, stop there, and return the run; the stage is drawn back by hand."""
        told: list[str] = []
        steering = Steering(lambda: "stop" if "curve" in told else "go")
        with pytest.raises(Stopped):
            run_test(
                self.place,
                self.plan(resume=resume),
                Bench(BENCH, self.place.root),
                lambda event: told.append(event.kind),
                steering,
                self.bus,
            )
        self.device.axis.position_mm = 0.2
        (run,) = [run for run in self.place.all_runs() if run.manifest()["config"]["resumes"] == _id(resume)]
        return run

    def test(self, plan: IndentPlan, wish: Wish = "go", bench: BenchConfig = BENCH) -> RunFolder:
        at = Bench(bench, self.place.root)
        return run_test(self.place, plan, at, _unheard, Steering(lambda: wish), self.bus)

    def newest(self) -> RunFolder:
        return self.place.runs_of(self.specimen.name, "indent")[-1]


def _id(run: RunFolder | None) -> str | None:
    return None if run is None else run.run_id


def _unheard(_event: Event) -> None: ...


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    return Lab(tmp_path, monkeypatch)


def test_an_interrupt_while_figures_are_computed_takes_nothing_from_the_recording(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_run: RunFolder) -> dict[str, object]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(job, "summarise_run", interrupted)
        with pytest.raises(Stopped, match=r"recorded whole.*fabctl indent analyse"):
            lab.test(lab.plan())
    run = lab.newest()
    assert status_of(run) == "done"
    before = run.result() or {}
    assert before["rows_count"] > 100
    assert "its figures are not computed" in indent_step(run, lab.specimen.design).notes[0]
    found = analyse_groups({"S": [run]})["groups"]["S"]["runs"][0]["result"]
    assert found["stiffness_secant_N_mm"] == pytest.approx(0.5, rel=0.02)
    assert (run.result() or {})["rows_count"] == before["rows_count"]
    assert not any("not computed" in note for note in indent_step(run, lab.specimen.design).notes)
    with pytest.raises(RefusedError, match="came to its end"):
        refuse(lab.plan(resume=run))


def test_whatever_breaks_a_test_off_is_its_outcome(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Stopped):
        lab.test(lab.plan(), "stop")
    assert status_of(lab.newest()) == "stopped"
    with monkeypatch.context() as patched:
        patched.setattr(job, "Recorder", lambda _path: 1 / 0)  # nobody foresaw it
        with pytest.raises(ZeroDivisionError):
            lab.test(lab.plan())
    assert "failed" in {status_of(run) for run in lab.place.runs_of(lab.specimen.name)}


def test_a_test_refused_by_how_the_rig_was_left_is_recorded_as_refused(lab: Lab) -> None:
    lab.test(lab.plan())
    lab.device.axis.position_mm = 30.0
    before = {run.run_id for run in lab.place.all_runs()}
    with pytest.raises(RefusedError, match="RIG-DOWN"):
        lab.test(lab.plan())
    (run,) = [run for run in lab.place.all_runs() if run.run_id not in before]
    assert status_of(run) == "refused"


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Let Ctrl-C interrupt as it does at first: a command that ran here before leaves it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_nothing_interrupts_what_must_not_be_left_half_done_and_it_comes_afterwards() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), undisturbed():
        signal.raise_signal(signal.SIGINT)
        done.append("whole")
    assert done == ["whole"]


def test_a_resumed_test_stays_on_its_bench_and_its_rig(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Stopped):
        lab.test(lab.plan(), "stop")
    before = lab.newest()
    assert codes(lab.plan(resume=before).findings) >= {"METHOD-NO-PREDICTION"}
    elsewhere = BENCH.model_copy(update={"name": "there"})
    (found,) = [f for f in lab.plan(bench=elsewhere, resume=before).findings if f.level == "error"]
    assert (found.code, found.hint) == ("RESUME-BENCH", "go on there: --bench here")
    other = start_run(lab.place.runs, "calibrate", config={"bench": "here"})
    assert [f.code for f in lab.plan(resume=other).findings if f.level == "error"] == ["RESUME-OTHER"]
    same = Indenter.identify
    monkeypatch.setattr(Indenter, "identify", lambda rig: replace(same(rig), serial=same(rig).serial + 1))
    with pytest.raises(RefusedError, match="RESUME-RIG"):
        lab.test(lab.plan(resume=before))
    monkeypatch.undo()


def codes(findings: tuple[Finding, ...]) -> set[str]:
    return {finding.code for finding in findings}


def test_a_coupon_is_not_pressed(lab: Lab) -> None:
    (lab.specimen.design / "manifest.json").write_text(json.dumps({"kind": "coupon"}))
    with pytest.raises(RefusedError, match="INDENT-COUPON"):
        refuse(lab.plan())
    assert lab.place.runs_of(lab.specimen.name) == []


@pytest.mark.parametrize("text", ["null", "[]", '{"kind": "cou', ""])
def test_a_damaged_manifest_of_the_design_is_told_by_its_path(lab: Lab, text: str) -> None:
    (lab.specimen.design / "manifest.json").write_text(text)
    with pytest.raises(UsageError, match=r"design/manifest\.json"):
        lab.plan()


def test_a_clearance_beyond_the_travel_is_refused_and_a_secant_that_no_load_reaches_is_told(lab: Lab) -> None:
    with pytest.raises(RefusedError, match="METHOD-CLEARANCE"):
        refuse(lab.plan(METHOD.replace("clearance_mm: 0.8", "clearance_mm: 80")))
    shallow = lab.plan(METHOD.replace("depth_mm: 2.6", "depth_mm: 1.6"))
    assert "METHOD-SECANT" in codes(shallow.findings)
    assert "METHOD-SECANT" not in codes(lab.plan().findings)


def test_a_resume_of_a_resumed_test_repeats_no_curve_and_no_test_is_gone_on_with_twice(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = METHOD.replace("cycles_count: 2", "cycles_count: 4")
    monkeypatch.setattr(Lab.plan, "__defaults__", (method, BENCH, None))
    first = lab.broken_off()
    second = lab.broken_off(first)
    third = lab.plan(resume=second)
    refuse(third)
    assert {action.curve for action in third.actions if action.curve} == {3, 4}
    (found,) = [f for f in lab.plan(resume=first).findings if f.level == "error"]
    assert (found.code, second.run_id in found.message) == ("RESUME-TWICE", True)
    assert found.hint == f"go on with that one: --resume {second.run_id}"


def test_a_test_that_met_nothing_says_what_it_recorded_and_why_it_failed(lab: Lab) -> None:
    lab.device.specimen = None
    with pytest.raises(NoContact) as caught:
        lab.test(lab.plan())
    run = lab.newest()
    assert (status_of(run), caught.value.exit_code) == ("failed", REFUSED)
    assert f"`fabctl rig retract`; go on by --resume {run.run_id}" in caught.value.__notes__[0]
    assert "the indenter stands at 40.00 mm" in (run.path / "events.jsonl").read_text()
    step = indent_step(run, lab.specimen.design)
    count = len(read_samples(run.path / "samples.csv").time_s)
    assert count > 10
    assert f"{count} samples recorded" in step.summary
    shown = CliRunner().invoke(cli, ["--home", str(lab.place.root), "run", "show", run.run_id])
    assert "the force did not rise" in shown.output


def test_a_dry_run_is_refused_by_how_the_rig_was_left_as_the_test_would_be(lab: Lab) -> None:
    bench = lab.place.root / "here.yaml"
    bench.write_text(rig_bench("memory:", "here"))
    lab.plan()
    words = ["--home", str(lab.place.root), "indent", "run", lab.specimen.name, "--dry-run", "--bench", str(bench)]
    words += ["--method", str(lab.place.root / "short.yaml")]
    assert CliRunner().invoke(cli, words).exit_code == 0
    lab.test(lab.plan())
    lab.device.axis.position_mm = 30.0
    done = CliRunner().invoke(cli, words, standalone_mode=False)
    assert "RIG-DOWN" in str(done.exception)
