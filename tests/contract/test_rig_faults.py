"""Reading and moving over a bad line: no wrong sample is believed, no motion is executed twice."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks._rig_lines import move_through_faults, read_naively, read_through_faults


@pytest.mark.parametrize(("serial", "faults_count"), [(False, 180), (True, 120)], ids=["tcp", "rtu"])
def test_no_wrong_sample_is_believed(tmp_path: Path, serial: bool, faults_count: int) -> None:
    found = read_through_faults(tmp_path, serial, faults_count, seed=3)
    assert found.injected_count >= faults_count
    assert found.believed_count > faults_count / 3
    assert found.wrong == []
    assert found.wrong_count == 0


@pytest.mark.parametrize("serial", [False, True], ids=["tcp", "rtu"])
def test_the_same_faults_give_a_naive_client_wrong_samples(tmp_path: Path, serial: bool) -> None:
    assert read_naively(tmp_path, serial, 60, seed=3).wrong_count > 3


@pytest.mark.parametrize("serial", [False, True], ids=["tcp", "rtu"])
def test_every_motion_is_executed_once_or_reported_and_stopped(tmp_path: Path, serial: bool) -> None:
    found = move_through_faults(tmp_path, serial, 25, seed=5)
    assert found.faults_count > 15
    assert found.confirmed_count > 5
    assert found.broken == []
