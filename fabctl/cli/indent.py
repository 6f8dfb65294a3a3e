"""`fabctl indent`: record, analyse, compare and export force against displacement."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import bench_option, confirm, json_option, lab, progress, say, show, yes_option
from fabctl.cli.paths import RUN, RUN_OR_SPECIMEN, SPECIMEN, OutFile, PictureFile, config_names

if TYPE_CHECKING:
    from fabctl.indent.job import IndentPlan
    from fabctl.records.folder import RunFolder

NAMED = (
    ("stiffness at contact", "stiffness_initial_N_mm", "N/mm"),
    ("secant stiffness", "stiffness_secant_N_mm", "N/mm"),
    ("largest force", "force_max_N", "N"),
    ("energy in", "load_energy_mJ", "mJ"),
    ("hysteresis", "hysteresis_ratio", "%"),
    ("barrier", "barrier_mJ", "mJ"),
    ("recovery", "recovery_ratio", "%"),
)
HELD = (("relaxation", "relaxation_ratio", "%"), ("creep", "creep_mm", "mm"))  # told only where a method holds
LINES_TOLD_COUNT = 5
WORDS = {name: words for words, name, _ in NAMED}


@click.group()
def command() -> None:
    """Record and analyse force against displacement."""


@command.command("run")
@click.argument("specimen", type=SPECIMEN)
@click.option(
    "--method",
    type=config_names("methods"),
    default="dome",
    show_default=True,
    help="Method file or its name in configs/methods.",
)
@bench_option
@click.option(
    "--resume", type=RUN, metavar="RUN", help="Go on with an interrupted run, at its next whole curve or point."
)
@click.option(
    "--temperature-degC",
    type=click.FloatRange(-50, 150),
    help="Room temperature, where the rig has no sensor of its own.",
)
@click.option("--humidity-frac", type=click.FloatRange(0, 1), help="Relative humidity, 0 to 1.")
@click.option("--thickness-mm", type=click.FloatRange(0, 100, min_open=True), help="As measured on this specimen.")
@click.option("--batch", help="Of the material.")
@click.option("--rest-h", type=click.FloatRange(0, 100_000), help="Hours since it was deployed, or last pressed.")
@click.option("--dry-run", is_flag=True, help="Stop after the check; nothing moves.")
@yes_option
@json_option
def run_command(
    specimen: str,
    method: str,
    bench_name: str,
    resume: str | None,
    temperature_degc: float | None,
    humidity_frac: float | None,
    thickness_mm: float | None,
    batch: str | None,
    rest_h: float | None,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> None:
    """Press a SPECIMEN by a method and record its force."""
    from drivers.errors import DeviceError
    from fabctl.bench import open_bench
    from fabctl.cli.steering import Keys
    from fabctl.config.bench import load_bench
    from fabctl.errors import BenchBusy, Stopped, UsageError
    from fabctl.indent.job import Steering, ask_rig, plan_test, refuse, run_test

    place = lab()
    bench_config = load_bench(bench_name, place.root)
    earlier = place.run(resume) if resume else None
    facts = {
        "temperature_degC": temperature_degc,
        "humidity_frac": humidity_frac,
        "thickness_mm": thickness_mm,
        "batch": batch,
        "rest_h": rest_h,
    }
    plan = plan_test(place, place.specimen(specimen), method, bench_config, earlier, facts)
    for line in _screen(plan, bench_config.name):
        say(line)
    refuse(plan)
    if dry_run:
        try:
            with open_bench(place, bench_config, f"asking the rig for {specimen}") as bench:
                ask_rig(plan, bench)
        except (BenchBusy, DeviceError, UsageError) as fault:
            say(f"  the rig could not be asked: {fault}")
        show(_planned(plan), as_json, ["dry run: nothing was moved"])
        return
    if not confirm("Start?", yes):
        raise Stopped("not started")
    with open_bench(place, bench_config, f"testing {specimen}") as bench, Keys(progress()) as keys:
        run = run_test(place, plan, bench, keys.listen, Steering(keys.wish, keys.go_on))
    _render(run, as_json)


@command.command("analyse")
@click.argument("runs", nargs=-1, type=RUN_OR_SPECIMEN)
@click.option("--group", "groups", multiple=True, metavar="NAME=RUN,RUN,…", help="Compare groups of runs.")
@click.option("-o", "--output", type=PictureFile(), help="Picture of all curves (SVG, PNG or PDF).")
@json_option
def analyse_command(runs: tuple[str, ...], groups: tuple[str, ...], output: Path | None, as_json: bool) -> None:
    """Analyse RUNS anew from their samples: run ids, folders, or specimens (all their runs)."""
    from fabctl.errors import UsageError
    from fabctl.indent.groups import analyse_groups, parse_groups

    named = parse_groups(lab(), runs, groups)
    if not named:
        raise UsageError("name at least one run, specimen or --group")
    body = analyse_groups(named, output, progress())
    lines = []
    for name, found in body["groups"].items():
        one = len(found["runs"]) == 1
        lines.append(f"{name}: 1 run" if one else f"{name}: {len(found['runs'])} runs")
        lines += list(_lines(found["runs"][0]["result"])) if one else [_short(each) for each in found["runs"]]
        if found.get("stiffness_secant_N_mm") is not None:
            spread = found["stiffness_secant_N_mm"]
            lines.append(f"  secant stiffness {spread['mean']:.4g} ± {spread['sd']:.2g} N/mm (n = {spread['count']})")
    for ratio in body["ratios"]:
        ends = (
            f"{ratio['low_ratio']:.3f} to {ratio['high_ratio']:.3f}"
            if ratio["low_ratio"] is not None
            else f"no interval: {ratio['reason']}"
        )
        what = WORDS.get(ratio["figure"], ratio["figure"])
        lines.append(
            f"{ratio['above']} / {ratio['below']}, {what}: {ratio['value_ratio']:.3f}, 95 % {ends} ({ratio['how']})"
        )
    show(body, as_json, lines)


@command.command("export")
@click.argument("run", type=RUN)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["csv", "parquet", "hdf5", "bluesky"]),
    default="csv",
    show_default=True,
    help="Of the file.",
)
@click.option("-o", "--output", type=OutFile(), required=True, help="The file to write.")
@json_option
def export_command(run: str, kind: str, output: Path, as_json: bool) -> None:
    """Write the samples of RUN for other programs: CSV with units, Parquet, HDF5, or bluesky documents."""
    from fabctl.indent.export import export

    found = export(lab().run(run), kind, output)
    show(found, as_json, [f"{output}: {found['rows_count']} rows"])


def _screen(plan: IndentPlan, bench: str) -> Iterator[str]:
    limits = plan.method.limits
    yield f"{plan.specimen.name} on bench {bench}, method {plan.method.name}: {plan.method.description}"
    yield (
        f"  limits in the controller: {limits.force_N:g} N gross, {limits.travel_mm:g} mm, "
        f"watchdog {limits.watchdog_s:g} s"
    )
    peak = plan.predicted_peak_N
    yield f"  predicted peak {peak:.2f} N" if peak is not None else "  no predicted response"
    count = len({(a.point, a.curve) for a in plan.actions if a.curve})
    yield f"  {count} curve{'s' * (count != 1)}, about {plan.time_s:.0f} s, {plan.sample_hz:g} samples a second"
    if plan.resumed is not None:
        yield f"  goes on with {plan.resumed.run_id}"
    for finding in plan.findings:
        yield f"  {finding}"


def _planned(plan: IndentPlan) -> dict[str, Any]:
    return {
        "specimen": plan.specimen.name,
        "method": plan.method.name,
        "time_s": plan.time_s,
        "predicted_peak_N": plan.predicted_peak_N,
        "curves_count": len({(a.point, a.curve) for a in plan.actions if a.curve}),
        "findings": [finding.as_dict() for finding in plan.findings],
    }


def _render(run: RunFolder, as_json: bool) -> None:
    result = run.result() or {}
    body = {"run": run.run_id, "path": str(run.path), "status": "done", **result}
    show(body, as_json, [f"run {run.run_id}", *_lines(result), f"  {run.path / 'artefacts' / 'curve.svg'}"])


def _short(entry: dict[str, Any]) -> str:
    """Return one run among several in one line."""
    result = entry["result"]
    secant, most = result.get("stiffness_secant_N_mm"), result.get("force_max_N")
    if secant is None:
        why = result.get("not_found", {}).get("stiffness_secant_N_mm", "no curve")
        return f"  {entry['run']} ({entry['status']}): secant stiffness not found: {why}"
    half = result.get("stiffness_secant_ci95_N_mm") or 0.0
    return f"  {entry['run']} ({entry['status']}): secant {secant:.4g} ± {half:.2g} N/mm, largest force {most:.4g} N"


def _lines(result: dict[str, Any]) -> Iterator[str]:
    for words, name, unit in (*NAMED, *(row for row in HELD if result.get(row[1]) is not None)):
        value = result.get(name)
        if value is None:
            yield f"  {words:22} not found: {result.get('not_found', {}).get(name, 'no curve')}"
        else:
            yield f"  {words:22} {100 * value if unit == '%' else value:.4g} {unit}"
    if bad := result.get("lines_left_out"):
        which = ", ".join(map(str, bad[:LINES_TOLD_COUNT])) + (", …" if len(bad) > LINES_TOLD_COUNT else "")
        yield f"  {'left out':22} {len(bad)} damaged row{'s' * (len(bad) > 1)} of samples.csv, line {which}"
