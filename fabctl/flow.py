"""One specimen through every room: design, cut, indent, scan, report.

Each step is the command a person would type, run as a process of its own: what flow does and what the steps do alone
cannot differ, a step that dies takes nothing along, and Ctrl-C reaches the step that holds the machine directly.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from design.findings import Finding
from fabctl.bench import HELD, Bench
from fabctl.config.bench import BenchConfig
from fabctl.errors import BUG, DONE, OPERATOR, OUT_OF_TOLERANCE, FabctlError, UsageError
from fabctl.events import Emit, Event
from fabctl.records.ending import signals_heard
from fabctl.tether import VARIABLE, tether
from fabctl.workspace import Specimen, Workspace

Run = Callable[[Sequence[str]], tuple[int, dict[str, Any]]]


class StepFailed(FabctlError):
    """A step ended with an error, which it has already explained; flow ends with the same exit code."""

    def __init__(self, step: str, code: int, hint: str, findings: Sequence[Finding] = ()) -> None:
        super().__init__(step, code, hint, tuple(findings))
        self.step, self.code, self.hint, self.findings = step, code, hint, tuple(findings)
        self.exit_code = code

    def __str__(self) -> str:
        return f"flow ends at {self.step} (exit {self.code}); {self.hint}"


class _Terminated(BaseException):
    """SIGTERM or SIGHUP came to flow alone and must be handed on."""


@dataclass
class Flow:
    """What has been done so far."""

    specimen: str | None = None
    design: str | None = None
    steps: dict[str, dict[str, Any]] = field(default_factory=dict)
    out_of_tolerance: bool = False


@dataclass(frozen=True)
class Order:
    """What flow is to do; the words are handed to the steps."""

    bench: BenchConfig
    bench_name: str
    method: str
    tolerance_frac: float | None
    yes: bool
    seed: int = 0


def steps_until_cut(lab: Workspace, order: Order, spec: Path, target: Path | None, run: Run, emit: Emit) -> Flow:
    """Design and cut; return the flow with its new specimen."""
    flow = Flow()
    folder = _fresh_folder(lab.root / "out", spec.stem)
    words = ["design", "build", str(spec), "-o", str(folder)]
    words += ["--target", str(target)] if target is not None else []
    _step(flow, "design", words, run, emit, "mend what it names and start again")
    flow.design = str(folder)
    words = ["cut", "run", str(folder), "--bench", order.bench_name, *(["--yes"] if order.yes else [])]
    cut = _step(flow, "cut", words, run, emit, f"after mending: fabctl cut run {folder} --bench {order.bench_name}")
    flow.specimen = str(cut["specimen"])
    return flow


def steps_after_deployment(order: Order, flow: Flow, run: Run, emit: Emit) -> Flow:
    """Indent, scan and report a specimen that stands deployed on the bench."""
    assert flow.specimen is not None
    again = f"after mending: fabctl flow --continue {flow.specimen} --method {order.method} --bench {order.bench_name}"
    yes = ["--yes"] if order.yes else []
    words = ["indent", "run", flow.specimen, "--method", order.method, "--bench", order.bench_name, *yes]
    _step(flow, "indent", words, run, emit, again)
    words = ["scan", "run", flow.specimen, "--bench", order.bench_name, "--seed", str(order.seed)]
    words += ["--tolerance-frac", str(order.tolerance_frac)] if order.tolerance_frac is not None else []
    _step(flow, "scan", words, run, emit, f"or name a cloud: fabctl scan run {flow.specimen} CLOUD")
    _step(flow, "report", ["report", flow.specimen], run, emit, again)
    return flow


def continued(lab: Workspace, name: str) -> Flow:
    """Return the flow of a specimen that was cut; raise `UsageError` where it was not cut to the end."""
    specimen: Specimen = lab.specimen(name)
    cuts = [r for r in lab.runs_of(name, "cut") if (r.outcome() or {}).get("status") == "done"]
    if not cuts:
        raise UsageError(f"{name} was not cut to the end; `fabctl run list --specimen {name}` says what happened")
    return Flow(name, str(specimen.design))


def runner(lab: Workspace, bench: Bench) -> Run:
    """Return a function that runs one fabctl command in `lab` and returns its exit code and its JSON.

    The steps work under the lock that the flow holds on `bench`, so that nobody's job comes between two of them.
    """

    def run(words: Sequence[str]) -> tuple[int, dict[str, Any]]:
        command = [sys.executable, "-m", "fabctl", "--home", str(lab.root), *words, "--json"]
        path = os.pathsep.join(filter(None, [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH")]))
        with (
            _term_raises(),
            tether() as end,
            subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONPATH": path, HELD: str(bench.lock), VARIABLE: str(end)},
                pass_fds=(bench.lock, end),
            ) as process,
        ):
            said = _wait(process)
        try:
            found = json.loads(said) if said.strip() else {}
        except ValueError:
            return BUG, {}
        return process.returncode, found

    return run


def _wait(process: subprocess.Popen[str]) -> str:
    # A terminal's Ctrl-C reaches the step itself, which has a machine to stop: wait for it, however long that takes.
    interrupted: BaseException | None = None
    while True:
        try:
            said, _ = process.communicate()
            break
        except KeyboardInterrupt as fault:
            interrupted = fault
        except _Terminated:
            process.send_signal(signal.SIGTERM)
            interrupted = KeyboardInterrupt()
    if interrupted is not None:
        raise interrupted
    return said


@contextlib.contextmanager
def _term_raises() -> Iterator[None]:
    def raise_it(_signal: int, _frame: FrameType | None) -> None:
        raise _Terminated

    before = {kind: signal.signal(kind, raise_it) for kind in signals_heard() if kind != signal.SIGINT}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def _step(flow: Flow, name: str, words: Sequence[str], run: Run, emit: Emit, hint: str) -> dict[str, Any]:
    emit(Event("stage", f"── {name}"))
    code, found = run(words)
    if code not in (DONE, OUT_OF_TOLERANCE):
        if code == OPERATOR:
            raise StepFailed(name, OPERATOR, "stopped by the operator")
        raise StepFailed(name, code if code > 0 else BUG, hint, _findings(found))
    flow.out_of_tolerance |= code == OUT_OF_TOLERANCE
    flow.steps[name] = found
    return found


def _findings(found: dict[str, Any]) -> list[Finding]:
    """Return what a step found, which it has told the person itself; flow passes it on to programs."""
    return [
        Finding(
            row["code"],
            row["what"],
            row["level"],
            row["where"],
            row["remedy"] or "",
            row["value"],
            row["unit"] or "",
            row["limit"],
        )
        for row in found.get("findings", [])
    ]


def _fresh_folder(parent: Path, stem: str) -> Path:
    number = 1
    while (parent / f"{stem}-{number}").exists():
        number += 1
    return parent / f"{stem}-{number}"
