"""Rows are durable before they are acknowledged, soon, and a full disk is told."""

from __future__ import annotations

import itertools
import os
import threading
from pathlib import Path

import numpy as np
import pytest

from fabctl.errors import RecordError
from fabctl.indent.analysis import read_samples
from fabctl.indent.recorder import BATCH_S, COLUMNS, Recorder, Row


def row(k: int) -> Row:
    return Row(k / 100, 10 * k, 1.0, 0.5, 0.4, "load", 0, 1, "moving", "")


class Disk:
    """A disk that tells when a wait for it is over."""

    def __init__(self) -> None:
        self.waits = threading.Semaphore(0)

    def sync(self, handle: int) -> None:
        os.fdatasync(handle)
        self.waits.release()

    def await_one(self) -> None:
        assert self.waits.acquire(timeout=60), "nothing was written"


def test_an_acknowledgement_follows_the_wait_for_the_disk(tmp_path: Path) -> None:
    before, on_disk, disk = list[int](), list[int](), Disk()

    def sync(handle: int) -> None:
        before.append(recorder.acknowledged_count if on_disk else 0)
        disk.sync(handle)
        on_disk.append((tmp_path / "samples.csv").read_bytes().count(b"\n") - 1)

    recorder = Recorder(tmp_path / "samples.csv", sync)
    disk.await_one()  # the header
    for first in range(0, 50, 10):
        for k in range(first, first + 10):
            recorder.take(row(k))
        disk.await_one()
    recorder.close()
    # What is acknowledged before a wait is exactly what was on the disk after the one before.
    assert before[1:] == on_disk[:-1]
    assert len(on_disk) > 3
    assert recorder.acknowledged_count == 50


def test_a_row_waits_for_no_other_and_less_than_half_of_50_ms_for_company(tmp_path: Path) -> None:
    disk = Disk()
    recorder = Recorder(tmp_path / "samples.csv", disk.sync)
    disk.await_one()  # the header
    for k in range(20):
        recorder.take(row(k))
        disk.await_one()
        assert (tmp_path / "samples.csv").read_bytes().count(b"\n") == k + 2
    recorder.close()
    assert BATCH_S < 0.025  # the rest is the disk's


def test_a_full_disk_is_told_to_whoever_records(tmp_path: Path) -> None:
    calls = []

    def sync(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 2:
            raise OSError(28, "No space left on device")

    recorder = Recorder(tmp_path / "samples.csv", sync)
    with pytest.raises(RecordError, match="No space left"):
        for k in itertools.count():
            recorder.take(row(k))
    with pytest.raises(RecordError):
        recorder.close()


def test_a_last_line_that_was_cut_short_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "samples.csv"
    path.write_text(",".join(COLUMNS) + "\n" + row(1).text() + "\n" + row(2).text()[:20])
    assert len(read_samples(path).time_s) == 1


@pytest.mark.parametrize("damage", ["short", "nul", "nan", "words"])
def test_a_damaged_row_is_left_out_and_told_by_its_line(tmp_path: Path, damage: str) -> None:
    cells = row(2).text().split(",")
    bad = {
        "short": ",".join(cells[:4]),
        "nul": "\0" * 40,
        "nan": ",".join(
            "nan" if name.endswith(("_s", "_mm", "_N")) else c for name, c in zip(COLUMNS, cells, strict=True)
        ),
        "words": ",".join("x" if name == "curve" else c for name, c in zip(COLUMNS, cells, strict=True)),
    }[damage]
    path = tmp_path / "samples.csv"
    path.write_text("\n".join([",".join(COLUMNS), row(1).text(), bad, row(3).text(), ""]))
    found = read_samples(path)
    assert (len(found.time_s), found.left_out) == (2, (3,))
    assert np.isfinite(found.force_N).all()
