"""`fabctl library build`: simulate every cell of a sheet, on this machine or on many."""

from __future__ import annotations

import re
import socket
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import json_option, lab, progress, say, show
from fabctl.cli.library_parts import jobs_option, lines_of, material_option, processes_of, sheet_named, summary
from fabctl.cli.paths import OutFile
from fabctl.errors import ClusterAway, UsageError, WorkerDied

if TYPE_CHECKING:
    from design.cells.sweep import Progress

REACH_S = 5.0  # a scheduler that takes longer to be reached is not there


@click.command()
@material_option
@click.option(
    "--theta", "theta_count", type=click.IntRange(5, 1001), default=43, show_default=True, help="Angles, -30° to 30°."
)
@click.option("--t-step-mm", type=click.FloatRange(0.001, 10), default=0.01, show_default=True, help="Step of t.")
@click.option(
    "--open", "is_open", is_flag=True, help="The contracting kind: cut as holes, closing to its second state."
)
@jobs_option
@click.option("--cluster", metavar="URL", help="A dask scheduler, tcp://HOST:PORT, whose workers have fabctl.")
@click.option(
    "-o",
    "--output",
    type=OutFile((".npz",), "a library"),
    default=Path("library.npz"),
    show_default=True,
    help="The library file to write.",
)
@json_option
def build(
    material: str,
    theta_count: int,
    t_step_mm: float,
    is_open: bool,
    jobs: int,
    cluster: str | None,
    output: Path,
    as_json: bool,
) -> None:
    """Simulate every cell of a sheet; goes on where an earlier build stopped."""
    processes = processes_of(jobs)
    if cluster is not None:
        _reach(cluster)
    from design.cells.sweep import plan_of, sweep

    sheet = sheet_named(material)
    plan = plan_of(sheet, theta_count, t_step_mm, kind="open" if is_open else "slit")
    parts = lab().root / "library-cache"
    report = _progress()
    try:
        cells = sweep(plan, parts, jobs=processes, cluster=cluster, report=report)
    except KeyboardInterrupt:
        say(f"stopped; finished columns are kept in {parts / plan.key()[:16]}, the same command goes on from there")
        raise
    except BrokenProcessPool as fault:
        kept = f"finished columns are kept in {parts / plan.key()[:16]}, the same command goes on from there"
        raise WorkerDied(f"a worker process died, perhaps for want of memory; {kept}") from fault
    from design.cells.library import load_library, save_library

    words = f"fabctl library build --material {material} --theta {theta_count} --t-step-mm {t_step_mm:g}"
    save_library(output, plan, sheet, cells, words + (" --open" if is_open else ""))
    library = load_library(output)
    show({"file": str(output), **summary(library)}, as_json, [f"{output}", *lines_of(library)])


def _reach(address: str) -> None:
    """Raise where nobody listens at `address`; dask would wait for half a minute and not say for whom."""
    parted = re.fullmatch(r"(?:tcp|tls)://(\[[^\]]+\]|[^:/]+):(\d{1,5})", address)
    if parted is None or int(parted[2]) > 65535:
        raise UsageError(f"--cluster takes tcp://HOST:PORT, not {address!r}")
    try:
        socket.create_connection((parted[1].strip("[]"), int(parted[2])), REACH_S).close()
    except OSError as fault:
        raise ClusterAway(f"no scheduler answers at {address}: {fault}; start one with `dask scheduler`") from fault


def _progress() -> Any:
    from fabctl.events import Event

    listen = progress()

    def report(now: Progress) -> None:
        left = "" if now.left_s is None else f", {now.left_s:.0f} s left"
        text = f"{now.done_count} of {now.total_count} cells, {now.elapsed_s:.0f} s{left}"
        listen(Event("progress", text, now.done_count / now.total_count))

    return report
