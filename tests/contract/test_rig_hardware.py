"""The suite for real rigs, run by URL against the simulator: on both lines, with and without leave to move."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from simulators.rig import registers as R
from tests.rig_endpoints import ROOT, simulated_rig

MOTIONS = {R.MOVE, R.HOME, R.MOVE_UNTIL_ABOVE, R.MOVE_UNTIL_BELOW, R.MOVE_STAGE}


def suite(url: str, *words: str, registers: str = "reference") -> str:
    """Run `pytest tests/hardware/test_rig.py --rig-url URL` and return what it said."""
    command = [sys.executable, "-m", "pytest", "tests/hardware/test_rig.py", "-n", "0", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "--rig-url", url, *words],
        cwd=ROOT,
        env={**os.environ, "RIG_MAP": registers},
        capture_output=True,
        text=True,
    )
    return done.stdout


@pytest.mark.parametrize("line", ["tcp", "rtu"])
def test_nothing_moves_without_leave_and_with_it_everything_passes(tmp_path: Path, line: str) -> None:
    where = ("--tcp", "0") if line == "tcp" else ("--rtu", str(tmp_path / "rig"))
    with simulated_rig(*where, "--truth", str(tmp_path), "--specimen", "linear") as url:
        assert "2 passed, 1 skipped" in suite(url)
        told = [json.loads(row) for row in (tmp_path / "rig-events.jsonl").read_text().splitlines()]
        assert not MOTIONS & {one["code"] for one in told if one["event"] == "command"}
        assert "3 passed" in suite(url, "--allow-motion")


def test_another_makers_rig_passes_by_its_file() -> None:
    with simulated_rig("--tcp", "0", "--registers", "grams", "--unit", "17") as url:
        assert "3 passed" in suite(url, "--allow-motion", registers="grams")


def test_the_wrong_file_is_told() -> None:
    with simulated_rig("--tcp", "0") as url:
        said = suite(url, registers="grams")
    assert "3 passed" not in said
    assert "error" in said
