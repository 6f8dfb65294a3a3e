"""`fabctl cut run --origin camera`, and `fabctl cut marks`: what the laser and the camera over it do for each other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import MATERIAL, F, bench_option, confirm, json_option, lab, progress, say_keys, show, yes_option
from fabctl.cli.paths import config_names

if TYPE_CHECKING:
    from fabctl.bench import Bench
    from fabctl.cut.by_camera import BedEye
    from fabctl.cut.job import CutDone, CutOrder


def eye_of(
    bench: Bench,
    marks: str,
    at_mm: tuple[float, float],
    thickness_mm: float,
    registration: Path | None,
    image: Path | None,
) -> BedEye | None:
    """Return the bed camera for a job; None where `registration` is a bare map that somebody else has measured.

    A registration of `fabctl camera register` is believed only while the bed still shows the sheet there.
    """
    from drivers.camera import snapshot
    from fabctl.config.boards import load_board
    from fabctl.cut.by_camera import BedEye
    from fabctl.errors import UsageError
    from fabctl.files import picture_of
    from fabctl.vision.register import read_registration

    if registration is not None and not _is_registration(registration):
        return None
    expected = read_registration(registration) if registration is not None else None
    if bench.config.camera is None and image is None:
        raise UsageError(f"bench {bench.config.name} has no camera; add one to its file, or give --image")
    board = load_board(expected.sheet if expected is not None else marks, lab().root).mark_sheet()

    def take() -> Any:
        return picture_of(image) if image is not None else snapshot(bench.url("camera"))

    height_mm = expected.height_mm if expected is not None else thickness_mm
    return BedEye(bench.state, board, height_mm, take, at_mm, expected, again=image is None)


def _is_registration(path: Path) -> bool:
    import json

    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False  # whoever reads the map says what is wrong with it
    return isinstance(data, dict) and "sheet" in data


def plain_job_options(command: F) -> F:
    """Give a command what every job that is no design takes."""
    origin = click.option(
        "--origin",
        type=click.Choice(["home", "here"]),
        default="home",
        show_default=True,
        help="Where the job's corner lies: in the corner of the travel, or where the head is.",
    )
    dry_run = click.option("--dry-run", is_flag=True, help="Plan and check only; nothing moves.")
    return origin(dry_run(bench_option(yes_option(json_option(command)))))


@click.command("marks")
@click.argument("board", type=config_names("boards"))
@click.option(
    "--material", type=MATERIAL, required=True, help="Material file or its name; its preset gives power and speed."
)
@plain_job_options
def marks_command(
    board: str, material: str, origin: str, dry_run: bool, bench_name: str, yes: bool, as_json: bool
) -> None:
    """Engrave the marks of BOARD: on a scrap for the bed's alignment, or on a sheet for print and cut."""
    from design.export.gcode import GcodeOptions, gcode
    from fabctl.config.bench import find, load_bench
    from fabctl.config.boards import load_board
    from fabctl.config.material import load_material
    from fabctl.cut.compose import PITCH_SPOTS, presets_of
    from fabctl.cut.job import CutOrder, laser_config_of
    from fabctl.vision.boards import hatch, sheet_ink

    home = lab()
    sheet, stuff = load_board(board, home.root).mark_sheet(), load_material(material, home.root)
    spot_mm = laser_config_of(load_bench(bench_name, home.root)).spot_mm
    strokes = hatch(sheet_ink(sheet), PITCH_SPOTS * spot_mm, spot_mm)

    def compose(_: str, s_max_count: float) -> tuple[str, ...]:
        return gcode(strokes, presets_of(stuff), GcodeOptions(s_max_count=s_max_count))

    order = CutOrder(find("boards", board, home.root), compose, stuff, origin=origin, kind="marks")  # type: ignore[arg-type]  # click.Choice has checked it
    done = plain_job(order, bench_name, f"marks {sheet.name}", yes, dry_run)
    facts = {"board": sheet.name, "run": done.run.run_id if done.run else None, "placement": done.plan.affine.rows()}
    told = [f"{len(sheet.marks)} marks engraved; run {done.run.run_id}"] if done.run else ["checked"]
    if done.run is not None:
        told.append(f"for the bed: fabctl camera align --marks {board} --engraved {done.run.run_id}")
    show({**facts, **done.result}, as_json, told)


def plain_job(order: CutOrder, bench_name: str, purpose: str, yes: bool, dry_run: bool = False) -> CutDone:
    """Run a job that is no design: the same checks, the same question, the same record."""
    from fabctl.bench import open_bench
    from fabctl.config.bench import load_bench
    from fabctl.cut.job import Desk, cut
    from fabctl.cut.keyboard import HELP, keyboard

    home = lab()
    with open_bench(home, load_bench(bench_name, home.root), purpose) as bench, keyboard() as keys:
        if not dry_run:
            say_keys(HELP)
        return cut(home, bench, order, Desk(lambda question: confirm(question, yes), progress(), keys), dry_run)
