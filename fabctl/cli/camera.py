"""`fabctl camera`: boards, lens calibration, bed alignment, and finding a sheet on the bed."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fabctl.cli.common import PLACE_MM, bench_option, json_option, lab, say, show
from fabctl.cli.paths import RUN, InFile, InFolder, OutFile, PhotoFile, config_names

if TYPE_CHECKING:
    from collections.abc import Iterable

    from design.pattern.paths import CutPath
    from drivers.camera import Frame
    from fabctl.config.bench import BenchConfig
    from fabctl.vision.boards import Charuco, MarkSheet

BOARD = config_names("boards")
image_option = click.option("--image", type=InFile(), help="A picture of the bed, instead of the bench's camera.")


LARGEST_MM = 20_000.0  # of a bed or a sheet


def size(text: str) -> tuple[float, float]:
    """Return both numbers of `200x150`."""
    parts = text.lower().split("x")
    try:
        w, h = (float(part) for part in parts)
    except ValueError:
        w = h = math.nan
    if not (0 < w <= LARGEST_MM and 0 < h <= LARGEST_MM):
        raise click.BadParameter(f"{text!r} is not two numbers above zero and up to {LARGEST_MM:g}, such as 300x200")
    return w, h


@click.group("camera")
def command() -> None:
    """Boards, lens calibration and bed alignment."""


@command.group("board")
def board() -> None:
    """Make boards to print or engrave, and note what the print measures."""


@board.command("charuco")
@click.option("--squares", type=size, metavar="WxH", default="10x7", show_default=True, help="Columns and rows.")
@click.option("--square-mm", type=click.FloatRange(1, 1000), default=20.0, show_default=True, help="Side of a square.")
@click.option(
    "--marker-mm",
    type=click.FloatRange(0.5, 1000),
    default=15.0,
    show_default=True,
    help="Side of the marker in a square.",
)
@click.option("--name", default="lens", show_default=True, help="The board's name.")
@json_option
def charuco(squares: tuple[float, float], square_mm: float, marker_mm: float, name: str, as_json: bool) -> None:
    """Make a ChArUco board for the lens."""
    from fabctl.vision.boards import CHARUCO_IDS, Charuco

    columns, rows = int(squares[0]), int(squares[1])
    if not 0 < marker_mm < square_mm or min(columns, rows) < 3 or columns * rows // 2 > len(CHARUCO_IDS):
        limit = 2 * len(CHARUCO_IDS)
        raise click.UsageError(f"markers must be smaller than squares, and squares 3x3 at least and {limit} at most")
    _write_board(Charuco(name, columns, rows, square_mm, marker_mm), as_json)


@board.command("marks")
@click.argument("kind", type=click.Choice(["bed", "registration", "scale"]))
@click.option(
    "--size-mm", type=size, metavar="WxH", required=True, help="The bed's travel, or the sheet's width and height."
)
@click.option("--side-mm", type=click.FloatRange(0.5, 1000), default=None, help="Side of a mark's black square.")
@click.option("--name", default=None, help="The board's name; its kind where none is given.")
@json_option
def marks(kind: str, size_mm: tuple[float, float], side_mm: float | None, name: str | None, as_json: bool) -> None:
    """Make a sheet of marks: for the bed's alignment, in a sheet's corners, or around a specimen."""
    from dataclasses import replace

    from fabctl.vision import boards

    side = side_mm or {"bed": 12.0, "registration": 8.0, "scale": 15.0}[kind]
    if side > min(size_mm) / 4:
        raise click.UsageError(f"marks of {side:g} mm are too large for {size_mm[0]:g} x {size_mm[1]:g} mm; --side-mm")
    sheet = (
        boards.bed_marks(size_mm, side)
        if kind == "bed"
        else boards.registration_marks(size_mm, side)
        if kind == "registration"
        else boards.scale_marks(size_mm, side)
    )
    _write_board(replace(sheet, name=name or kind), as_json)


@board.command("measured")
@click.argument("name", type=BOARD)
@click.argument("across_mm", type=click.FloatRange(1, 20_000))
@click.argument("up_mm", type=click.FloatRange(1, 20_000))
@json_option
def measured(name: str, across_mm: float, up_mm: float, as_json: bool) -> None:
    """Note what the two rulers of the print measure; printers scale."""
    from fabctl.config.boards import load_board, write_board
    from fabctl.errors import UsageError

    config = load_board(name, lab().root)
    try:
        changed = type(config).model_validate({**config.model_dump(), "measured_mm": (across_mm, up_mm)})
    except ValueError as fault:
        w, h = config.size_mm
        raise UsageError(f"{across_mm:g} x {up_mm:g} mm is no print of rulers drawn {w:g} x {h:g} mm long") from fault
    path = lab().root / "configs" / "boards" / f"{config.name}.yaml"
    write_board(changed, path)
    x, y = changed.ratios()
    data = {"board": config.name, "file": str(path), "ratio": [x, y]}
    show(data, as_json, [f"{path}: {x:.5f} of its drawn size across, {y:.5f} up"])


def _write_board(made: Charuco | MarkSheet, as_json: bool) -> None:
    from fabctl.config.boards import config_of, write_board
    from fabctl.records.folder import write_atomically
    from fabctl.vision.boards import Charuco, hatch, sheet_ink
    from fabctl.vision.drawing import drawing_of, dxf, pdf

    folder = lab().root / "configs" / "boards"
    folder.mkdir(parents=True, exist_ok=True)
    drawing = drawing_of(made)
    strokes = [] if isinstance(made, Charuco) else hatch(sheet_ink(made), 0.1, 0.1)
    files = {kind: folder / f"{made.name}.{kind}" for kind in ("yaml", "pdf", "dxf")}
    write_board(config_of(made), files["yaml"])
    write_atomically(files["pdf"], pdf(drawing))
    write_atomically(files["dxf"], dxf(drawing, strokes))
    w, h = made.size_mm
    lines = [f"{path}" for path in files.values()]
    lines.append(f"print at 100 %, measure the rulers ({w:g} and {h:g} mm drawn), then:")
    lines.append(f"fabctl camera board measured {made.name} ACROSS_MM UP_MM")
    show({"board": made.name, "size_mm": [w, h], "files": {k: str(p) for k, p in files.items()}}, as_json, lines)


@command.command("show")
@bench_option
@click.option("-o", "--output", type=PhotoFile(), default=Path("bed.png"), show_default=True, help="The file to write.")
@json_option
def show_picture(bench_name: str, output: Path, as_json: bool) -> None:
    """Take one picture of the bed and say whether it can be measured in."""
    from fabctl.vision.overlay import write_picture
    from fabctl.vision.quality import picture_findings

    frame = bed_picture(bench_name, None)
    write_picture(str(output), frame.image)
    found = picture_findings(frame.image, frame.source)
    h, w = frame.image.shape
    data = {"picture": str(output), "size_px": [w, h], "findings": [f.as_dict() for f in found]}
    show(data, as_json, [f"{output}: {w} x {h} px", *map(str, found)])


@command.command("calibrate")
@click.argument("pictures", nargs=-1, type=InFile())
@click.option("--board", "board_name", type=BOARD, default="lens", show_default=True, help="Board file or its name.")
@click.option(
    "--views",
    type=click.IntRange(1, 1000),
    default=15,
    show_default=True,
    help="How many pictures to take from the live camera.",
)
@bench_option
@json_option
def calibrate(pictures: tuple[Path, ...], board_name: str, views: int, bench_name: str, as_json: bool) -> None:
    """Measure the lens from PICTURES of a ChArUco board, or from the bench's camera."""
    from fabctl.config.boards import load_board
    from fabctl.errors import UsageError
    from fabctl.vision import lens
    from fabctl.vision.bed import lens_path
    from fabctl.vision.overlay import coverage_map, write_picture

    config = load_board(board_name, lab().root)
    if config.kind != "charuco":
        raise UsageError(f"{board_name} is a sheet of marks; the lens needs a ChArUco board")
    if config.measured_mm is None:
        say(f"{board_name}: not measured after printing; the lens does not mind, distances would")
    bench, state = bench_and_state(bench_name)
    frames = _readable(pictures) if pictures else _live(bench, state, views)
    if not frames:
        raise UsageError(f"none of the {len(pictures)} files is a picture that can be read")
    seen = [lens.find_board(frame.image, config.charuco(), frame.source) for frame in frames]
    for _, found in seen:
        for finding in found:
            say(str(finding))
    sizes = {frame.image.shape for frame in frames}
    if len(sizes) != 1:
        raise UsageError(f"the pictures have {len(sizes)} sizes; a lens is measured at one")
    h, w = sizes.pop()
    good = [view for view, _ in seen if view is not None]
    path = lens_path(state, bench.camera.calibration if bench.camera else None)
    drawn = path.with_suffix(".png")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(str(drawn), coverage_map(good, (w, h)))
    say(f"{drawn}: where in the frame the board was seen")
    made = lens.calibrate(good, (w, h), config.charuco(), datetime.now(UTC).isoformat())
    lens.write_lens(made.lens, path, {"views": dict(zip(made.sources, made.view_rms_px, strict=True))})
    facts = made.lens
    data = {
        "lens": str(path),
        "picture": str(drawn),
        "views_count": facts.views_count,
        "rms_px": facts.rms_px,
        "repeat_px": facts.repeat_px,
        "coverage_ratio": facts.coverage_ratio,
        "view_rms_px": dict(zip(made.sources, made.view_rms_px, strict=True)),
    }
    text = f"{facts.views_count} pictures, residual {facts.rms_px:.3f} px rms, halves agree to {facts.repeat_px:.3f} px"
    show(data, as_json, [f"{path}: {text}, {facts.coverage_ratio:.0%} of the frame seen"])


