"""Rows are durable before they are acknowledged, soon, and a full disk is told."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from fabctl.errors import RecordError
from fabctl.indent.analysis import read_samples
from fabctl.indent.recorder import COLUMNS, Recorder, Row


def row(k: int) -> Row:
    return Row(k / 100, 10 * k, 1.0, 0.5, 0.4, "load", 0, 1, "moving", "")


def test_an_acknowledgement_follows_the_wait_for_the_disk(tmp_path: Path) -> None:
    story: list[tuple[str, int]] = []

    def sync(handle: int) -> None:
        story.append(("acknowledged before the wait", recorder.acknowledged_count if story else 0))
        os.fdatasync(handle)
        rows = (tmp_path / "samples.csv").read_bytes().count(b"\n") - 1
        story.append(("on disk after the wait", rows))

    recorder = Recorder(tmp_path / "samples.csv", sync)
    for k in range(50):
        recorder.take(row(k))
        time.sleep(0.002)
    recorder.close()
    on_disk = [count for what, count in story if what.startswith("on disk")]
    before = [count for what, count in story if what.startswith("acknowledged")]
    # What is acknowledged before a wait is exactly what was on the disk after the one before.
    assert before[1:] == on_disk[:-1]
    assert len(on_disk) > 3
    assert recorder.acknowledged_count == 50


def test_a_row_is_durable_within_50_ms(tmp_path: Path) -> None:
    synced: list[float] = []
    recorder = Recorder(
        tmp_path / "samples.csv", lambda handle: (os.fdatasync(handle), synced.append(time.monotonic()))[0]
    )
    waits = []
    for k in range(20):
        taken_s = time.monotonic()
        recorder.take(row(k))
        while recorder.acknowledged_count <= k:
            time.sleep(0.001)
        waits.append(time.monotonic() - taken_s)
    recorder.close()
    assert sorted(waits)[len(waits) // 2] < 0.05


def test_a_full_disk_is_told_to_whoever_records(tmp_path: Path) -> None:
    calls = []

    def sync(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 2:
            raise OSError(28, "No space left on device")

    recorder = Recorder(tmp_path / "samples.csv", sync)
    with pytest.raises(RecordError, match="No space left"):
        for k in range(2000):
            recorder.take(row(k))
            time.sleep(0.002)
    with pytest.raises(RecordError):
        recorder.close()


def test_a_last_line_that_was_cut_short_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "samples.csv"
    path.write_text(",".join(COLUMNS) + "\n" + row(1).text() + "\n" + row(2).text()[:20])
    assert len(read_samples(path).time_s) == 1
