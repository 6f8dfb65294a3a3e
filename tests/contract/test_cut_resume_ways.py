"""Going on with an interrupted cut: what was left is burnt, at most a stroke of it twice, wherever it lies now."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks._laser_kills import missing_count, twice_mm
from benchmarks._laser_rig import LAB, Rig
from drivers.grbl.laser import Laser
from fabctl.cut import job, resume
from fabctl.cut.place import Affine
from fabctl.cut.resume import RESUMED_BY
from fabctl.errors import RecordError, RefusedError, Stopped
from fabctl.events import Event, silent
from fabctl.records.folder import RunFolder, status_of
from tests.contract.test_cut_resume_refusals import PROGRAM, Camera, Cut, board, cut

__all__ = ["board", "cut"]  # the fixtures
SLIT_MM = 4.0
UNHOMED = {**LAB, 20: 0, 22: 0}
unhomed = pytest.mark.parametrize("board", [UNHOMED], indirect=True, ids=["unhomed"])


def later_run(cut: Cut) -> RunFolder:
    return next(run for run in cut.lab.all_runs() if run.manifest()["config"].get("resumed") == cut.run.run_id)


def refusal(cut: Cut) -> dict[str, str]:
    with pytest.raises(RefusedError) as caught:
        cut.resume()
    return {finding.code: str(finding) for finding in caught.value.findings}


def jog(rig: Rig, x_mm: float, y_mm: float) -> None:
    with Laser(rig.revive(), rig.clock) as laser:
        laser.connect()
        laser.jog(x_mm, y_mm, 50.0)


def restart(rig: Rig) -> tuple[float, float]:
    """Restart the board, which then calls zero where it stands; return where that is in its coordinates of before."""
    x, y, _ = rig.board.machine.position_mm()
    rig.board.restart()
    return x, y


def in_one_frame(rig: Rig, since: int, shift_mm: tuple[float, float]) -> None:
    """Move what was burnt since a restart to where it is in the coordinates of before."""
    dx, dy = shift_mm
    rig.trace[since:] = [replace(p, x_mm=p.x_mm + dx, y_mm=p.y_mm + dy) for p in rig.trace[since:]]


def interrupt_at(words: str) -> Any:
    def emit(event: Event) -> None:
        if words in event.message:
            raise KeyboardInterrupt

    return emit


def test_a_resume_that_is_stopped_before_its_program_begins_can_be_tried_again(cut: Cut) -> None:
    with pytest.raises(Stopped, match=f"nothing was cut.*--resume {cut.run.run_id}"):
        cut.resume(dry_run=False, yes=True, emit=interrupt_at("checking"))
    assert status_of(later_run(cut)) == "stopped"
    done = cut.resume(dry_run=False, yes=True)
    assert done.result["resumed"] == cut.run.run_id
    assert missing_count(cut.rig, PROGRAM) == 0
    assert twice_mm(cut.rig, PROGRAM) < 0.5
    assert set(refusal(cut)) == {"RESUME-TWICE"}


@pytest.mark.parametrize(
    ("damaged", "lost"),
    [
        (["manifest.json"], []),
        (["wire.log"], []),
        (["manifest.json", "wire.log"], []),
        (["manifest.json"], [RESUMED_BY]),
    ],
)
def test_a_damaged_record_of_a_resume_lets_nothing_be_burnt_twice(
    cut: Cut, damaged: list[str], lost: list[str]
) -> None:
    later = cut.resume(dry_run=False, yes=True).run
    for name in damaged:
        (later.path / name).write_text("")
    for name in lost:
        (cut.run.path / name).unlink()
    assert set(refusal(cut)) == {"RESUME-TWICE"}


def test_that_a_cut_is_gone_on_with_is_written_down_before_its_first_line(
    cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, _content: str) -> None:
        raise RecordError(f"{path}: cannot be written")

    monkeypatch.setattr(resume, "write_atomically", refuse)
    since = len(cut.rig.trace)
    with pytest.raises(RecordError, match=RESUMED_BY):
        cut.resume(dry_run=False, yes=True)
    assert not any(point.power_frac for point in cut.rig.trace[since:])


def test_a_resume_that_is_stopped_later_is_gone_on_with_itself(cut: Cut) -> None:
    with pytest.raises(Stopped, match="says how far it came") as caught:
        cut.resume(dry_run=False, yes=True, emit=interrupt_at("line 1"))
    later = later_run(cut)
    assert f"--resume {later.run_id}" in str(caught.value)
    cut.run = later
    cut.resume(dry_run=False, yes=True)
    assert missing_count(cut.rig, PROGRAM) == 0
    assert twice_mm(cut.rig, PROGRAM) < 0.5


def test_a_position_that_was_declared_lost_is_not_believed_though_the_board_stands_on_the_cut(cut: Cut) -> None:
    assert cut.resume().result["position_kept"]
    cut.run.finish("failed", "the line broke", position_known=False)
    assert not cut.resume().result["position_kept"]


@unhomed
def test_without_homing_too_a_board_that_lived_goes_on_from_exactly_there(cut: Cut) -> None:
    done = cut.resume(dry_run=False, yes=True)
    assert len(cut.asked) == 1, "no frame: where it stands is known"
    assert {finding["code"] for finding in done.result["findings"]} == {"CUT-ZERO"}
    assert missing_count(cut.rig, PROGRAM) == 0
    assert twice_mm(cut.rig, PROGRAM) < 0.5


@unhomed
@pytest.mark.parametrize("off_mm", [0.0, 0.5])
def test_without_homing_only_a_head_where_it_was_left_is_believed(cut: Cut, off_mm: float) -> None:
    x, y, z = cut.rig.board.machine.position_mm()
    cut.run.finish("stopped", "by the operator", position_known=True, machine_mm=[x, y + off_mm, z])
    if off_mm:
        assert set(refusal(cut)) == {"RESUME-LOST"}
    else:
        assert cut.resume().result["position_kept"]


@unhomed
def test_without_homing_a_lost_zero_is_asked_for_and_framed(cut: Cut) -> None:
    zero, since = restart(cut.rig), len(cut.rig.trace)
    assert "--origin here" in refusal(cut)["RESUME-LOST"]
    jog(cut.rig, -zero[0], -zero[1])
    cut.order = replace(cut.order, origin="here")
    done = cut.resume(dry_run=False, yes=True)
    assert ["frames" in cut.asked[0], "Does it fit" in cut.asked[1]] == [True, True]
    assert done.run.manifest()["config"]["placement"][0][2] == pytest.approx(-zero[0], abs=0.01)
    in_one_frame(cut.rig, since, zero)
    assert missing_count(cut.rig, PROGRAM) == 0
    assert twice_mm(cut.rig, PROGRAM) <= SLIT_MM


def test_here_is_refused_while_the_head_still_stands_on_the_cut(cut: Cut) -> None:
    cut.order = replace(cut.order, origin="here")
    assert set(refusal(cut)) == {"RESUME-ORIGIN"}


class Looking(Camera):
    """Sees that the sheet has moved by a little and was turned, and is asked all it should be."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def place(self) -> Affine:
        return Affine(0.8, -0.6, -180.0, 0.6, 0.8, 120.0)

    def show(self, plan: Any) -> str:
        self.asked.append("show")
        return "look at the picture"

    def look_again(self) -> None:
        self.asked.append("look again")

    def record(self, run: RunFolder, plan: Any) -> None:
        self.asked.append("record")

    def facts(self) -> dict[str, Any]:
        return {"sheet": "registration"}


