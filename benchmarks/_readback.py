"""Readers of what the exporters write, written apart from them: DXF, SVG and G-code back to polylines."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
WORD = re.compile(r"([A-Z])([-+]?[0-9.]+)")


@dataclass(frozen=True, slots=True)
class Line:
    """One polyline as a reader found it; a closed one repeats its first point."""

    layer: str
    points_mm: Array


def read_dxf(text: str) -> list[Line]:
    """Return the polylines of a DXF."""
    import ezdxf

    found = []
    document: Any = ezdxf.read(io.StringIO(text))
    for entity in document.modelspace():
        points = np.array([(x, y) for x, y in entity.get_points("xy")])
        found.append(Line(entity.dxf.layer.lower(), _closed(points) if entity.closed else points))
    return found


def read_svg(text: str) -> list[Line]:
    """Return the polylines of an SVG in mm, y up."""
    root = ElementTree.fromstring(text)
    height = float(root.attrib["height"].removesuffix("mm"))
    found = []
    for group in root:
        for element in group:
            pairs = [pair.split(",") for pair in element.attrib["points"].split()]
            points = np.array([[float(x), height - float(y)] for x, y in pairs])
            found.append(Line(group.attrib["id"], _closed(points) if element.tag.endswith("polygon") else points))
    return found


def read_gcode(lines: tuple[str, ...] | list[str]) -> tuple[list[Array], list[str]]:
    """Return what the beam draws, and everything in the program that GRBL in laser mode should not be told."""
    at, motion, power, feed, armed = np.zeros(2), 0, 0.0, 0.0, False
    found: list[list[Array]] = []
    faults = []
    for line in lines:
        body = line.split(";")[0]
        words = WORD.findall(body)
        if "".join(f"{letter}{number}" for letter, number in words) != body:
            faults.append(f"not understood: {line}")
        target = at.copy()
        moves = False
        for letter, number in words:
            value = float(number)
            if letter == "G" and value in (0, 1):
                motion = int(value)
            elif (letter == "G" and value not in (4, 17, 21, 90, 94)) or (letter == "M" and value not in (4, 5)):
                faults.append(f"unexpected {line}")
            elif letter == "M":
                armed = value == 4
            elif letter == "S":
                power = value
            elif letter == "F":
                feed = value
            elif letter in "XY":
                target["XY".index(letter)] = value
                moves = True
        if moves and motion == 0:
            found.append([target])
        elif moves:
            if not (armed and power > 0 and feed > 0):
                faults.append(f"cuts without power or speed: {line}")
            found[-1].append(target)
        at = target
    if armed:
        faults.append("the beam is on at the end")
    return [np.array(points) for points in found if len(points) > 1], faults


def _closed(points: Array) -> Array:
    return np.vstack([points, points[:1]])
