"""With `--json` a refusal is one object of one shape on stdout, whatever the command and whatever the fault."""

from __future__ import annotations

import errno
import json
import sys
from pathlib import Path
from typing import Any

import click
import pytest

from design.errors import MeshError, NotConverged, OutOfLibrary
from design.findings import Finding
from drivers.errors import DeviceAlarm, DeviceTimeout, TransportError
from fabctl.cli.common import run_guarded, show
from fabctl.cli.main import cli
from fabctl.errors import BUG, DEVICE, OPERATOR, OUT_OF_TOLERANCE, REFUSED, USAGE, ConfigError, RefusedError, Stopped
from fabctl.flow import StepFailed

KEYS = {"code", "level", "where", "what", "value", "unit", "limit", "remedy"}


def leaves(command: click.Command, ctx: click.Context, words: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    if not isinstance(command, click.Group):
        return [words]
    found = []
    for name in command.list_commands(ctx):
        inner = command.get_command(ctx, name)
        assert inner is not None
        found += leaves(inner, click.Context(inner, info_name=name, parent=ctx), (*words, name))
    return found


COMMANDS = leaves(cli, click.Context(cli, info_name="fabctl"))


def answered(words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> tuple[int, Any]:
    """Return the exit code and the one object on stdout; fail where there is another shape than the documented one."""
    monkeypatch.setattr(sys, "argv", ["fabctl", *words])
    code = run_guarded(cli)
    said = capsys.readouterr()
    body = json.loads(said.out)
    assert said.err.strip()
    assert_refused(body, code)
    return code, body


def assert_refused(body: dict[str, Any], code: int) -> None:
    assert body["error"]
    assert body["exit_code"] == code != 0
    assert body["findings"]
    for finding in body["findings"]:
        assert set(finding) == KEYS
        assert finding["code"] == finding["code"].upper()
        assert finding["what"]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_answers_in_json_where_it_cannot_be_understood(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, body = answered([*words, "--json", "--no-such-option"], capsys, monkeypatch)
    assert code == USAGE
    assert body["findings"][0]["remedy"] == f"fabctl {' '.join(words)} --help"


@pytest.mark.parametrize("words", [(), ("nonsense",), ("cut",), ("camera", "board", "nonsense")], ids=" ".join)
def test_so_does_a_command_that_does_not_exist(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert answered([*words, "--json"], capsys, monkeypatch)[0] == USAGE


FAULTS: list[tuple[BaseException, int, dict[str, Any]]] = [
    (
        ConfigError(["lab.yaml:3: laser.url: Field required"]),
        USAGE,
        {"code": "CONFIG", "where": "lab.yaml:3", "what": "laser.url: Field required"},
    ),
    (
        OutOfLibrary(0.9, 1.9, (1.2, 1.6)),
        REFUSED,
        {"code": "OUT-OF-LIBRARY", "value": [0.9, 1.9], "unit": "ratio", "limit": [1.2, 1.6]},
    ),
    (
        NotConverged("the shell", float("nan"), 40, "smaller steps"),
        REFUSED,
        {"code": "NOT-CONVERGED", "value": None, "remedy": "smaller steps"},
    ),
    (
        RefusedError("the cut", [Finding("CUT-X", "wide", "error", "", "smaller", 310.0, "mm", 300.0)]),
        REFUSED,
        {"code": "CUT-X", "what": "wide", "value": 310.0, "unit": "mm", "limit": 300.0, "remedy": "smaller"},
    ),
    (MeshError("dome.obj", [Finding("MESH-NAN", "no numbers", where="dome.obj")]), REFUSED, {"code": "MESH-NAN"}),
    (RefusedError("nothing to say", []), REFUSED, {"code": "REFUSED", "what": "nothing to say"}),
    (FileNotFoundError(errno.ENOENT, "No such file", "a.obj"), USAGE, {"code": "FILE", "where": "a.obj"}),
    (OSError(errno.ENOSPC, "No space left on device", "s.csv"), DEVICE, {"code": "STORAGE", "where": "s.csv"}),
    (TransportError("tcp://x:1", "no answer", "plug it in"), DEVICE, {"where": "tcp://x:1", "remedy": "plug it in"}),
    (DeviceTimeout("rig", "a sample", 0.5), DEVICE, {"code": "DEVICE-TIMEOUT", "value": 0.5, "unit": "s"}),
    (DeviceAlarm("laser", 9, "homing failed"), DEVICE, {"code": "DEVICE-ALARM", "value": 9}),
    (Stopped("by the operator"), OPERATOR, {"code": "STOPPED"}),
    (
        StepFailed("indent", REFUSED, "try again", [Finding("RIG-DOWN", "it is low", "error", "", "", 8.4, "mm", 1.0)]),
        REFUSED,
        {"code": "RIG-DOWN", "value": 8.4, "unit": "mm", "limit": 1.0},
    ),
    (KeyboardInterrupt(), OPERATOR, {"code": "STOPPED"}),
    (click.exceptions.Abort(), OPERATOR, {"code": "STOPPED"}),
    (ZeroDivisionError("division by zero"), BUG, {"code": "BUG"}),
]


@pytest.mark.parametrize(("fault", "code", "says"), FAULTS, ids=lambda value: type(value).__name__)
def test_every_kind_of_fault_is_told_with_its_numbers(
    fault: BaseException,
    code: int,
    says: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    @click.command()
    @click.option("--json", is_flag=True)
    def command(json: bool) -> None:
        raise fault

    monkeypatch.setattr(sys, "argv", ["fabctl", "--json"])
    assert run_guarded(command) == code
    body = json.loads(capsys.readouterr().out)
    assert_refused(body, code)
    assert body["findings"][0].items() >= says.items()


def test_a_number_out_of_range_is_told_with_unit_and_range(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["target", "make", "cap", "-o", str(tmp_path / "cap.obj"), "--half-angle-deg", "400", "--json"]
    found = answered(words, capsys, monkeypatch)[1]["findings"][0]
    told = {"where": "--half-angle-deg", "value": 400.0, "unit": "deg", "limit": [5, 150]}
    assert found.items() >= told.items()


def test_an_answer_that_is_a_no_has_the_same_shape(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    @click.option("--json", "as_json", is_flag=True)
    def command(as_json: bool) -> None:
        off = Finding("CUT-MISSING", "3 slits are not cut")
        show({"slits_count": 3, "findings": [off.as_dict()]}, as_json, [], OUT_OF_TOLERANCE, "not as designed")

    monkeypatch.setattr(sys, "argv", ["fabctl", "--json"])
    assert run_guarded(command) == OUT_OF_TOLERANCE
    said = capsys.readouterr()
    body = json.loads(said.out)
    assert_refused(body, OUT_OF_TOLERANCE)
    assert body["slits_count"] == 3
    assert said.err == "fabctl: not as designed\n  error CUT-MISSING: 3 slits are not cut\n"


def test_a_no_without_findings_of_its_own_is_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    @click.option("--json", "as_json", is_flag=True)
    def command(as_json: bool) -> None:
        show({"report": "x.html"}, as_json, [], OUT_OF_TOLERANCE, "2 mm off")

    monkeypatch.setattr(sys, "argv", ["fabctl", "--json"])
    assert run_guarded(command) == OUT_OF_TOLERANCE
    assert_refused(json.loads(capsys.readouterr().out), OUT_OF_TOLERANCE)