@pytest.mark.parametrize("lost", [False, True])
def test_a_camera_lays_the_rest_where_the_sheet_is_now(cut: Cut, lost: bool) -> None:
    before = cut.resume().plan
    if lost:
        cut.rig.board.restart()
    eye = Looking()
    cut.order = replace(cut.order, origin="camera", eye=eye)
    done = cut.resume(dry_run=False, yes=True)
    assert "look at the picture" in cut.asked[0]
    assert eye.asked == ["show", "look again", "record"]
    assert done.run.manifest()["config"]["placement"] == eye.place().rows()
    burns = [step.end_mm for step in before.program.steps if step.burns]
    now = [step.end_mm for step in done.plan.program.steps if step.burns]
    for there, here in zip(reversed(burns), reversed(now), strict=False):
        assert here == pytest.approx(eye.place().at(there), abs=0.002)
    assert done.result["resumed"] == cut.run.run_id


@unhomed
def test_a_camera_is_of_no_use_to_a_resume_without_homing(cut: Cut) -> None:
    cut.order = replace(cut.order, origin="camera", eye=Looking())
    assert set(refusal(cut)) == {"CUT-CAMERA-UNHOMED"}


def whole_cut(cut: Cut, emit: Any = silent) -> None:
    cut.bench.config.laser = cut.bench.config.laser.model_copy(update={"origin_mm": (300.0, 200.0)})
    job.cut(cut.lab, cut.bench, cut.order, job.Desk(lambda _: True, emit))


def outcomes(cut: Cut) -> list[str]:
    return [status_of(run) for run in cut.lab.all_runs() if run.run_id != cut.run.run_id]


def test_a_cut_that_is_stopped_before_it_begins_is_to_be_started_again(cut: Cut) -> None:
    with pytest.raises(Stopped, match="nothing was cut: start it again"):
        whole_cut(cut, interrupt_at("homing"))
    assert outcomes(cut) == ["stopped"]


def test_an_interrupt_while_the_record_is_made_is_written_down(cut: Cut, monkeypatch: pytest.MonkeyPatch) -> None:
    make = job.start_run

    def interrupted(*words: Any, **more: Any) -> RunFolder:
        os.kill(os.getpid(), signal.SIGTERM)
        return make(*words, **more)

    monkeypatch.setattr(job, "start_run", interrupted)
    with pytest.raises(Stopped, match="nothing was cut"):
        whole_cut(cut)
    assert outcomes(cut) == ["stopped"]


def test_an_interrupt_after_the_last_line_does_not_undo_that_it_is_done(
    cut: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = RunFolder.finish

    def interrupted(run: RunFolder, status: str, *words: Any, **more: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        finish(run, status, *words, **more)

    monkeypatch.setattr(RunFolder, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        whole_cut(cut)
    assert outcomes(cut) == ["done"]


def test_a_device_fault_says_how_to_go_on(cut: Cut, tmp_path: Path) -> None:
    def unplug(event: Event) -> None:
        cut.rig.unplugged = cut.rig.unplugged or "line 2" in event.message

    with pytest.raises(Exception, match="the line broke") as caught:
        cut.resume(dry_run=False, yes=True, emit=unplug)
    (note,) = caught.value.__notes__
    assert f"--resume {later_run(cut).run_id}" in note
    outcome = later_run(cut).outcome()
    assert outcome is not None
    assert (outcome["status"], outcome["position_known"]) == ("failed", False)
