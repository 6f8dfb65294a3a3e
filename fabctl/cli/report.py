"""`fabctl report`: one HTML file about a specimen."""

from __future__ import annotations

from pathlib import Path

import click

from fabctl.cli.common import json_option, lab, show
from fabctl.cli.paths import SPECIMEN, OutFile


@click.command("report")
@click.argument("specimen", type=SPECIMEN)
@click.option("-o", "--output", type=OutFile(), help="Where to write it [a new report run folder].")
@json_option
def command(specimen: str, output: Path | None, as_json: bool) -> None:
    """Write one self-contained HTML file about SPECIMEN: verdict, pattern, curve, deviation map, provenance."""
    from fabctl.records.folder import start_run, write_atomically
    from fabctl.reports.page import render
    from fabctl.reports.specimen import specimen_report

    home = lab()
    found = home.specimen(specimen)
    report = specimen_report(home, found)
    run = start_run(home.runs, "report", specimen=found.name)
    target = output or run.artefact(f"{found.name}.html")
    write_atomically(target, render(report))
    data = {
        "specimen": found.name,
        "verdict": report.word,
        "sentence": report.sentence,
        "reasons": list(report.reasons),
    }
    data["report"] = str(target)
    run.write_result(data)
    run.finish("done", f"{report.word}: {report.sentence}")
    show(data, as_json, [f"{report.word}: {report.sentence}", *report.reasons, str(target)])
