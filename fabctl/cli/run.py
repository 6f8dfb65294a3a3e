"""`fabctl run`: what was done, when, by whom, and how it ended."""

from __future__ import annotations

from pathlib import Path

import click

from fabctl.cli.common import json_option, lab, show
from fabctl.cli.figures import figures
from fabctl.cli.paths import RUN, SPECIMEN, OutFile
from fabctl.records.export import export
from fabctl.records.folder import status_of
from fabctl.records.index import Row, reindex, rows

KINDS = ("cut", "marks", "kerf-coupon", "calibrate", "indent", "scan", "coupon-read", "report")
STATUSES = ("done", "stopped", "failed", "refused", "running", "interrupted", "broken")


@click.group("run", no_args_is_help=True)
def command() -> None:
    """List, show and export run records."""


@command.command("list")
@click.option("--specimen", type=SPECIMEN, help="Only the runs of this specimen.")
@click.option("--kind", type=click.Choice(KINDS), help="Only runs of this kind.")
@click.option("--status", type=click.Choice(STATUSES), help="Only runs that ended so.")
@json_option
def list_runs(specimen: str | None, kind: str | None, status: str | None, as_json: bool) -> None:
    """List all runs, oldest first; a run that nothing ended is *interrupted*, one on simulators *simulated*."""
    found = [row for row in rows(lab().runs) if _fits(row, specimen, kind, status)]
    head = f"{'run':38} {'specimen':8} {'status':12} {'bench':9} result"
    lines = [head, *map(_line, found)] if found else []
    show(
        {"runs": [row.as_dict() for row in found]},
        as_json,
        lines or ["no such runs" if specimen or kind or status else "no runs yet"],
    )


def _line(row: Row) -> str:
    bench = {None: "-", True: "simulated", False: "real"}[row.simulated]
    said = row.message.splitlines()[0] if row.message else "-"
    return f"{row.run:38} {row.specimen or '-':8} {row.status:12} {bench:9} {said}"


def _fits(row: Row, specimen: str | None, kind: str | None, status: str | None) -> bool:
    asked = ((specimen, row.specimen), (kind, row.kind), (status, row.status))
    return all(want is None or want == have for want, have in asked)


@command.command("show")
@click.argument("run", type=RUN)
@json_option
def show_run(run: str, as_json: bool) -> None:
    """Show one run: what was asked, what came out, which files are there."""
    found = lab().run(run)
    manifest, result = found.manifest(), found.result() or {}
    files = sorted(str(p.relative_to(found.path)) for p in found.path.rglob("*") if p.is_file())
    state, outcome = status_of(found), found.outcome()
    message = str((outcome or {}).get("message") or "")
    lines = [
        f"{found.run_id}: {manifest['kind']}, {state}",
        f"specimen  {manifest.get('specimen') or '-'}",
        f"started   {manifest['started_utc']} by {manifest['operator']}",
        *(f"ended     {line.strip()}" for line in message.splitlines()),
        *(f"input     {item['path']}  {item['sha256'][:12]}" for item in manifest["inputs"]),
        *(f"result    {line}" for line in figures(result)),
        *(f"file      {name}" for name in files),
    ]
    data = {"run": found.run_id, "path": str(found.path), "status": state, "manifest": manifest, "result": result}
    show({**data, "outcome": outcome, "files": files}, as_json, lines)


@command.command("export")
@click.argument("run", type=RUN)
@click.option("-o", "--output", type=OutFile(), help="Archive to write [RUN.tar.gz].")
@json_option
def export_run(run: str, output: Path | None, as_json: bool) -> None:
    """Pack one run folder into a .tar.gz."""
    found = lab().run(run)
    target = output or Path(f"{found.run_id}.tar.gz")
    hashes = export(found, target)
    show({"archive": str(target), "sha256": hashes}, as_json, [f"{target}: {len(hashes)} files"])


@command.command("reindex")
@json_option
def reindex_runs(as_json: bool) -> None:
    """Read every run folder anew and rebuild the index from them."""
    found = reindex(lab().runs)
    show({"runs": len(found)}, as_json, [f"{len(found)} runs"])
