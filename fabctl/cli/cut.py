"""`fabctl cut`: cut a design on the laser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from fabctl.cli.common import (
    MATERIAL,
    PLACE_MM,
    bench_option,
    confirm,
    json_option,
    lab,
    progress,
    say_keys,
    show,
    yes_option,
)
from fabctl.cli.cut_camera import marks_command
from fabctl.cli.cut_inspect import inspect_command
from fabctl.cli.paths import RUN, InFile, InFolder, config_names

CAMERA_ONLY = ("marks", "at_mm", "image", "camera_file")


@click.group("cut", no_args_is_help=True)
def command() -> None:
    """Cut a design on the laser."""


command.add_command(inspect_command)
command.add_command(marks_command)


@command.command("run")
@click.argument("design", type=InFolder())
@click.option("--material", type=MATERIAL, help="Material file or its name  [the design's own].")
@click.option("--sheet", type=click.IntRange(1, 999), help="Sheet to cut, of a design that is split over several.")
@click.option(
    "--origin",
    type=click.Choice(["home", "here", "camera"]),
    default="home",
    show_default=True,
    help="Where the sheet's corner is: in the corner of the travel (with --resume: where it was), where the head is, "
    "or as the camera sees it.",
)
@click.option(
    "--marks",
    type=config_names("boards"),
    default="registration",
    show_default=True,
    help="With --origin camera: the sheet's marks.",
)
@click.option(
    "--at-mm", type=PLACE_MM, nargs=2, default=(0.0, 0.0), help="Where on that sheet the design's corner lies."
)
@click.option("--image", type=InFile(), help="A picture of the bed as it is now.")
@click.option("--camera-file", type=InFile(), help="Sheet to machine map, JSON.")
@click.option("--frame", is_flag=True, help="Go once around the job first, and ask whether it fits.")
@click.option("--frame-power", type=click.FloatRange(0, 0.05), default=0.0, help="Beam while framing, at most 5 %.")
@click.option("--no-home", is_flag=True, help="Trust the position as it is; do not home first.")
@click.option("--resume", "resume_run", type=RUN, metavar="RUN", help="Go on with an interrupted run of this design.")
@click.option("--dry-run", is_flag=True, help="Plan and check only; nothing moves.")
@bench_option
@yes_option
@json_option
def run(
    design: Path,
    material: str | None,
    sheet: int | None,
    origin: str,
    marks: str,
    at_mm: tuple[float, float],
    image: Path | None,
    camera_file: Path | None,
    frame: bool,
    frame_power: float,
    no_home: bool,
    resume_run: str | None,
    dry_run: bool,
    bench_name: str,
    yes: bool,
    as_json: bool,
) -> None:
    """Cut the design in folder DESIGN: plan, check, one question, then cut.

    A run record is kept whatever comes of it, also of a refusal or a no; of a dry run none.
    """
    from dataclasses import replace

    _refuse_idle_options(origin, resume_run is not None)
    from fabctl.bench import open_bench
    from fabctl.cli.cut_camera import eye_of
    from fabctl.config.bench import load_bench
    from fabctl.config.material import load_material
    from fabctl.cut.compose import SPOT_MM, composer, open_design, sheet_of
    from fabctl.cut.job import CutOrder, Desk, cut
    from fabctl.cut.keyboard import HELP, keyboard
    from fabctl.cut.resume import material_of, resume

    home = lab()
    before = home.run(resume_run) if resume_run is not None else None
    if (design / "coupon.json").is_file():
        raise click.UsageError(f"{design} is a kerf coupon: fabctl kerf cut {design}")
    bundle, spec = open_design(design)
    if before is not None and material is None:
        chosen = material_of(before)
    else:
        chosen = load_material(material or spec.material, home.root)
    config = load_bench(bench_name, home.root)
    spot_mm = config.laser.spot_mm if config.laser is not None else SPOT_MM
    order = CutOrder(
        design=design,
        compose=composer(bundle, spec, chosen, sheet, spot_mm),
        material=chosen,
        sheet=sheet_of(spec, home.root),
        origin=origin,  # type: ignore[arg-type]  # click.Choice has checked it
        camera_file=camera_file,
        frame=frame,
        frame_power_frac=frame_power,
        home=not no_home,
    )
    with open_bench(home, config, f"cut {design.name}") as bench, keyboard() as keys:
        if origin == "camera":
            order = replace(order, eye=eye_of(bench, marks, at_mm, chosen.thickness_mm, camera_file, image))
        desk = Desk(lambda question: confirm(question, yes), progress(), keys)
        if not dry_run:
            say_keys(HELP)
        if before is not None:
            done = resume(home, bench, order, before.path, desk, dry_run)
        else:
            done = cut(home, bench, order, desk, dry_run)
    facts: dict[str, Any] = {
        "specimen": done.specimen.name if done.specimen else None,
        "run": done.run.run_id if done.run else None,
        "dry_run": dry_run,
        **done.result,
    }
    show(facts, as_json, _lines(facts))


def _refuse_idle_options(origin: str, resuming: bool) -> None:
    """Refuse, all at once, the options that were given and would change nothing."""
    source = click.get_current_context().get_parameter_source
    given = [name for name in (*CAMERA_ONLY, "sheet") if source(name) is ParameterSource.COMMANDLINE]
    said = [f"--{n.replace('_', '-')} needs --origin camera" for n in given if n != "sheet" and origin != "camera"]
    if resuming and "sheet" in given:
        said.append("--sheet means nothing with --resume: the run goes on with its own sheet")
    if said:
        raise click.UsageError("; ".join(said))


def _lines(facts: dict[str, Any]) -> list[str]:
    from fabctl.cut.execute import minutes

    estimate = minutes(facts["estimate_s"])
    if facts["run"] is None:
        return [f"checked: {facts['lines_count']} lines, {facts['burnt_mm'] / 1000:.2f} m burnt, about {estimate}"]
    return [
        f"{facts['specimen']} is cut: {facts['burnt_mm'] / 1000:.2f} m in {minutes(facts['actual_s'])} "
        f"(estimated {estimate})",
        f"run {facts['run']}",
    ]
