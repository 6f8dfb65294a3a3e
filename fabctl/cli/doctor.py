"""`fabctl doctor`: what of this machine and bench works, and what to type where it does not."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING

import click

from fabctl.cli.common import json_option, lab, show
from fabctl.cli.paths import config_names
from fabctl.errors import DEVICE, DONE

if TYPE_CHECKING:
    from fabctl.health import Check


@click.command("doctor")
@click.option(
    "--bench",
    "bench_name",
    type=config_names("benches"),
    help="Also look at this bench's devices (asks each who it is; nothing moves).",
)
@json_option
def command(bench_name: str | None, as_json: bool) -> None:
    """Say what of this machine and bench works. Nothing moves and nothing is written."""
    from design.findings import Finding
    from fabctl.health import bench_checks, machine_checks

    home = lab()
    checks = []
    for check in chain(machine_checks(home), bench_checks(home, bench_name) if bench_name is not None else ()):
        checks.append(check)
        if not as_json:
            click.echo(_line(check))  # at once: a library that loads slowly, or a silent device, takes seconds
    good = all(c.works for c in checks)
    bad = [Finding("DOCTOR", c.detail, where=c.what, hint=c.hint) for c in checks if not c.works]
    data = {"works": good, "checks": [c.as_dict() for c in checks], "findings": [f.as_dict() for f in bad]}
    show(data, as_json, (), DONE if good else DEVICE, f"{len(bad)} of {len(checks)} do not work")


def _line(check: Check) -> str:
    mark = "ok  " if check.works else "FAIL"
    return f"{mark} {check.what:28} {check.detail}" + (f"\n       {check.hint}" if check.hint else "")