@command.command("align")
@click.option(
    "--marks", "marks_name", type=BOARD, default="bed", show_default=True, help="Marks at known machine places."
)
@click.option("--offset-mm", type=PLACE_MM, nargs=2, default=None, help="Machine place of the marks' own origin.")
@click.option(
    "--engraved", type=RUN, metavar="RUN", help="The run of `fabctl cut marks` that engraved them: it knows the place."
)
@click.option(
    "--height-mm", type=click.FloatRange(0, 1000), default=0.0, help="Of the marks over the bed: the sheet's thickness."
)
@image_option
@bench_option
@json_option
def align(
    marks_name: str,
    offset_mm: tuple[float, float] | None,
    engraved: str | None,
    height_mm: float,
    image: Path | None,
    bench_name: str,
    as_json: bool,
) -> None:
    """Learn where machine millimetres are in the bed picture, from marks at known places."""
    from fabctl.config.boards import load_board, with_offset
    from fabctl.vision import align as aligning
    from fabctl.vision.bed import alignment_path, lens_path
    from fabctl.vision.lens import read_lens
    from fabctl.vision.overlay import error_map, write_picture

    place = _engraved_at(engraved) if engraved else offset_mm
    if place is None:
        say("the marks' own origin is taken for machine 0, 0; --offset-mm or --engraved say otherwise")
    sheet = with_offset(load_board(marks_name, lab().root).mark_sheet(), *(place or (0.0, 0.0)))
    bench, state = bench_and_state(bench_name)
    glass = read_lens(lens_path(state, bench.camera.calibration if bench.camera else None))
    frame = bed_picture(bench_name, image)
    made = aligning.align(frame.image, frame.source, sheet, glass, datetime.now(UTC).isoformat(), height_mm)
    path = alignment_path(state)
    aligning.write_alignment(made, path)
    picture = path.with_suffix(".png")
    write_picture(str(picture), error_map(frame.image, made))
    data = {
        "alignment": str(path),
        "error_map": str(picture),
        "marks_count": len(made.witnesses),
        "rms_mm": made.rms_mm,
        "worst_mm": made.worst_mm,
        "mark_error_mm": {witness.id: witness.error_mm for witness in made.witnesses},
    }
    text = f"{len(made.witnesses)} marks, each put by the others to {made.rms_mm:.3f} mm rms, {made.worst_mm:.3f} worst"
    show(data, as_json, [f"{path}: {text}", f"{picture}: the error map"])


