"""`fabctl library build` killed at moments drawn by lot, and gone on with: the same file, bit for bit."""

from __future__ import annotations

import os
import random
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from design.cells import library, sweep
from design.cells.homogenise import solve_cell
from design.cells.sheet import Sheet
from fabctl.cli.main import cli

KILLS_COUNT = 12
WATCHED = {sweep.__file__: {"sweep", "_read_part", "_write_part"}, library.__file__: {"save_library"}}


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile once, here: the processes below are forks of this one."""
    solve_cell(1.0, 0.0, Sheet())


def build_or_die(home: Path, lines_count: int | None) -> int:
    """Build in a fork that kills itself after so many lines of the code that keeps parts; return the wait status."""
    child = os.fork()
    if child == 0:
        try:
            if lines_count is not None:
                sys.settrace(_killer(lines_count))
            words = ["--home", str(home), "library", "build", "--theta", "5", "--t-step-mm", "0.8", "--jobs", "1"]
            cli.main([*words, "-o", str(home / "library.npz")], standalone_mode=False)
        finally:
            os._exit(0 if sys.exc_info()[0] is None else 1)
    return os.waitpid(child, 0)[1]


def _killer(lines_count: int) -> Any:
    left = lines_count

    def count(frame: FrameType, event: str, _: object) -> Any:
        nonlocal left
        left -= event == "line"
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return count

    def enter(frame: FrameType, event: str, _: object) -> Any:
        return count if frame.f_code.co_name in WATCHED.get(frame.f_code.co_filename, ()) else None

    return enter


def parts_of(home: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in home.rglob("column-*.json")}


def moments(seed: int) -> Iterator[int]:
    """Yield how many lines each attempt lives: few, so that attempts die in every part of the work."""
    draw = random.Random(seed)
    yield from (draw.randrange(1, 60) for _ in range(KILLS_COUNT))


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("calm")
    assert build_or_die(home, None) == 0
    return home


@pytest.mark.parametrize("seed", [1, 2])
def test_a_build_killed_again_and_again_ends_in_the_same_file(seed: int, calm: Path, tmp_path: Path) -> None:
    torn = tmp_path
    deaths = 0
    for lines_count in moments(seed):
        kept = parts_of(torn)
        status = build_or_die(torn, lines_count)
        deaths += os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
        after = parts_of(torn)
        assert {path: after[path] for path in kept} == kept  # a column that is there is not solved again
    assert deaths >= 5
    assert build_or_die(torn, None) == 0
    assert (torn / "library.npz").read_bytes() == (calm / "library.npz").read_bytes()
    for path in parts_of(calm):
        assert (torn / path.relative_to(calm)).read_bytes() == path.read_bytes()
