"""`fabctl camera`: boards, lens calibration, bed alignment, and finding a sheet on the bed."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fabctl.cli.camera_boards import BOARD, board
from fabctl.cli.common import PLACE_MM, bench_option, json_option, lab, say, show
from fabctl.cli.paths import RUN, InFile, InFolder, OutFile, PhotoFile

if TYPE_CHECKING:
    from collections.abc import Iterable

    from design.pattern.paths import CutPath
    from drivers.camera import Frame
    from fabctl.config.bench import BenchConfig

image_option = click.option("--image", type=InFile(), help="A picture of the bed, instead of the bench's camera.")


@click.group("camera")
def command() -> None:
    """Boards, lens calibration and bed alignment."""


command.add_command(board)


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
    h, w = _one_size(frames)
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


def _one_size(frames: list[Frame]) -> tuple[int, int]:
    """Return height and width of all the pictures; raise `UsageError` naming those of another size than the most."""
    from collections import Counter

    from fabctl.errors import UsageError

    (h, w), count = Counter(frame.image.shape for frame in frames).most_common(1)[0]
    others = [f"{f.source} has {f.image.shape[1]} x {f.image.shape[0]}" for f in frames if f.image.shape != (h, w)]
    if others:
        many = f" and {len(others) - 3} more" if len(others) > 3 else ""
        text = f"{count} pictures have {w} x {h} px, but {', '.join(others[:3])}{many}"
        raise UsageError(f"{text}; a lens is measured at one size: leave the others out")
    return h, w


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
