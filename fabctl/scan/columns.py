"""What the columns of a text file of points mean: by the names in its header, and how its numbers are written."""

from __future__ import annotations

import re
from dataclasses import dataclass

from design.findings import Finding
from fabctl.errors import RefusedError

HEAD_BYTES = 65_536
AXES = {"x": 0, "y": 1, "z": 2, "0": 0, "1": 1, "2": 2}
PREFIXES = ("", "p", "pos", "position", "point", "points", "coord", "coordinate", "scan")
NORMALS = {f"{prefix}{axis}": k for prefix in ("n", "normal", "normals") for axis, k in AXES.items()}
PLACES = {f"{prefix}{axis}": k for prefix in PREFIXES for axis, k in AXES.items() if prefix or not axis.isdigit()}
COLOURS = {
    "r": 0,
    "g": 1,
    "b": 2,
    "red": 0,
    "green": 1,
    "blue": 2,
    "diffusered": 0,
    "diffusegreen": 1,
    "diffuseblue": 2,
}
UNITS_MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "in": 25.4, "inch": 25.4, "ft": 304.8}
UNIT = re.compile(r"[\s_]*[\[(]\s*([a-zA-Z]+)\s*[\])]$|[\s_]+(um|mm|cm|dm|m|in|inch|ft)$")
DECIMAL_COMMA = re.compile(rb"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a row holds its place, normal and colour, as the header names them, and the unit of the place."""

    width: int
    places: tuple[int, int, int]
    normals: tuple[int, int, int] | None
    colours: tuple[int, int, int] | None
    unit: str | None


def comma_is_decimal(head: bytes) -> bool:
    """Return whether numbers are written with a comma, `1,5 2,0 3,25` or `1,5;2,0;3,25`, in the file's first lines."""
    said = False
    for line in head.splitlines()[:200]:
        words = line.replace(b";", b" ").split()
        if len(words) < 3 or not all(DECIMAL_COMMA.fullmatch(w) for w in words):
            continue
        said |= any(b"," in w for w in words)
    return said


def named_columns(head: bytes, where: str) -> Columns | None:
    """Return what the header says, or None where no line before the numbers names x, y and z.

    Raises `RefusedError` where it names one of them twice, or gives them different units.
    """
    for line in head.decode("utf-8-sig", errors="replace").splitlines()[:50]:
        words = _words(line)
        if len(words) >= 3 and all(_is_number(w) for w in words):
            return None
        found = _meanings(words)
        if all(any(kind == "place" and k == axis for kind, k, _ in found) for axis in range(3)):
            return _columns(words, found, where)
    return None


def _words(line: str) -> list[str]:
    line = line.strip().lstrip("#/").strip()
    for mark in (";", ",", "\t"):
        if mark in line:
            return [w.strip().strip('"') for w in line.split(mark)]
    return [w.strip('"') for w in re.sub(r"\s+([\[(])", r"\1", line).split()]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _meanings(words: list[str]) -> list[tuple[str, int, str | None]]:
    found = []
    for word in words:
        unit = UNIT.search(word)
        name = re.sub(r"[\s_:.\-]", "", word[: unit.start()] if unit else word).lower()
        said = (unit.group(1) or unit.group(2)).lower() if unit else None
        for kind, names in (("place", PLACES), ("normal", NORMALS), ("colour", COLOURS)):
            if name in names:
                found.append((kind, names[name], said))
                break
        else:
            found.append(("other", -1, None))
    return found


def _columns(words: list[str], found: list[tuple[str, int, str | None]], where: str) -> Columns:
    def of(kind: str) -> tuple[int, int, int] | None:
        at = [[n for n, f in enumerate(found) if f[:2] == (kind, axis)] for axis in range(3)]
        if kind == "place" and any(len(a) > 1 for a in at):
            twice = ", ".join(words[n] for a in at if len(a) > 1 for n in a)
            raise _refused(where, f"the header names a coordinate more than once: {twice}")
        return (at[0][0], at[1][0], at[2][0]) if all(at) else None

    places = of("place")
    assert places is not None
    units = {found[n][2] for n in places}
    if len(units) > 1:
        raise _refused(where, "the header gives x, y and z in different units: " + ", ".join(words[n] for n in places))
    return Columns(len(words), places, of("normal"), of("colour"), units.pop())


def _refused(where: str, said: str) -> RefusedError:
    return RefusedError(f"{where}: cannot be compared", [Finding("SCAN-HEADER", said, where=where)])


def said_columns(columns: Columns) -> Finding:
    """Return how the header was understood; a unit in it is told, not applied: the cloud keeps the file's units."""
    rest = [name for name, at in (("normals", columns.normals), ("colours", columns.colours)) if at]
    said = "columns were taken by the names in the header: x, y, z" + "".join(f", {name}" for name in rest)
    size = UNITS_MM.get(columns.unit or "")
    hint = "" if size is None else f"the header says {columns.unit}: with --scale known give --unit-mm {size:g}"
    return Finding("SCAN-COLUMNS", said, level="info", hint=hint)
