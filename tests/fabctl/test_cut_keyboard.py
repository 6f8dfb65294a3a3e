"""No key is lost, and the one to stop counts before all others."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fabctl.cut.keyboard import keyboard


@pytest.fixture
def hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Return the far end of a terminal that is this process's standard input."""
    master, slave = os.openpty()
    with os.fdopen(slave, "r") as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        yield master
    os.close(master)


@pytest.mark.parametrize(
    ("typed", "wish"),
    [
        (b" ", "hold"),
        (b"r", "resume"),
        (b"S", "stop"),
        (b"x", ""),
        (b" s", "stop"),
        (b"r ", "hold"),
        (b"xxr", "resume"),
    ],
)
def test_keys_pressed_together_are_all_heard_at_once(hand: int, typed: bytes, wish: str) -> None:
    with keyboard() as pressed:
        assert pressed() == ""
        os.write(hand, typed)
        assert pressed() == wish
        assert pressed() == ""


def test_without_a_terminal_no_key_is_ever_pressed(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path(os.devnull).open(encoding="ascii") as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        with keyboard() as pressed:
            assert pressed() == ""
