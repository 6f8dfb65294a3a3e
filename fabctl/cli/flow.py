"""`fabctl flow`: design, cut, indent, scan and report one specimen."""

from __future__ import annotations

from pathlib import Path

import click

from fabctl.bench import deployment_checklist, open_bench, refuse_without
from fabctl.cli.common import bench_option, json_option, lab, progress, say, seed_option, show, yes_option
from fabctl.cli.paths import SPECIMEN, InFile, config_names
from fabctl.config.bench import find, load_bench
from fabctl.config.method import load_method
from fabctl.errors import DONE, OUT_OF_TOLERANCE
from fabctl.flow import Flow, Order, continued, runner, steps_after_deployment, steps_until_cut


@click.command("flow")
@click.argument("spec", required=False, type=config_names("specs"))
@click.option("--target", type=InFile(), help="Another target surface.")
@click.option(
    "--continue", "specimen", type=SPECIMEN, metavar="SPECIMEN", help="Go on with a sheet that was cut and is deployed."
)
@click.option(
    "--method",
    type=config_names("methods"),
    default="dome",
    show_default=True,
    help="How it is pressed: file, or name in configs/methods.",
)
@click.option(
    "--tolerance-frac",
    type=click.FloatRange(0, 10, min_open=True),
    default=0.02,
    show_default=True,
    help="How far 95 % of the area may lie off the target, as a fraction of its diagonal.",
)
@seed_option
@bench_option
@yes_option
@json_option
def command(
    spec: str | None,
    target: Path | None,
    specimen: str | None,
    method: str,
    tolerance_frac: float,
    seed: int,
    bench_name: str,
    yes: bool,
    as_json: bool,
) -> None:
    """Take SPEC, a file or a name in configs/specs, through every room: design, cut, indent, scan, report.

    On a bench where a person deploys the sheet, flow stops after the cut with a checklist;
    `--continue SPECIMEN` goes on. The scan passes within 0.02 of the target's diagonal, or `--tolerance-frac`.
    """
    if (spec is None) == (specimen is None):
        raise click.UsageError("give either SPEC or --continue SPECIMEN")
    home = lab()
    bench = load_bench(bench_name, home.root)
    refuse_without(bench, "laser", "rig", "scan")
    if target is not None:
        from design.meshfiles import read_mesh

        read_mesh(target)  # a mesh that cannot be used is told now, not by the first step
    load_method(method, home.root)  # a mistake in it is told now, not after the cut
    order = Order(bench, bench_name, method, tolerance_frac, yes, seed)
    with open_bench(home, bench, f"flow {specimen or spec}") as held:
        run, emit = runner(home, held), progress()
        if specimen is not None:
            flow = continued(home, specimen)
        else:
            assert spec is not None
            flow = steps_until_cut(home, order, find("specs", spec, home.root), target, run, emit)
        by_hand = specimen is None and bench.deployment == "by_hand"
        flow = flow if by_hand else steps_after_deployment(order, flow, run, emit)
    if by_hand:
        _wait_for_a_person(flow, order, as_json)
        return
    report = flow.steps["report"]
    data = {"specimen": flow.specimen, "design": flow.design, **flow.steps}
    data |= {"verdict": report["verdict"], "sentence": report["sentence"], "report": report["report"]}
    code = OUT_OF_TOLERANCE if flow.out_of_tolerance else DONE
    lines = [f"{flow.specimen}: {report['sentence']}", f"design: {flow.design}", f"report: {report['report']}"]
    show(data, as_json, lines, code, report["sentence"])


def _wait_for_a_person(flow: Flow, order: Order, as_json: bool) -> None:
    assert flow.specimen is not None
    lines = deployment_checklist(order.bench, flow.specimen)
    data = {"specimen": flow.specimen, "design": flow.design, **flow.steps, "next": list(lines)}
    show(data, as_json, [f"{flow.specimen} is cut (design: {flow.design}). Now by hand:", *lines])
    if as_json:
        say(f"{flow.specimen} is cut. By hand now: {lines[-1]}")
