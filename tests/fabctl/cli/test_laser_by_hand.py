"""`fabctl laser` moves nothing that it was not allowed to."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from benchmarks._laser_rig import Rig
from drivers.grbl.laser import Laser
from fabctl.cli import laser as by_hand
from fabctl.config.bench import LaserConfig
from fabctl.errors import RefusedError

BENCH = SimpleNamespace(
    config=SimpleNamespace(name="small", laser=LaserConfig(url="tcp://x:1", travel_mm=(300.0, 200.0)))
)


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    rig = Rig()

    @contextmanager
    def laser(_bench: str, _purpose: str) -> Iterator[tuple[Laser, Any]]:
        with Laser(rig.revive(), rig.clock) as found:
            found.connect()
            yield found, BENCH

    monkeypatch.setattr(by_hand, "_laser", laser)
    return rig


@pytest.mark.parametrize("words", [["frame", "400", "10"], ["testgrid", "--powers", "0.5", "--feeds", "200"]])
def test_what_would_be_refused_is_not_asked_for(rig: Rig, words: list[str]) -> None:
    found = CliRunner().invoke(by_hand.command, words)
    assert isinstance(found.exception, RefusedError)
    assert "?" not in found.output


def steps(rig: Rig) -> tuple[int, int, int]:
    return rig.board.machine.position_steps()


@pytest.mark.parametrize(
    "words",
    [
        ["jog", "-5", "0"], ["home"], ["unlock"], ["frame", "10", "10"], ["settings", "32=0"],
        ["testgrid", "--powers", "0.5", "--feeds", "20"],
    ],
)  # fmt: skip
def test_what_moves_burns_or_writes_waits_for_a_yes(rig: Rig, words: list[str]) -> None:
    CliRunner().invoke(by_hand.command, ["jog", "-50", "-50", "--yes"])  # where there is room
    before = steps(rig), dict(rig.board.machine.memory.values)
    found = CliRunner().invoke(by_hand.command, words)
    assert found.exit_code == 1  # the command line makes it 5
    assert "--yes answers yes" in found.output
    assert (steps(rig), dict(rig.board.machine.memory.values)) == before
    assert all(point.power_frac == 0 for point in rig.trace)


def test_a_jog_goes_where_it_was_told(rig: Rig) -> None:
    found = CliRunner().invoke(by_hand.command, ["jog", "-5", "-2.5", "--yes", "--json"])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["machine_mm"] == [-6.0, -3.5, -1.0]
    assert all(point.power_frac == 0 for point in rig.trace)


def test_a_dark_frame_comes_back_and_burns_nothing(rig: Rig) -> None:
    CliRunner().invoke(by_hand.command, ["jog", "-50", "-50", "--yes"])
    before = steps(rig)
    found = CliRunner().invoke(by_hand.command, ["frame", "20", "10", "--yes", "--json"])
    assert found.exit_code == 0, found.output
    assert steps(rig) == before
    assert all(point.power_frac == 0 for point in rig.trace)
    assert max(point.x_mm for point in rig.trace) > before[0] / 250 + 19
