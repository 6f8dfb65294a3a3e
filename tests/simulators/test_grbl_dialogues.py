"""The simulated board answers recorded dialogues as the real firmware did."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks._laser_dialogues import NAMES, POSITION, board_time, differences, replay, rows_of


@pytest.mark.parametrize("name", NAMES)
def test_a_recorded_dialogue_gets_the_same_answers(shared: Path, name: str) -> None:
    assert differences(rows_of(shared / "laser" / "grbl-1.1h-dialogues" / f"{name}.jsonl")) == []


def test_every_recorded_dialogue_is_replayed(shared: Path) -> None:
    assert {path.stem for path in (shared / "laser" / "grbl-1.1h-dialogues").glob("*.jsonl")} == set(NAMES)


def test_reported_positions_follow_the_recorded_ones(shared: Path) -> None:
    rows = rows_of(shared / "laser" / "grbl-1.1h-dialogues" / "feed-hold.jsonl")
    recorded = b"".join(row.data for row in rows if not row.sent).decode("latin-1")
    simulated = "\n".join(replay(rows, board_time(rows)))
    apart_mm = [
        abs(float(a[0]) - float(b[0]))
        for a, b in zip(POSITION.findall(recorded), POSITION.findall(simulated), strict=True)
    ]
    assert max(apart_mm) < 0.4  # 16 ms of host jitter at 25 mm/s