def _engraved_at(name: str) -> tuple[float, float]:
    """Return where a run of `fabctl cut marks` laid the marks' origin."""
    from fabctl.errors import UsageError
    from fabctl.records.folder import status_of

    run = lab().run(name)
    if run.manifest().get("kind") != "marks" or status_of(run) != "done":
        raise UsageError(f"{name} is no finished run of `fabctl cut marks`")
    (_, _, x), (_, _, y) = run.manifest()["config"]["placement"]
    return float(x), float(y)


@command.command("check")
@image_option
@bench_option
@json_option
def check(image: Path | None, bench_name: str, as_json: bool) -> None:
    """Say whether the alignment is young enough and its marks are seen where they were."""
    from fabctl.vision.align import witness_drift_mm
    from fabctl.vision.bed import checked_alignment

    _, state = bench_and_state(bench_name)
    frame = bed_picture(bench_name, image)
    alignment, found = checked_alignment(state, frame)
    drift = witness_drift_mm(frame.image, alignment)
    data = {"drift_mm": drift, "made_utc": alignment.made_utc, "findings": [f.as_dict() for f in found]}
    worst = max(drift.values())
    show(data, as_json, [f"{len(drift)} marks in place, the worst {worst:.3f} mm off; aligned {alignment.made_utc}"])


