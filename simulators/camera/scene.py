"""What stands before the camera, as a JSON file: the bed and its marks, the sheet and where it lay, lens and weather.

The file is the person at the bench: moving the sheet is editing it. Millimetres, y up, the machine's origin.
"""

from __future__ import annotations

import json
import types
import typing
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Mark:
    """A printed ArUco marker of black side `side_mm`, its centre at (x, y)."""

    id: int
    x_mm: float
    y_mm: float
    side_mm: float
    turn_rad: float = 0.0
    family: str = "5x5_250"


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the sheet lies from `from_s` of the burn trace on; its origin is at (x, y), then turned, then stretched."""

    from_s: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 0.0
    turn_rad: float = 0.0
    stretch_x_ratio: float = 1.0
    stretch_y_ratio: float = 1.0
    upside_down: bool = False


@dataclass(frozen=True, slots=True)
class Beam:
    """How the beam burns: Gaussian, elliptic; a line of `through_s_mm` (power share over speed) just comes through."""

    radius_x_mm: float = 0.1
    radius_y_mm: float = 0.1
    through_s_mm: float = 0.012
    char_frac: float = 0.75
    char_at_ratio: float = 0.1


@dataclass(frozen=True, slots=True)
class Sheet:
    """The material. Grey values are of linear light, 0 black to 1 white."""

    size_mm: tuple[float, float]
    poses: tuple[Pose, ...] = (Pose(),)
    marks: tuple[Mark, ...] = ()
    grey_frac: float = 0.55
    texture_frac: float = 0.03
    thickness_mm: float = 0.0
    open_frac: float = 0.03  # what is seen through a slit; bright over a light table
    drop_mm2: float = 100.0  # pieces cut loose fall through the bed when smaller
    beam: Beam = Beam()


@dataclass(frozen=True, slots=True)
class Bed:
    """The machine's bed."""

    size_mm: tuple[float, float] = (300.0, 200.0)
    grey_frac: float = 0.3
    texture_frac: float = 0.05
    marks: tuple[Mark, ...] = ()
    marks_grey_frac: float = 0.85  # white of the paper the marks are printed on


@dataclass(frozen=True, slots=True)
class Charuco:
    """A ChArUco board held before the camera, another way in every frame."""

    columns_count: int
    rows_count: int
    square_mm: float
    marker_mm: float
    first_id: int = 150


@dataclass(frozen=True, slots=True)
class Camera:
    """Lens, place and weather. Turned away from straight down by `tilt_rad` towards `tilt_to_rad`."""

    size_px: tuple[int, int] = (2100, 1450)
    mm_per_px: float = 0.15
    focal_px: float = 2200.0
    centre_offset_px: tuple[float, float] = (9.0, -6.0)
    distortion_ratio: tuple[float, float, float, float, float] = (-0.16, 0.05, 0.0006, -0.0004, 0.0)
    looks_at_mm: tuple[float, float] = (150.0, 100.0)
    tilt_rad: float = 0.06
    tilt_to_rad: float = 0.7
    turn_rad: float = 0.01
    shift_mm: tuple[float, float] = (0.0, 0.0)  # the camera was knocked
    blur_px: float = 0.8
    noise_count: float = 2.0  # grey levels of 255
    vignette_frac: float = 0.3
    slope_frac: float = 0.2
    glare_count: int = 0
    dust_count: int = 0
    smoke_frac: float = 0.0
    exposure_ratio: float = 1.0


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything the camera sees, and the seed of its noise."""

    camera: Camera = Camera()
    bed: Bed = field(default_factory=lambda: default_bed())
    sheet: Sheet | None = None
    charuco: Charuco | None = None
    texel_mm: float | None = None  # None: a third of a pixel
    seed: int = 1


def default_bed() -> Bed:
    """Return a bed of 300 x 200 mm with twelve marks of 12 mm."""
    places = [(x, y) for y in (12.0, 100.0, 188.0) for x in (12.0, 104.0, 196.0, 288.0)]
    return Bed(marks=tuple(Mark(k, x, y, 12.0) for k, (x, y) in enumerate(places)))


def read_scene(path: Path) -> Scene:
    """Return the scene in the file; raise `ValueError` naming what is wrong."""
    try:
        return typing.cast(Scene, build(Scene, json.loads(path.read_text(encoding="utf-8")), str(path)))
    except json.JSONDecodeError as fault:
        raise ValueError(f"{path}:{fault.lineno}: not JSON: {fault.msg}") from fault


def build(kind: Any, data: Any, where: str) -> Any:
    """Return `data` (plain JSON) as the type `kind`: dataclasses, tuples, unions with None, numbers."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return None if data is None else build(next(k for k in inner if k is not type(None)), data, where)
    if origin is tuple:
        kinds = inner[:1] * len(data) if inner[-1] is Ellipsis else inner
        if len(kinds) != len(data):
            raise ValueError(f"{where}: {len(kinds)} values expected, not {len(data)}")
        return tuple(build(k, item, f"{where}[{i}]") for i, (k, item) in enumerate(zip(kinds, data, strict=True)))
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        known = {f.name for f in fields(kind)}
        strange = set(data) - known
        if strange:
            raise ValueError(f"{where}: unknown {', '.join(sorted(strange))}; known are {', '.join(sorted(known))}")
        made: Any = kind
        return made(**{key: build(hints[key], value, f"{where}.{key}") for key, value in data.items()})
    if kind is float and isinstance(data, int):
        return float(data)
    if not isinstance(data, kind):
        raise ValueError(f"{where}: {kind.__name__} expected, not {data!r}")
    return data
