"""Where on the machine the sheet lies: an affine map from sheet to machine coordinates, and the program laid there.

The work offset is only read, never written: the program itself is moved, so that nothing on the board changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from drivers.grbl.messages import Report, Vector
from drivers.grbl.settings import Identity
from fabctl.cut.program import WORD, decimal, read_program, strip
from fabctl.errors import UsageError
from fabctl.files import json_of

Origin = Literal["here", "home", "camera"]
FARTHEST_MM = 10_000.0
RIGID_RATIO = 0.02  # a camera map that stretches more than this is a mistake, not a bed


@dataclass(frozen=True, slots=True)
class Affine:
    """machine = (xx xy; yx yy) · sheet + (x, y), in mm."""

    xx_ratio: float = 1.0
    xy_ratio: float = 0.0
    x_mm: float = 0.0
    yx_ratio: float = 0.0
    yy_ratio: float = 1.0
    y_mm: float = 0.0

    def at(self, point_mm: tuple[float, float]) -> tuple[float, float]:
        """Return the machine place of a sheet place."""
        x, y = point_mm
        return self.xx_ratio * x + self.xy_ratio * y + self.x_mm, self.yx_ratio * x + self.yy_ratio * y + self.y_mm

    @classmethod
    def of_rows(cls, rows: Sequence[Sequence[float]]) -> Affine:
        """Return the map of two rows of three numbers."""
        (a, b, c), (d, e, f) = rows
        return cls(a, b, c, d, e, f)

    def rows(self) -> list[list[float]]:
        """Return the map as two rows of three numbers."""
        return [[self.xx_ratio, self.xy_ratio, self.x_mm], [self.yx_ratio, self.yy_ratio, self.y_mm]]

    def of(self, inner: Affine) -> Affine:
        """Return the map that does `inner` first, then this one."""
        xx, yx = self.turned((inner.xx_ratio, inner.yx_ratio))
        xy, yy = self.turned((inner.xy_ratio, inner.yy_ratio))
        x, y = self.at((inner.x_mm, inner.y_mm))
        return Affine(xx, xy, x, yx, yy, y)

    def inverse(self) -> Affine:
        """Return the map back from the machine to the sheet."""
        area = self.xx_ratio * self.yy_ratio - self.xy_ratio * self.yx_ratio
        linear = Affine(
            self.yy_ratio / area, -self.xy_ratio / area, 0.0, -self.yx_ratio / area, self.xx_ratio / area, 0.0
        )
        return linear.of(Affine(x_mm=-self.x_mm, y_mm=-self.y_mm))

    def turned(self, vector_mm: tuple[float, float]) -> tuple[float, float]:
        """Return a difference of places, without the shift."""
        x, y = vector_mm
        return self.xx_ratio * x + self.xy_ratio * y, self.yx_ratio * x + self.yy_ratio * y


def travel_box_mm(identity: Identity, travel_mm: tuple[float, float]) -> tuple[float, float, float, float]:
    """Return the machine's travel (x low, y low, x high, y high): minus travel to 0, unless it homes to zero.

    The board's own `$130/$131` count; `travel_mm` of the bench file where the board does not tell.
    """
    width = identity.setting(130) or travel_mm[0]
    height = identity.setting(131) or travel_mm[1]
    if identity.homes_to_zero:
        mask = int(identity.setting(23) or 0)
        x = (0.0, width) if mask & 1 else (-width, 0.0)
        y = (0.0, height) if mask & 2 else (-height, 0.0)
    else:
        x, y = (-width, 0.0), (-height, 0.0)
    return x[0], y[0], x[1], y[1]


def homed_mm(identity: Identity, travel_mm: tuple[float, float]) -> Vector:
    """Return where the head stands after homing: `$27` off the switches, which `$23` puts at either end; or at zero."""
    if identity.homes_to_zero:
        return 0.0, 0.0, 0.0
    off_mm, mask = identity.setting(27) or 0.0, int(identity.setting(23) or 0)
    low_x, low_y, _, _ = travel_box_mm(identity, travel_mm)
    return low_x + off_mm if mask & 1 else -off_mm, low_y + off_mm if mask & 2 else -off_mm, 0.0


def is_homed(identity: Identity, report: Report) -> bool:
    """Return whether machine coordinates mean places on the machine: it can home, and is not locked."""
    return identity.is_on(22) and report.state == "Idle"


def after_homing(report: Report, identity: Identity, travel_mm: tuple[float, float]) -> Report:
    """Return the report as it will be once the machine has homed."""
    return replace(report, state="Idle", machine_mm=homed_mm(identity, travel_mm), work_mm=None)


def placement(
    origin: Origin,
    identity: Identity,
    travel_mm: tuple[float, float],
    origin_mm: tuple[float, float],
    head_mm: Vector | None,
    camera_file: Path | None = None,
) -> Affine:
    """Return the map that `--origin` means.

    `home`: the sheet's corner lies `origin_mm` from the lower left corner of the travel; `here`: where the head is;
    `camera`: as the calibrated bed camera measured it.
    """
    if origin == "camera":
        if camera_file is None or not camera_file.is_file():
            raise UsageError("--origin camera needs the bed alignment; make it with `fabctl camera`")
        return read_affine(camera_file)
    if origin == "here":
        if head_mm is None:
            raise UsageError("--origin here: the board does not report where the head is")
        return Affine(x_mm=head_mm[0], y_mm=head_mm[1])
    box = travel_box_mm(identity, travel_mm)
    return Affine(x_mm=box[0] + origin_mm[0], y_mm=box[1] + origin_mm[1])


def read_affine(path: Path) -> Affine:
    """Return the map in a JSON file: `sheet_to_machine`, two rows of three numbers."""
    data = json_of(path, "a map from sheet to machine")
    try:
        rows = data["sheet_to_machine"]
        (a, b, c), (d, e, f) = ([float(value) for value in row] for row in rows)
    except (ValueError, KeyError, TypeError) as fault:
        raise UsageError(f"{path}: no sheet_to_machine of two rows with three numbers") from fault
    if not all(map(math.isfinite, (a, b, c, d, e, f))):
        raise UsageError(f"{path}: the map is not finite")
    if max(abs(c), abs(f)) > FARTHEST_MM:
        raise UsageError(f"{path}: the map moves the sheet by more than {FARTHEST_MM / 1000:g} m. Align it again")
    for scale in (math.hypot(a, d), math.hypot(b, e)):
        if not abs(scale - 1) <= RIGID_RATIO:
            raise UsageError(f"{path}: the map scales by {scale:.4f}; a bed does not. Align it again")
    if not abs(a * b + d * e) <= RIGID_RATIO:
        raise UsageError(f"{path}: the map shears, its axes are not at right angles; a bed's are. Align it again")
    return Affine(a, b, c, d, e, f)


def lay(lines: Sequence[str], affine: Affine, work_offset_mm: Vector) -> tuple[str, ...]:
    """Return the program in the board's work coordinates, so that it runs where `affine` puts the sheet."""
    program = read_program(lines)
    out = []
    for index, line in enumerate(program.lines):
        words = WORD.findall(strip(line))
        letters = {letter for letter, _ in words}
        if not {"X", "Y"} & letters:
            out.append(line)
            continue
        x, y = affine.at(program.modes[index].position_mm)
        place = {"X": x - work_offset_mm[0], "Y": y - work_offset_mm[1]}
        if {"I", "J"} & letters:
            values = {letter: float(number) for letter, number in words if letter in "IJ"}
            i, j = affine.turned((values.get("I", 0.0), values.get("J", 0.0)))
            place |= {"I": i, "J": j}
        head = "".join(a + b for a, b in words if a in "GM")
        tail = "".join(a + b for a, b in words if a not in "GMXYIJ")
        out.append(head + "".join(letter + decimal(value) for letter, value in place.items()) + tail)
    return tuple(out)