@command.command("register")
@click.option("--sheet", "sheet_name", type=BOARD, default="registration", show_default=True, help="The sheet's marks.")
@click.option(
    "--thickness-mm",
    type=click.FloatRange(0, 1000),
    required=True,
    help="The sheet's: its marks lie that far over the bed.",
)
@click.option("--design", type=InFolder(), default=None, help="Design folder whose job is drawn and checked.")
@click.option(
    "-o",
    "--output",
    type=OutFile((".json",), "a registration"),
    default=Path("registration.json"),
    show_default=True,
    help="The file to write.",
)
@image_option
@bench_option
@json_option
def register(
    sheet_name: str,
    thickness_mm: float,
    design: Path | None,
    output: Path,
    image: Path | None,
    bench_name: str,
    as_json: bool,
) -> None:
    """Find a sheet with registration marks on the bed, for `fabctl cut run --origin camera`."""
    from fabctl.config.boards import load_board
    from fabctl.vision import register as registering
    from fabctl.vision.bed import find_sheet
    from fabctl.vision.overlay import write_picture

    sheet = load_board(sheet_name, lab().root).mark_sheet()
    _, state = bench_and_state(bench_name)
    job = read_paths(design / "paths.json") if design else ()
    found = find_sheet(state, bed_picture(bench_name, image), sheet, thickness_mm, job)
    made = found.registration
    overlay = output.with_suffix(".png")
    write_picture(str(overlay), found.overlay)
    more = {"overlay": str(overlay), "findings": [finding.as_dict() for finding in found.findings]}
    registering.write_registration(made, output, **more, bench=bench_name)
    x, y = made.stretch_ratio
    text = f"{made.marks_count} marks, {made.rms_mm:.3f} mm rms, turned {made.turn_rad:.4f} rad, {x:.4f} x {y:.4f} long"
    data = {**registering.registration_data(made), **more, "registration": str(output)}
    show(data, as_json, [f"{output}: {text}", f"{overlay}: the job on the bed", *map(str, found.findings)])


def read_paths(path: Path) -> tuple[CutPath, ...]:
    """Return the strokes of a design folder's `paths.json`."""
    from design.pattern.drawing import from_json
    from fabctl.files import json_of

    return from_json(json_of(path, "the paths.json of a design folder")).paths


def bench_and_state(name: str) -> tuple[BenchConfig, Path]:
    """Return the bench file and the bench's state folder."""
    from fabctl.config.bench import load_bench

    config = load_bench(name, lab().root)
    return config, lab().bench_state(config.name)


def bed_picture(bench_name: str, image: Path | None) -> Frame:
    """Return the picture in the file, or a fresh one from the bench's camera."""
    from drivers.camera import snapshot
    from fabctl.files import picture_of

    return picture_of(image) if image is not None else snapshot(_camera_url(*bench_and_state(bench_name)))


def _readable(pictures: Iterable[Path]) -> list[Frame]:
    """Return the pictures that can be read; name the others."""
    from fabctl.errors import UsageError
    from fabctl.files import picture_of

    frames = []
    for path in pictures:
        try:
            frames.append(picture_of(path))
        except UsageError as fault:
            say(f"left out: {fault}")
    return frames


def _camera_url(bench: BenchConfig, state: Path) -> str:
    from fabctl.bench import resolve
    from fabctl.errors import UsageError

    if bench.camera is None:
        raise UsageError(f"bench {bench.name} has no camera; add one to its file, or give pictures")
    return resolve(bench.camera.url, bench.name, state)


def _live(bench: BenchConfig, state: Path, count: int) -> list[Frame]:
    from drivers.camera import open_camera

    frames: list[Frame] = []
    with open_camera(_camera_url(bench, state)) as camera:
        left = camera.remaining()
        for number in range(count if left is None else min(count, left)):
            say(f"picture {number + 1} of {count}: hold the board another way")
            frames.append(camera.read())
    return frames
