"""The command line starts light, names its nouns, and ends with the agreed exit codes."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest

from design.errors import MeshError
from design.findings import Finding
from drivers.errors import TransportError
from fabctl.cli.common import run_guarded
from fabctl.errors import (
    BUG,
    DEVICE,
    DONE,
    OPERATOR,
    OUT_OF_TOLERANCE,
    REFUSED,
    USAGE,
    BenchBusy,
    ConfigError,
    RefusedError,
    Stopped,
)

ROOT = Path(__file__).resolve().parents[3]


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys; sys.argv = ['fabctl', '--help']\n"
        "try:\n    from fabctl.cli.main import main; main()\n"
        "except SystemExit: pass\n"
        "print(*sorted({name.split('.')[0] for name in sys.modules}))"
    )
    said = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    loaded = set(said.splitlines()[-1].split())
    heavy = {"numpy", "scipy", "open3d", "cv2", "ezdxf", "igl", "matplotlib", "pydantic", "yaml", "serial", "pymodbus"}
    assert loaded & heavy == set()


FAULTS = [
    (None, DONE),
    (ConfigError(["lab.yaml:3: laser.url: Field required"]), USAGE),
    (click.UsageError("no such option"), USAGE),
    (FileNotFoundError(errno.ENOENT, "No such file or directory", "dome.obj"), USAGE),
    (MeshError("dome.obj cannot be used", [Finding("MESH-NAN", "3 vertices are not numbers")]), REFUSED),
    (RefusedError("the cut is refused", [Finding("CUT-X", "too wide")]), REFUSED),
    (TransportError("serial:///dev/ttyUSB0", "no such port"), DEVICE),
    (BenchBusy("in use"), DEVICE),
    (OSError(errno.ENOSPC, "No space left on device", "samples.csv"), DEVICE),
    (Stopped("by the operator"), OPERATOR),
    (KeyboardInterrupt(), OPERATOR),
    (ZeroDivisionError("division by zero"), BUG),
]


@pytest.mark.parametrize(("fault", "code"), FAULTS, ids=lambda value: type(value).__name__)
def test_every_kind_of_fault_has_its_exit_code(
    fault: BaseException | None, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    def command() -> None:
        if fault is not None:
            raise fault

    monkeypatch.setattr(sys, "argv", ["fabctl"])
    assert run_guarded(command) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert ("Traceback" in said.err) == (code == BUG)


def test_a_refusal_names_all_its_findings(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    @click.command()
    def command() -> None:
        raise RefusedError("the cut is refused", [Finding("CUT-X", "too wide"), Finding("CUT-S", "too strong")])

    monkeypatch.setattr(sys, "argv", ["fabctl"])
    assert run_guarded(command) == REFUSED
    assert {"CUT-X", "CUT-S"} <= set(capsys.readouterr().err.replace(":", " ").split())


WAY_OUT = """
import os, signal, sys, click
from fabctl.cli import common
from fabctl.errors import Stopped

def interrupt(*_):
    os.kill(os.getpid(), signal.{name})

@click.command()
def command():
    raise Stopped("stopped")

sys.argv = ["fabctl"]
common.say = interrupt if {early} else common.say
code = common.run_to_the_end(command)
interrupt()
sys.exit(code)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("early", [True, False])
def test_a_second_interrupt_on_the_way_out_changes_no_exit_code(name: str, early: bool) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WAY_OUT.format(name=name, early=early)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == OPERATOR, done.stderr
    assert "Traceback" not in done.stderr


def test_a_terminal_without_greek_letters_ends_no_command() -> None:
    script = (
        "import sys, click; from fabctl.cli import main; sys.argv = ['fabctl']\n"
        "main.cli = click.Command('x', callback=lambda: click.echo('θ')); main.main()"
    )
    line = [sys.executable, "-c", script]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "latin-1"})
    assert done.returncode == DONE, done.stderr
    assert done.stdout == b"\\u03b8\n"


def test_a_full_disk_behind_stdout_is_the_disks_fault() -> None:
    with Path("/dev/full").open("w") as full:
        line = [sys.executable, "-m", "fabctl", "target", "list", "--json"]
        done = subprocess.run(line, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == DEVICE
    assert "no space left" in done.stderr
    assert "Traceback" not in done.stderr


TALKING = """
import signal, sys, click
from fabctl.cli import common
from fabctl.events import Event

@click.command()
def command():
    sys.stdin.read()  # until the reader is gone
    tell = common.progress()
    for k in range(100):
        tell(Event("progress", "line", k / 100))
        tell(Event("stage", "stage"))
    {before}
    common.show({{"done": True}}, {as_json}, ["done"], common.DONE if {good} else 6, "too far off")

sys.argv = ["fabctl"]
sys.exit(common.run_to_the_end(command))
"""


def talk(out: int, err: int, close: int, **words: object) -> int:
    """Run a job that talks after the reader of its pipe `close` is gone; return its exit code."""
    line = [sys.executable, "-c", TALKING.format(**{"before": "", "as_json": True, "good": True, **words})]
    process = subprocess.Popen(line, cwd=ROOT, stdin=subprocess.PIPE, stdout=out, stderr=err)
    os.close(close)
    process.communicate()
    return process.returncode


@pytest.mark.parametrize(("good", "code"), [(True, DONE), (False, OUT_OF_TOLERANCE)])
def test_a_reader_of_progress_that_goes_away_ends_no_job(tmp_path: Path, good: bool, code: int) -> None:
    reader, writer = os.pipe()
    with (tmp_path / "out").open("w") as out:
        assert talk(out.fileno(), writer, reader, good=good) == code
    os.close(writer)
    assert json.loads((tmp_path / "out").read_text())["done"]


@pytest.mark.parametrize("as_json", [True, False])
def test_readers_of_everything_that_go_away_change_no_exit_code(as_json: bool) -> None:
    reader, writer = os.pipe()
    assert talk(writer, writer, reader, good=False, as_json=as_json) == OUT_OF_TOLERANCE
    os.close(writer)


@pytest.mark.parametrize("before", ["raise common.Stopped('no')", "signal.raise_signal(signal.SIGHUP)"])
def test_a_closed_terminal_or_a_stop_with_no_reader_is_still_the_operators(before: str) -> None:
    reader, writer = os.pipe()
    assert talk(writer, writer, reader, before=before) == OPERATOR
    os.close(writer)


def test_what_nohup_started_lives_through_a_hang_up() -> None:
    script = TALKING.format(before="signal.raise_signal(signal.SIGHUP)", as_json=True, good=True)
    line = ["nohup", sys.executable, "-c", script]
    done = subprocess.run(line, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert done.returncode == DONE, done.stderr


CLOSING = """
import os, pathlib, signal, sys, click
from fabctl.cli import common
from fabctl.records.folder import start_run

@click.command()
@click.argument("runs")
def command(runs):
    run = start_run(pathlib.Path(runs), "scan")
    try:
        print("begun", flush=True)
        signal.pause()
    except KeyboardInterrupt:
        os.kill(os.getpid(), signal.SIGTERM)  # the group's, and then the flow's: it is delivered before kill returns
        run.finish("stopped", "stopped by the operator")
        raise

sys.exit(common.run_to_the_end(command))
"""


def test_signals_that_come_together_leave_a_record_of_how_the_run_ended(tmp_path: Path) -> None:
    line = [sys.executable, "-c", CLOSING, str(tmp_path / "runs")]
    process = subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    process.terminate()
    _, err = process.communicate()
    assert process.returncode == OPERATOR, err
    (run,) = (tmp_path / "runs").iterdir()
    assert '"stopped"' in (run / "outcome.json").read_text()
