"""Keys at a real terminal while a test runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator

import pytest

from fabctl.cli.steering import Keys, braille
from fabctl.events import Event, silent


@pytest.fixture
def hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Return the other end of the terminal that standard input is."""
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        yield ours
    os.close(ours)


def test_space_pauses_and_goes_on_and_a_stop_is_not_taken_back(hand: int) -> None:
    with Keys(silent) as keys:
        assert keys.wish() == "go"
        os.write(hand, b" ")
        assert keys.wish() == "pause"
        os.write(hand, b" ")
        assert keys.wish() == "go"
        os.write(hand, b"s ")
        assert keys.wish() == "stop"
        os.write(hand, b" ")
        assert keys.wish() == "stop"


def test_keys_that_were_pressed_together_all_count(hand: int) -> None:
    with Keys(silent) as keys:
        os.write(hand, b" s")
        assert keys.wish() == "stop"


def test_a_wait_ends_with_enter(hand: int) -> None:
    with Keys(silent) as keys:
        assert not keys.go_on("turn the specimen")
        os.write(hand, b"\n")
        assert keys.go_on("turn the specimen")


def test_the_curve_grows_on_the_terminal(hand: int, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr("click.echo", lambda text="", **_: said.append(str(text)))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with Keys(silent) as keys:
        for k in range(20):
            keys.listen(Event("progress", f"{k} s left", data={"depth_mm": k, "force_N": k * k, "step": "load"}))
    drawn = [sum(0x2800 < ord(c) < 0x2900 for c in text) for text in said]
    assert drawn[-1] > drawn[5] > 0
    assert "19 s left" in said[-1]


def test_a_straight_line_is_drawn_from_corner_to_corner() -> None:
    lines = braille([(0.0, 0.0), (1.0, 1.0)], 4, 2)
    assert ord(lines[1][0]) > 0x2800
    assert ord(lines[0][3]) > 0x2800
