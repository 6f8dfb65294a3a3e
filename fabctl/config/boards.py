"""The board file: a ChArUco board or a sheet of marks, as drawn and as measured after printing."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from fabctl.config.bench import Positive, find
from fabctl.config.loader import Model, load
from fabctl.records.folder import write_atomically
from fabctl.vision.boards import CHARUCO_IDS, Charuco, Mark, MarkSheet
from fabctl.vision.markers import codes

Count = Annotated[int, Field(ge=2)]
Id = Annotated[int, Field(ge=0)]


class MarkConfig(Model):
    """One mark, as drawn."""

    id: Id
    x_mm: float
    y_mm: float
    side_mm: Positive
    turn_deg: float = 0.0


class BoardConfig(Model):
    """A board. `measured_mm` is what the two rulers of the print measure; without it the drawn size is believed."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    kind: Literal["charuco", "marks"]
    family: Literal["5x5_250", "mip_36h12"] = "5x5_250"
    size_mm: tuple[Positive, Positive]
    measured_mm: tuple[Positive, Positive] | None = None
    columns_count: Count | None = None
    rows_count: Count | None = None
    square_mm: Positive | None = None
    marker_mm: Positive | None = None
    first_id: Id = CHARUCO_IDS.start  # of a ChArUco board that another program drew, usually 0
    legacy: bool = False  # such a board of an even number of rows whose upper left square is white
    marks: tuple[MarkConfig, ...] = ()

    @model_validator(mode="after")
    def _complete(self) -> BoardConfig:
        if self.kind == "charuco" and None in (self.columns_count, self.rows_count, self.square_mm, self.marker_mm):
            raise ValueError("a charuco board needs columns_count, rows_count, square_mm and marker_mm")
        if self.kind == "charuco" and self.columns_count and self.rows_count:
            last, most = self.first_id + self.columns_count * self.rows_count // 2 - 1, len(codes(self.family)) - 1
            if last > most:
                raise ValueError(f"the board's markers go up to {last}, {self.family} ends at {most}")
        if self.kind == "marks" and not self.marks:
            raise ValueError("a sheet of marks needs marks")
        ids = [mark.id for mark in self.marks]
        if len(set(ids)) != len(ids):
            raise ValueError("two marks have the same id")
        if self.measured_mm and any(abs(m / n - 1) > 0.1 for m, n in zip(self.measured_mm, self.size_mm, strict=True)):
            raise ValueError("measured_mm is more than 10 % off size_mm; that is another board")
        return self

    def charuco(self) -> Charuco:
        """Return the ChArUco board at its measured size (the mean of both directions)."""
        if self.columns_count is None or self.rows_count is None or self.square_mm is None or self.marker_mm is None:
            raise ValueError(f"{self.name} is not a charuco board")
        ratio = math.sqrt(math.prod(self.ratios()))
        square, marker = self.square_mm * ratio, self.marker_mm * ratio
        return Charuco(
            self.name, self.columns_count, self.rows_count, square, marker, self.family, self.first_id, self.legacy
        )

    def mark_sheet(self) -> MarkSheet:
        """Return the sheet of marks at its measured size."""
        x, y = self.ratios()
        side = math.sqrt(x * y)
        marks = tuple(
            Mark(m.id, m.x_mm * x, m.y_mm * y, m.side_mm * side, math.radians(m.turn_deg)) for m in self.marks
        )
        return MarkSheet(self.name, (self.size_mm[0] * x, self.size_mm[1] * y), marks, self.family)

    def ratios(self) -> tuple[float, float]:
        """Return measured over drawn, along x and y."""
        measured = self.measured_mm or self.size_mm
        return measured[0] / self.size_mm[0], measured[1] / self.size_mm[1]


def config_of(board: Charuco | MarkSheet) -> BoardConfig:
    """Return the board as a configuration, not yet measured."""
    if isinstance(board, Charuco):
        return BoardConfig(
            name=board.name,
            kind="charuco",
            family=board.family,
            size_mm=board.size_mm,
            columns_count=board.columns_count,
            rows_count=board.rows_count,
            square_mm=board.square_mm,
            marker_mm=board.marker_mm,
            first_id=board.first_id,
            legacy=board.legacy,
        )
    marks = tuple(
        MarkConfig(id=m.id, x_mm=m.x_mm, y_mm=m.y_mm, side_mm=m.side_mm, turn_deg=math.degrees(m.turn_rad))
        for m in board.marks
    )
    return BoardConfig(name=board.name, kind="marks", family=board.family, size_mm=board.size_mm, marks=marks)


def load_board(name: str, home: Path) -> BoardConfig:
    """Return the board called `name` (in `configs/boards/`), or the one in the file of that path."""
    return load(find("boards", name, home), BoardConfig)


def write_board(config: BoardConfig, path: Path) -> None:
    """Write the board file, whole or not at all."""
    import yaml

    data = config.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120))


def with_offset(sheet: MarkSheet, x_mm: float, y_mm: float) -> MarkSheet:
    """Return the sheet with its origin laid at (`x_mm`, `y_mm`)."""
    return replace(sheet, marks=tuple(replace(m, x_mm=m.x_mm + x_mm, y_mm=m.y_mm + y_mm) for m in sheet.marks))
