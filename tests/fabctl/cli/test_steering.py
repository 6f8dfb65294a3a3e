"""Keys at a real terminal while a test runs."""

from __future__ import annotations

import os
import re
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


def load(k: float) -> Event:
    return Event("progress", f"load {k:g} N   26 s left", 0.5, {"depth_mm": k, "force_N": k, "step": "load"})


@pytest.fixture
def screen(hand: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return what is written to a terminal of 60 columns and 24 lines."""
    said: list[str] = []
    monkeypatch.setattr("click.echo", lambda text="", nl=True, **_: said.append(str(text) + "\n" * nl))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((60, 24)))
    return said


def shown(said: list[str]) -> list[str]:
    """Return the lines that such a terminal shows in the end: it knows up, clear below, and new lines."""
    lines = [""]
    for part in re.split(r"(\x1b\[\d*[A-Z])", "".join(said)):
        if match := re.fullmatch(r"\x1b\[(\d+)F", part):
            lines = [*lines[: -int(match[1]) - 1], ""]
        elif not part.startswith("\x1b"):
            first, *rest = part.split("\n")
            lines[-1] += first
            lines += rest
    return lines[:-1]


def test_what_is_told_stays_above_the_curve_and_nothing_is_left_of_the_old_one(screen: list[str]) -> None:
    with Keys(lambda event: screen.append(event.message + "\n")) as keys:
        for k in range(5):
            keys.listen(load(k))
        keys.listen(Event("warning", "the rig warms up"))
        for k in range(5, 9):
            keys.listen(load(k))
    lines = shown(screen)
    assert lines[0] == "the rig warms up"
    assert sum("s left" in line for line in lines) == 1
    assert sum(line.endswith("8.000 N") for line in lines) == 1
    assert lines[-1] == "space: pause   s: stop"
    assert len(lines) == 1 + 12 + 3


def test_no_line_is_broken_by_a_narrow_terminal(screen: list[str], hand: int) -> None:
    with Keys(silent) as keys:
        keys.go_on("Turn the specimen by ninety degrees, and see that the sphere is above its centre")
        for k in range(9):
            keys.listen(load(-1000.0 * k))
        os.write(hand, b" ")
        keys.wish()
    lines = shown(screen)
    assert max(len(line) for line in lines) < 60
    assert lines[-1].endswith("[Enter: go on, s: stop]")


def test_a_pause_says_how_it_ends(screen: list[str], hand: int) -> None:
    with Keys(silent) as keys:
        os.write(hand, b" ")
        keys.wish()
        keys.listen(load(1.0))
    assert shown(screen)[-1] == "space: go on   s: stop"


def test_a_run_of_hours_does_not_make_the_drawing_slow(screen: list[str]) -> None:
    with Keys(silent) as keys:
        for k in range(5000):
            keys._grow(load(float(k)))
        assert len(keys._curve) <= 1500
        assert (keys._curve[0][0] < 50, keys._curve[-1][0]) == (True, 4999.0)


def test_a_straight_line_is_drawn_from_corner_to_corner() -> None:
    lines = braille([(0.0, 0.0), (1.0, 1.0)], 4, 2)
    assert ord(lines[1][0]) > 0x2800
    assert ord(lines[0][3]) > 0x2800
