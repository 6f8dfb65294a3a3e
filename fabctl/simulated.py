"""Start and stop the processes that a bench file lists under `simulators`.

Each prints one line `ready URL` when it listens. What they are is not known here: a command is a command.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fabctl.bench import announced, remember
from fabctl.config.bench import BenchConfig
from fabctl.errors import DEVICE, FabctlError

READY_S = 30.0


class SimulatorError(FabctlError):
    """A simulator did not come up; carries what it said."""

    exit_code = DEVICE


def words(command: str, state: Path) -> list[str]:
    """Return the command's words, with the state folder and this Python put in."""
    found = [word.replace("{state}", str(state)) for word in shlex.split(command)]
    return [sys.executable, *found[1:]] if found[0] == "python" else found


def start(config: BenchConfig, state: Path, only: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Start every simulator of the bench that is not running; return name -> url, process.

    All or none: where one fails, those started by this call are stopped again and `SimulatorError` says why.
    """
    running = {name: facts for name, facts in announced(state).items() if alive(facts)}
    begun: dict[str, int] = {}
    try:
        for name, command in config.simulators.items():
            if name not in running and (not only or name in only):
                begun[name] = _spawn(name, words(command, state), state)
        for name, process in begun.items():
            running[name] = {"url": _await_ready(name, process, state), "process": process, "began": _began(process)}
    except BaseException:  # Ctrl-C too: all or none stay running
        for process in begun.values():
            _end(process)
        raise
    remember(state, running)
    return running


def stop(state: Path) -> list[str]:
    """Stop every running simulator of the bench; return their names."""
    stopped = []
    for name, facts in announced(state).items():
        if alive(facts):
            _end(int(facts["process"]))
            stopped.append(name)
    if announced(state):
        remember(state, {})
    return stopped


def alive(facts: dict[str, Any]) -> bool:
    """Tell whether the process that announced itself still runs (and is the same one)."""
    began = _began(int(facts["process"]))
    return began is not None and began == facts["began"]


def _spawn(name: str, command: list[str], state: Path) -> int:
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH", "")]))
    fresh = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    try:
        return os.posix_spawnp(
            command[0],
            command,
            {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"},
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                (os.POSIX_SPAWN_OPEN, 1, str(state / f"{name}.out"), fresh, 0o644),
                (os.POSIX_SPAWN_OPEN, 2, str(state / f"{name}.log"), fresh, 0o644),
            ],
            setsid=True,  # a Ctrl-C at the terminal must not stop the devices of a job that is stopping
        )
    except OSError as fault:
        raise SimulatorError(f"{name}: {command[0]}: {fault.strerror or fault}") from fault


def _await_ready(name: str, process: int, state: Path) -> str:
    until = time.monotonic() + READY_S
    while time.monotonic() < until:
        line, end, _ = (state / f"{name}.out").read_text(errors="replace").partition("\n")
        if end and line.startswith("ready "):
            return line.removeprefix("ready ").strip()
        if end or _began(process) is None:
            break
        time.sleep(0.02)
    said = (state / f"{name}.log").read_text(errors="replace").strip().splitlines()[-8:]
    raise SimulatorError("\n  ".join([f"{name} did not come up; its log ends:", *said]))


def _end(process: int, grace_s: float = 5.0) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGTERM)
    until = time.monotonic() + grace_s
    while _began(process) is not None and time.monotonic() < until:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(process, os.WNOHANG)
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGKILL)


def _began(process: int) -> str | None:
    """Return the moment the process began, in the kernel's ticks: a number that a reused id does not share."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(") ", 1)[1].split()
    except (OSError, IndexError):
        return None
    return None if fields[0] == "Z" else fields[19]
