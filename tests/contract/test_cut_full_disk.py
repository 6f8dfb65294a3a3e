"""A disk that takes nothing more ends a cut: dark, recorded where that is possible, and told as what it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fabctl.cut import resume
from fabctl.cut.wirelog import WireLog
from fabctl.errors import DEVICE, RecordError, Stopped
from fabctl.events import Event, silent
from fabctl.records import folder
from tests.contract.test_cut_resume_refusals import Cut, board, cut
from tests.contract.test_cut_resume_ways import later_run

__all__ = ["board", "cut"]  # the fixtures


class FullDisk:
    """A file that takes so many bytes, and then a part of a row."""

    def __init__(self, left_bytes: int) -> None:
        self.left_bytes = left_bytes

    def write(self, data: bytes) -> int:
        if len(data) > self.left_bytes:
            raise OSError(28, "No space left on device")
        self.left_bytes -= len(data)
        return len(data)

    def close(self) -> None:
        pass


def fill_after(monkeypatch: pytest.MonkeyPatch, left_bytes: int) -> list[WireLog]:
    """Let the disk be full so many bytes after the program began."""
    logs: list[WireLog] = []

    class Filling(WireLog):
        def mark(self, remark: str, t_s: float) -> None:
            super().mark(remark, t_s)
            self.close()
            self._stream: Any = FullDisk(left_bytes)
            logs.append(self)

    monkeypatch.setattr(resume, "WireLog", Filling)
    return logs


def dark_and_still(cut: Cut) -> bool:
    """Tell whether the beam is off, and stays off while the board does what it was given."""
    since = len(cut.rig.trace)
    place = cut.rig.board.machine.position_mm()
    cut.rig.clock.sleep(5.0)
    return place == cut.rig.board.machine.position_mm() and not any(p.power_frac for p in cut.rig.trace[since:])


@pytest.mark.parametrize("left_bytes", [0, 50, 1000, 1050, 1100, 2000, 5000])
def test_a_full_disk_ends_the_cut_dark_and_says_so(cut: Cut, monkeypatch: pytest.MonkeyPatch, left_bytes: int) -> None:
    fill_after(monkeypatch, left_bytes)
    with pytest.raises(RecordError, match="No space left") as caught:
        cut.resume(dry_run=False, yes=True)
    assert caught.value.exit_code == DEVICE
    assert cut.rig.sent.endswith(b"\x18")
    assert dark_and_still(cut)
    outcome = later_run(cut).outcome()
    assert outcome is not None
    assert (outcome["status"], outcome["beam_off_confirmed"], outcome["position_known"]) == ("failed", True, True)
    (note,) = caught.value.__notes__
    assert f"--resume {later_run(cut).run_id}" in note


def test_an_operator_stops_on_a_full_disk(cut: Cut, monkeypatch: pytest.MonkeyPatch) -> None:
    logs = fill_after(monkeypatch, 1_000_000)

    def interrupt(event: Event) -> None:
        if "line 1" in event.message:
            logs[0]._stream.left_bytes = 0
            raise KeyboardInterrupt

    with pytest.raises(Stopped, match="says how far it came"):
        cut.resume(dry_run=False, yes=True, emit=interrupt)
    assert dark_and_still(cut)
    outcome = later_run(cut).outcome()
    assert outcome is not None
    assert (outcome["status"], outcome["position_known"]) == ("stopped", True)


@pytest.mark.parametrize("stopped", [True, False])
def test_an_outcome_that_cannot_be_written_hides_no_fault(
    cut: Cut, monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    fill_after(monkeypatch, 1_000_000 if stopped else 1000)
    write = folder.write_atomically

    def full(path: Path, content: str | bytes) -> None:
        if path.name == "outcome.json":
            raise RecordError(f"{path}: cannot be written: No space left on device")
        write(path, content)

    def interrupt(event: Event) -> None:
        if "line 1" in event.message:
            raise KeyboardInterrupt

    monkeypatch.setattr(folder, "write_atomically", full)
    with pytest.raises(Stopped if stopped else RecordError) as caught:
        cut.resume(dry_run=False, yes=True, emit=interrupt if stopped else silent)
    told = "\n".join([str(caught.value), *getattr(caught.value, "__notes__", ())])
    assert "how it ended could not be recorded" in told
    assert f"--resume {later_run(cut).run_id}" in told
    assert dark_and_still(cut)
