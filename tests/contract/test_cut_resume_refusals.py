"""Why an interrupted cut is not gone on with, and a camera not cut by: said before anything moves, with exit code 3."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks._laser_kills import killed_run
from benchmarks._laser_rig import LAB, Rig, slits
from drivers.grbl.laser import Laser
from drivers.transport.tap import Tap
from fabctl.config.bench import LaserConfig
from fabctl.config.material import LaserPreset, LayerConfig, MaterialConfig
from fabctl.cut import job, resume
from fabctl.cut.job import CutOrder, Desk
from fabctl.cut.place import Affine
from fabctl.cut.program import read_program
from fabctl.cut.wirelog import WireLog
from fabctl.errors import REFUSED, RefusedError, Stopped, UsageError
from fabctl.events import Emit, silent
from fabctl.records.folder import RunFolder, start_run, status_of
from fabctl.workspace import Workspace

LAYER = LayerConfig(power_frac=0.5, feed_mm_s=25.0)
RUBBER = MaterialConfig(
    name="rubber", E_MPa=1.5, nu_ratio=0.45, thickness_mm=2.3, density_kg_m3=1150.0,
    laser=LaserPreset(slit=LAYER, outline=LAYER, engrave=LAYER, mark=LAYER, kerf_mm=0.125, air_assist=False),
)  # fmt: skip
PROGRAM = read_program(slits(20))
TEXT = "\n".join(PROGRAM.lines) + "\n"
BEGIN = {
    "work_offset_mm": [0.0, 0.0, 0.0],
    "placement": Affine().rows(),
    "bench": {"name": "small"},
    "material": RUBBER.model_dump(mode="json"),
    "plan": {"job_sha256": hashlib.sha256(TEXT.encode("ascii")).hexdigest()},
}


@dataclass
class Cut:
    """A cut whose host was killed, its record, and the board as the killed host left it."""

    lab: Workspace
    rig: Rig
    run: RunFolder
    order: CutOrder
    bench: Any
    asked: list[str] = field(default_factory=list)

    def resume(self, dry_run: bool = True, yes: bool = False, emit: Emit = silent) -> Any:
        desk = Desk(lambda question: self.asked.append(question) or yes, emit)
        return resume.resume(self.lab, self.bench, self.order, self.run.path, desk, dry_run)

    def refused(self) -> tuple[str, str]:
        """Return the code and the whole text of the one finding, and see that nothing moved and nobody was asked."""
        place, dark_from = self.rig.board.machine.position_mm(), len(self.rig.trace)
        with pytest.raises(RefusedError) as caught:
            self.resume(dry_run=False)
        (finding,) = caught.value.findings
        assert caught.value.exit_code == REFUSED == 3
        assert finding.hint
        assert self.asked == []
        assert self.rig.board.machine.position_mm() == place
        assert all(point.power_frac == 0 for point in self.rig.trace[dark_from:])
        return finding.code, str(caught.value)


@pytest.fixture
def board(request: pytest.FixtureRequest) -> Rig:
    """Return the board that the cut begins on, with other settings where a test names them."""
    return Rig(settings=getattr(request, "param", LAB))


@pytest.fixture
def cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, board: Rig) -> Cut:
    rig, rows, _ = killed_run(4, PROGRAM, absence_s=8.0, rig=board)
    lab = Workspace(tmp_path / "lab")
    design = tmp_path / "design"
    design.mkdir()
    (design / "manifest.json").write_text('{"name": "dome"}')
    specimen = lab.new_specimen(design)
    run = start_run(lab.runs, "cut", specimen=specimen.name, config=BEGIN)
    run.artefact("job.nc").write_text(TEXT)
    (run.path / "wire.log").write_text("\n".join(rows) + "\n")
    run.finish("failed", "the host was killed")
    laser = LaserConfig(url="tcp://x:1", travel_mm=(300.0, 200.0))
    homes = bool(board.settings[22])
    laser = laser.model_copy(update={"homing": homes})
    config = SimpleNamespace(name="small", laser=laser, is_simulated=False, model_dump=lambda **_: {"name": "small"})
    order = CutOrder(design, lambda _, __: PROGRAM.lines, RUBBER)

    @contextmanager
    def laser_on(_bench: Any, log: WireLog | None = None) -> Iterator[Laser]:
        line = rig.revive()
        with Laser(Tap(line, log.note, rig.clock) if log is not None else line, rig.clock) as laser:
            laser.connect()
            yield laser

    monkeypatch.setattr(resume, "laser_on", laser_on)
    monkeypatch.setattr(job, "laser_on", laser_on)
    return Cut(lab, rig, run, order, SimpleNamespace(config=config, lay=lambda _: None))


def tell(rig: Rig, line: str) -> None:
    with Laser(rig.revive(), rig.clock) as laser:
        laser.connect()
        laser.ask(line)


def test_a_cut_that_can_be_gone_on_with_says_from_where_and_asks(cut: Cut) -> None:
    assert cut.resume().result["position_kept"]
    with pytest.raises(Stopped):
        cut.resume(dry_run=False)
    assert "still stands where it stopped" in cut.asked[0]


def test_a_lost_position_is_homed_first_where_the_machine_can_be(cut: Cut) -> None:
    cut.rig.board.restart()
    assert not cut.resume().result["position_kept"]
    with pytest.raises(Stopped):
        cut.resume(dry_run=False)
    assert "it homes first" in cut.asked[0]


@pytest.mark.parametrize("how", ["the operator says no-home", "the bench has no homing", "the board has it off"])
def test_a_lost_position_that_cannot_be_found_again_is_refused(cut: Cut, how: str) -> None:
    if how == "the board has it off":
        tell(cut.rig, "$22=0")
    cut.rig.board.restart()
    if how == "the operator says no-home":
        cut.order = replace(cut.order, home=False)
    elif how == "the bench has no homing":
        cut.bench.config.laser = cut.bench.config.laser.model_copy(update={"homing": False})
    code, text = cut.refused()
    assert code == "RESUME-LOST"
    assert "position was lost" in text
    assert "home the machine" in text


def test_a_program_that_is_not_the_one_sent_is_refused(cut: Cut) -> None:
    cut.run.artefact("job.nc").write_text(TEXT.replace("S", "S1", 1))
    code, _ = cut.refused()
    assert code == "RESUME-PROGRAM"


def test_another_bench_is_refused_by_name(cut: Cut) -> None:
    cut.bench.config.name = "elsewhere"
    code, text = cut.refused()
    assert code == "RESUME-BENCH"
    assert "elsewhere" in text


def test_another_work_offset_is_refused_with_both(cut: Cut) -> None:
    tell(cut.rig, "G10L2P1X-7")
    code, text = cut.refused()
    assert code == "RESUME-OFFSET"
    assert "(-7.0, 0.0, 0.0)" in text
    assert "(0.0, 0.0, 0.0)" in text


def test_a_cut_that_burnt_nothing_is_begun_anew(cut: Cut) -> None:
    (cut.run.path / "wire.log").write_text('{"t_s": 0, "dir": ">", "bytes": "$I\\n"}\n')
    code, text = cut.refused()
    assert code == "RESUME-EMPTY"
    assert "before anything was cut" in text
    assert "start it again" in text


@pytest.mark.parametrize("status", ["done", "refused"])
def test_a_cut_that_ended_by_itself_is_not_gone_on_with(cut: Cut, status: str) -> None:
    cut.run = start_run(cut.lab.runs, "cut", specimen="S-0001", config=BEGIN)
    (cut.run.path / "wire.log").write_text("")
    cut.run.finish(status)
    with pytest.raises(RefusedError) as caught:
        cut.resume()
    assert [(f.code, status in f.message) for f in caught.value.findings] == [("RESUME-STATUS", True)]


def test_a_cut_is_gone_on_with_once_and_from_its_own_design(cut: Cut, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "manifest.json").write_text('{"name": "vase"}')
    kept, cut.order = cut.order, replace(cut.order, design=other)
    code, text = cut.refused()
    assert code == "RESUME-DESIGN"
    assert str(other) in text
    cut.order = kept
    later = start_run(cut.lab.runs, "cut", specimen="S-0001", config={"resumed": cut.run.run_id})
    later.finish("done")
    shutil.copy(cut.run.path / "wire.log", later.path)
    code, text = cut.refused()
    assert code == "RESUME-TWICE"
    assert later.run_id in text


def test_all_that_the_record_has_against_it_is_said_at_once(cut: Cut) -> None:
    cut.order = replace(cut.order, material=RUBBER.model_copy(update={"name": "felt"}))
    cut.bench.config.name = "elsewhere"
    with pytest.raises(RefusedError) as caught:
        cut.resume()
    assert [finding.code for finding in caught.value.findings] == ["RESUME-BENCH", "RESUME-MATERIAL"]
    assert "felt" in str(caught.value)


def test_what_is_no_cut_or_not_there_is_said(cut: Cut) -> None:
    cut.run = RunFolder(cut.lab.runs / "nowhere")
    with pytest.raises(UsageError, match="no such run"):
        cut.resume()
    cut.run = start_run(cut.lab.runs, "indent")
    with pytest.raises(UsageError, match="not a cut"):
        cut.resume()


class Camera:
    """Sees the sheet in the corner, and nothing wrong with it."""

    def place(self) -> Affine:
        return Affine()

    def against(self, plan: Any) -> list[Any]:
        return []


@pytest.mark.parametrize(("homing", "expected"), [(1, []), (0, ["CUT-CAMERA-UNHOMED"])])
def test_a_camera_is_of_no_use_to_a_machine_without_homing(
    cut: Cut, homing: int, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(settings={**LAB, 20: homing, 22: homing})

    @contextmanager
    def laser_on(_bench: Any, _log: Any = None) -> Iterator[Laser]:
        with rig.laser() as laser:
            laser.connect()
            yield laser

    monkeypatch.setattr(job, "laser_on", laser_on)
    config = cut.bench.config
    config.laser = config.laser.model_copy(update={"homing": bool(homing)})
    order = replace(cut.order, origin="camera", eye=Camera())
    found: list[str] = []
    try:
        job.cut(cut.lab, cut.bench, order, Desk(lambda _: False, silent), dry_run=True)
    except RefusedError as fault:
        assert fault.exit_code == 3
        assert "not homed" in str(fault)
        found = [finding.code for finding in fault.findings]
    assert found == expected
    assert all(point.power_frac == 0 for point in rig.trace)


@pytest.mark.parametrize("homing", [1, 0])
def test_a_cut_without_homing_frames_first_so_that_its_zero_is_seen(
    cut: Cut, homing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(settings={**LAB, 20: 0, 22: homing})

    @contextmanager
    def laser_on(_bench: Any, _log: Any = None) -> Iterator[Laser]:
        with rig.laser() as laser:
            laser.connect()
            yield laser

    monkeypatch.setattr(job, "laser_on", laser_on)
    config = cut.bench.config
    config.laser = config.laser.model_copy(update={"homing": bool(homing), "origin_mm": (300.0, 200.0)})
    asked: list[str] = []

    def answer(question: str) -> bool:
        asked.append(question)
        return "Does it fit" not in question

    if homing:
        assert job.cut(cut.lab, cut.bench, cut.order, Desk(answer, silent)).run is not None
        assert len(asked) == 1
        return
    with pytest.raises(Stopped, match="frame"):
        job.cut(cut.lab, cut.bench, cut.order, Desk(answer, silent))
    assert ["frames the job first" in asked[0], "Does it fit" in asked[1]] == [True, True]
    (stopped,) = [run for run in cut.lab.all_runs() if run.run_id != cut.run.run_id]
    assert status_of(stopped) == "stopped"
    assert all(point.power_frac == 0 for point in rig.trace)
    assert max(point.x_mm for point in rig.trace) - min(point.x_mm for point in rig.trace) > 20
