"""`fabctl camera board`: boards to print or engrave, and what the print measures."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import click

from fabctl.cli.common import json_option, lab, show
from fabctl.cli.paths import config_names

if TYPE_CHECKING:
    from fabctl.vision.boards import Charuco, MarkSheet

BOARD = config_names("boards")
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


def squares(text: str) -> tuple[int, int]:
    """Return columns and rows of `10x7`."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise click.BadParameter(f"{text!r} is not columns x rows in whole numbers, such as 10x7")
    return int(parts[0]), int(parts[1])


def board_name(text: str) -> str:
    """Return a name that a board and its files can have."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,63}", text):
        raise click.BadParameter(f"{text!r} is not a name of small letters, digits, - and _, such as lens-2")
    return text


@click.group("board")
def board() -> None:
    """Make boards to print or engrave, and note what the print measures."""


@board.command("charuco")
@click.option("--squares", type=squares, metavar="WxH", default="10x7", show_default=True, help="Columns and rows.")
@click.option("--square-mm", type=click.FloatRange(1, 1000), default=20.0, show_default=True, help="Side of a square.")
@click.option(
    "--marker-mm",
    type=click.FloatRange(0.5, 1000),
    default=15.0,
    show_default=True,
    help="Side of the marker in a square.",
)
@click.option("--name", type=board_name, default="lens", show_default=True, help="The board's name.")
@json_option
def charuco(squares: tuple[int, int], square_mm: float, marker_mm: float, name: str, as_json: bool) -> None:
    """Make a ChArUco board for the lens."""
    from fabctl.vision.boards import CHARUCO_IDS, Charuco

    columns, rows = squares
    if not 0 < marker_mm < square_mm or min(columns, rows) < 3 or columns * rows // 2 > len(CHARUCO_IDS):
        limit = 2 * len(CHARUCO_IDS)
        text = f"a board has 3x3 squares at least, {limit} in all at most, and markers smaller than a square"
        raise click.UsageError(f"{text}; not {columns}x{rows} of {square_mm:g} mm with markers of {marker_mm:g} mm")
    _write_board(Charuco(name, columns, rows, square_mm, marker_mm), as_json)


@board.command("marks")
@click.argument("kind", type=click.Choice(["bed", "registration", "scale"]))
@click.option(
    "--size-mm", type=size, metavar="WxH", required=True, help="The bed's travel, or the sheet's width and height."
)
@click.option("--side-mm", type=click.FloatRange(0.5, 1000), default=None, help="Side of a mark's black square.")
@click.option("--name", type=board_name, default=None, help="The board's name; its kind where none is given.")
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
