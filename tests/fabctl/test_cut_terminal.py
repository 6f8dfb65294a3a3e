"""`fabctl cut run` at a terminal: the question, the keys, Ctrl-C once and twice, as a hand on a keyboard does them."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import subprocess
import sys
import termios
import time

import pytest

from tests.fabctl.test_cut_cli import ROOT, Lab, assert_dark, burnt_length_mm, lab, make_design

__all__ = ["lab"]  # the fixture
WAIT_S = 60.0


class Terminal:
    """A program whose screen and keyboard are one pseudo terminal, which also controls it."""

    def __init__(self, command: list[str]) -> None:
        self._master, slave = os.openpty()

        def take_the_terminal() -> None:
            os.setsid()
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=slave, cwd=ROOT, preexec_fn=take_the_terminal
        )
        os.close(slave)
        self.screen = ""

    def type(self, keys: str) -> None:
        with contextlib.suppress(OSError):  # the program may have ended
            os.write(self._master, keys.encode())

    def read(self, wait_s: float = 0.05) -> None:
        ready, _, _ = select.select([self._master], [], [], wait_s)
        if ready:
            with contextlib.suppress(OSError):  # the last one at the other side has gone
                self.screen += os.read(self._master, 65536).decode(errors="replace")

    def until(self, text: str) -> None:
        end_s = time.monotonic() + WAIT_S
        while text not in self.screen:
            if time.monotonic() > end_s or self.process.poll() is not None:
                self.read()
                assert text in self.screen, self.screen
            self.read()

    def end(self) -> int:
        end_s = time.monotonic() + WAIT_S
        while self.process.poll() is None and time.monotonic() < end_s:
            self.read()
        self.read(0.0)  # what it said last
        self.process.kill()
        self.process.wait()
        os.close(self._master)
        return self.process.returncode


def cutting(lab: Lab) -> Terminal:
    """Start a cut, answer its question by hand, and return once something burns."""
    design = make_design(lab.home / "design", slits=40)  # long enough not to end before it is stopped
    command = [sys.executable, "-m", "fabctl", "--home", str(lab.home), "cut", "run", str(design)]
    terminal = Terminal([*command, "--bench", str(lab.bench)])
    terminal.until("Start?")
    terminal.type("y\n")
    terminal.until("cutting,")
    end_s = time.monotonic() + WAIT_S
    while burnt_length_mm(lab.beam()) < 5:
        assert time.monotonic() < end_s, terminal.screen
        terminal.read()
    return terminal


def test_space_holds_r_resumes_and_s_stops(lab: Lab) -> None:
    terminal = cutting(lab)
    terminal.type(" ")
    terminal.until("held")
    before = len(lab.beam())
    terminal.type("r")
    end_s = time.monotonic() + WAIT_S
    while len(lab.beam()) < before + 5:
        assert time.monotonic() < end_s, terminal.screen
        terminal.read()
    terminal.type("s")
    assert terminal.end() == 5, terminal.screen
    assert json.loads((lab.only_run() / "outcome.json").read_text())["status"] == "stopped"
    assert_dark(lab)


@pytest.mark.parametrize("second_s", [None, 0.0, 0.02, 0.2])  # none; in mid-hold; on the way out
def test_ctrl_c_stops_dark_and_a_second_one_does_not_leave_it_lit(lab: Lab, second_s: float | None) -> None:
    terminal = cutting(lab)
    terminal.type("\x03")
    if second_s is not None:
        terminal.read(second_s)
        terminal.type("\x03")
    assert terminal.end() == 5, terminal.screen
    assert json.loads((lab.only_run() / "outcome.json").read_text())["status"] == "stopped"
    assert "Traceback" not in terminal.screen
    assert_dark(lab)
