"""What is said on a terminal stands on a line of its own, and nothing of a live line stays beside it."""

from __future__ import annotations

import re
import sys

import pytest

from fabctl.cli.common import confirm, progress, say, show
from fabctl.events import Event


def screen(text: str) -> list[str]:
    """Return the lines that a terminal would show."""
    lines, column = [""], 0
    for part in re.findall(r"\x1b\[K|\r|\n|[^\x1b\r\n]+", text):
        if part == "\x1b[K":
            lines[-1] = lines[-1][:column]
        elif part == "\r":
            column = 0
        elif part == "\n":
            lines.append("")
            column = 0
        else:
            lines[-1] = lines[-1][:column] + part + lines[-1][column + len(part) :]
            column += len(part)
    return [line for line in lines if line]


def at_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)


def test_a_message_takes_the_place_of_the_live_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    at_a_terminal(monkeypatch)
    listen = progress()
    listen(Event("progress", "line 93 of 1120, 2:46 min left", 0.049))
    listen(Event("progress", "line 94", 0.05))
    assert screen(capsys.readouterr().err) == ["  5.0%  line 94"]
    listen(Event("progress", "line 93 of 1120, 2:46 min left", 0.049))
    say("stopped")
    listen(Event("progress", "line 93 of 1120, 2:46 min left", 0.049))
    listen(Event("stage", "homing"))
    assert screen(capsys.readouterr().err) == ["stopped", "homing"]


def test_work_of_unknown_length_is_seen_to_go_on_at_a_terminal_and_fills_no_log(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    progress()(Event("progress", "a pose found by the search"))
    assert capsys.readouterr().err == ""
    at_a_terminal(monkeypatch)
    progress()(Event("progress", "a pose found by the search"))
    assert screen(capsys.readouterr().err) == ["        a pose found by the search"]


def test_a_result_and_a_question_do_too(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    at_a_terminal(monkeypatch)
    listen = progress()
    listen(Event("progress", "line 93 of 1120, 2:46 min left", 0.049))
    show({}, False, ["cut"])
    said = capsys.readouterr()
    assert screen(said.err + said.out) == ["cut"]
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    listen(Event("progress", "line 93 of 1120, 2:46 min left", 0.049))
    assert confirm("Start?", yes=False) is False
    assert screen(capsys.readouterr().err)[0].startswith("Start? no")


def test_without_a_terminal_there_are_no_codes_and_a_line_a_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    listen = progress()
    for k in range(101):
        listen(Event("progress", "cutting", k / 100))
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert len(said.splitlines()) == 11
