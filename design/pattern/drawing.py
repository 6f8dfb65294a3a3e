"""The drawn sheet: its size, its paths and the place kept free for the specimen's id. `paths.json` is this, as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from design.errors import DesignError
from design.pattern.font import Anchor
from design.pattern.paths import LAYERS, CutPath

FORMAT = 1
DECIMALS = 6  # a nanometre: rounding never shows, and the file stays readable


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle on the sheet by its lower left corner."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float


@dataclass(frozen=True, slots=True)
class Drawing:
    """What is to be cut, in sheet millimetres from the sheet's lower left corner, before kerf and ordering.

    `id_anchor` is where the specimen's id is engraved as text, `code_box` the room kept beside it for its code;
    `more_ids` are further places for the text, on a sheet that parts into several pieces.
    """

    size_mm: tuple[float, float]
    paths: tuple[CutPath, ...]
    id_anchor: Anchor | None = None
    code_box: Box | None = None
    more_ids: tuple[Anchor, ...] = ()


def as_json(drawing: Drawing) -> dict[str, Any]:
    """Return the drawing as plain JSON."""
    return {
        "format": FORMAT,
        "sheet_mm": list(drawing.size_mm),
        "id_anchor": asdict(drawing.id_anchor) if drawing.id_anchor else None,
        "code_box": asdict(drawing.code_box) if drawing.code_box else None,
        **({"more_ids": [asdict(anchor) for anchor in drawing.more_ids]} if drawing.more_ids else {}),
        "paths": [
            {
                "layer": path.layer,
                "points_mm": np.round(path.points_mm, DECIMALS).tolist(),
                "closed": path.closed,
                "cell": path.cell,
                "opens": path.opens,
            }
            for path in drawing.paths
        ],
    }


def from_json(data: Mapping[str, Any]) -> Drawing:
    """Return the drawing in plain JSON; raise `DesignError` where it is not one."""
    if data.get("format") != FORMAT:
        raise DesignError(f"paths of format {data.get('format')!r}; this program reads format {FORMAT}")
    try:
        width, height = (float(value) for value in data["sheet_mm"])
        anchor = Anchor(**data["id_anchor"]) if data.get("id_anchor") else None
        code = Box(**data["code_box"]) if data.get("code_box") else None
        more = tuple(Anchor(**item) for item in data.get("more_ids", ()))
        paths = tuple(_path(item) for item in data["paths"])
    except (KeyError, TypeError, ValueError) as fault:
        raise DesignError(f"the paths are not as this program writes them: {fault!r}") from fault
    return Drawing((width, height), paths, anchor, code, more)


def _path(item: Mapping[str, Any]) -> CutPath:
    if item["layer"] not in LAYERS:
        raise ValueError(f"layer {item['layer']!r}")
    points = np.array(item["points_mm"], dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError("points that are not finite pairs")
    return CutPath(item["layer"], points, bool(item["closed"]), item.get("cell"), bool(item.get("opens", False)))
