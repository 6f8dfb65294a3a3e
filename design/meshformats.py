"""OBJ, PLY and STL as bytes: what is written there, and every fault in it. Knows nothing of files or surfaces."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding

NAMED_count = 5  # so many faulty lines are named, the others counted
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


class BadFile(Exception):
    """The bytes cannot be understood from here on; carries the finding that says why."""

    def __init__(self, code: str, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.finding = Finding(code, message, hint=hint)


@dataclass(slots=True)
class Soup:
    """What a file holds: points, polygons over them (any number of corners), and findings on the way."""

    points: NDArray[np.float64]  # (n, 3)
    polygons: list[list[int]] | NDArray[np.int64]
    findings: list[Finding] = field(default_factory=list)
    texture: NDArray[np.float64] | None = None  # (k, 2), OBJ only
    texture_polygons: list[list[int]] | NDArray[np.int64] = field(default_factory=list)


def parse_obj(data: bytes) -> Soup:
    """Return the points and polygons of an OBJ file; `f v`, `v/vt`, `v//vn`, `v/vt/vn` and negative indices."""
    _refuse_binary(data, "OBJ")
    lines = data.decode("utf-8", errors="replace").replace("\\\n", " ").splitlines()
    return _obj_at_once(lines) or _obj_line_by_line(lines)


def _obj_at_once(lines: list[str]) -> Soup | None:
    """Return a plain file's contents, ten times as fast; None where any line is out of the ordinary."""
    sorts = {line.split(None, 1)[0] if line[:1].strip() else "" for line in lines if line.strip()}
    if not sorts <= {"v", "vt", "vn", "f", "o", "g", "s", "#", "usemtl", "mtllib"}:
        return None
    chosen = {
        sort: [line[len(sort) + 1 :] for line in lines if line.startswith(sort + " ")] for sort in ("v", "vt", "f")
    }
    faces = chosen["f"]
    if not chosen["v"] or not faces:
        return None
    corners = len(faces[0].split())
    kinds = faces[0].count("/") // corners + 1 if "//" not in faces[0] else 2
    if any(line.count("/") != faces[0].count("/") or line.count("//") != faces[0].count("//") for line in faces):
        return None
    try:
        points = np.loadtxt(chosen["v"], ndmin=2)
        texture = np.loadtxt(chosen["vt"], ndmin=2) if chosen["vt"] else None
        table = np.loadtxt([line.replace("/", " ") for line in faces], dtype=np.int64, ndmin=2)
    except ValueError:
        return None
    if table.shape[1] != corners * kinds or (table <= 0).any() or points.shape[1] not in (3, 6):
        return None
    soup = Soup(points[:, :3], table[:, ::kinds] - 1)
    if texture is not None and texture.shape[1] >= 2 and kinds > 1 and "//" not in faces[0]:
        soup.texture, soup.texture_polygons = texture[:, :2], table[:, 1::kinds] - 1
    return soup


def _obj_line_by_line(lines: list[str]) -> Soup:
    points: list[list[float]] = []
    texture: list[list[float]] = []
    polygons: list[list[int]] = []
    texture_polygons: list[list[int]] = []
    bad_lines: list[int] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == "v":
                points.append([float(words[1]), float(words[2]), float(words[3])])
            elif words[0] == "vt":
                texture.append([float(words[1]), float(words[2])])
            elif words[0] == "f":
                corners = [word.split("/") for word in words[1:]]
                polygons.append([_from_one(corner[0], len(points)) for corner in corners])
                if all(len(corner) > 1 and corner[1] for corner in corners):
                    texture_polygons.append([_from_one(corner[1], len(texture)) for corner in corners])
        except (ValueError, IndexError):
            bad_lines.append(number)
    if not points and not polygons and not bad_lines:
        raise BadFile("FILE-FORMAT", "there is no vertex and no face in the file", "is it an OBJ file?")
    soup = Soup(np.array(points, dtype=np.float64).reshape(-1, 3), polygons, _bad_lines(bad_lines))
    if texture and len(texture_polygons) == len(polygons):
        soup.texture, soup.texture_polygons = np.array(texture), texture_polygons
    return soup


def _from_one(word: str, count: int) -> int:
    """Return a zero-based index; OBJ counts from one, and from the end where negative."""
    index = int(word)
    if index == 0:
        raise ValueError("OBJ counts from one")
    return index - 1 if index > 0 else count + index


def _bad_lines(numbers: list[int]) -> list[Finding]:
    if not numbers:
        return []
    shown = ", ".join(map(str, numbers[:NAMED_count])) + (" …" if len(numbers) > NAMED_count else "")
    hint = "the file may have been cut short"
    return [Finding("FILE-LINE", f"{len(numbers)} line(s) cannot be read: {shown}", hint=hint)]


def _refuse_binary(data: bytes, kind: str) -> None:
    if b"\0" in data[:65536]:
        raise BadFile("FILE-BINARY", f"this is binary data, not an {kind} text", "was it saved under another name?")


def parse_ply(data: bytes) -> Soup:
    """Return the points and polygons of a PLY file: ascii, binary little endian or big endian."""
    head = re.match(rb"ply\s*\n(.*?)end_header[ \t]*\r?\n", data, re.DOTALL)
    if not data.startswith(b"ply"):
        raise BadFile("FILE-FORMAT", "a PLY file begins with the word `ply`, this one does not")
    if head is None:
        raise BadFile("FILE-TRUNCATED", "the PLY header has no end", "the file was cut short")
    order, elements = _ply_header(head.group(1).decode("ascii", errors="replace"))
    body = data[head.end() :]
    tables = _ply_ascii(body, elements) if order == "" else _ply_binary(body, elements, order)
    missing = [axis for axis in "xyz" if axis not in tables.get("vertex", {})]
    if missing:
        raise BadFile("FILE-FORMAT", f"the PLY vertices have no {', '.join(missing)}")
    points = np.column_stack([np.asarray(tables["vertex"][axis], dtype=np.float64) for axis in "xyz"])
    lists = tables.get("face", {})
    polygons = lists.get("vertex_indices", lists.get("vertex_index", []))
    return Soup(points, polygons if isinstance(polygons, np.ndarray) else [list(map(int, p)) for p in polygons])


_Element = tuple[str, int, list[tuple[str, str, str]]]  # name, rows, (property, type, type of the list's length or "")


def _ply_header(text: str) -> tuple[str, list[_Element]]:
    order: str | None = None
    elements: list[_Element] = []
    for line in text.splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append((words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[2], _PLY_TYPES[words[1]], ""))
        except (KeyError, IndexError, ValueError) as fault:
            raise BadFile("FILE-FORMAT", f"the PLY header line `{line.strip()}` cannot be read") from fault
    if order is None:
        raise BadFile("FILE-FORMAT", "the PLY header names no format")
    return order, elements


def _cut_short(name: str, done: int, rows: int) -> BadFile:
    return BadFile("FILE-TRUNCATED", f"the PLY file ends at {name} {done} of {rows}", "the file was cut short")


def _ply_ascii(body: bytes, elements: list[_Element]) -> dict[str, dict[str, Any]]:
    if b"\0" in body[:65536]:
        raise BadFile("FILE-BINARY", "the header says ascii, the data are binary", "export the file again")
    lines = iter([words for line in body.splitlines() if (words := line.split())])
    tables: dict[str, dict[str, Any]] = {}
    for name, rows, properties in elements:
        columns: list[list[Any]] = [[] for _ in properties]
        for row in range(rows):
            words = next(lines, [])
            if not words:
                raise _cut_short(name, row, rows)
            try:
                _ply_row(list(map(float, words)), properties, columns)
            except (ValueError, IndexError) as fault:
                raise BadFile("FILE-LINE", f"{name} {row} of the PLY file cannot be read") from fault
        tables[name] = {key: column for (key, _, _), column in zip(properties, columns, strict=True)}
    return tables


def _ply_row(numbers: list[float], properties: list[tuple[str, str, str]], columns: list[list[Any]]) -> None:
    at = 0
    for (_, _, length), column in zip(properties, columns, strict=True):
        if length:
            size = int(numbers[at])
            if at + 1 + size > len(numbers):
                raise IndexError
            column.append(numbers[at + 1 : at + 1 + size])
            at += 1 + size
        else:
            column.append(numbers[at])
            at += 1


def _ply_binary(body: bytes, elements: list[_Element], order: str) -> dict[str, dict[str, Any]]:
    tables: dict[str, dict[str, Any]] = {}
    at = 0
    for name, rows, properties in elements:
        table, at = _ply_table(body, at, name, rows, properties, order)
        tables[name] = table
    return tables


def _ply_table(
    body: bytes, at: int, name: str, rows: int, properties: list[tuple[str, str, str]], order: str
) -> tuple[dict[str, Any], int]:
    """Read `rows` rows at once; every list must be as long as in the first row, else row by row."""
    if rows == 0:
        return {key: np.empty((0, 3) if length else 0) for key, _, length in properties}, at
    row_type = _ply_row_type(body, at, properties, order)
    if row_type is not None and at + rows * row_type.itemsize <= len(body):
        table = np.frombuffer(body, dtype=row_type, count=rows, offset=at)
        if all((table[f"{key}#"] == table[f"{key}#"][0]).all() for key, _, length in properties if length):
            return {key: table[key] for key, _, _ in properties}, at + rows * row_type.itemsize
    return _ply_rows(body, at, name, rows, properties, order)


def _ply_row_type(body: bytes, at: int, properties: list[tuple[str, str, str]], order: str) -> np.dtype[np.void] | None:
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for key, kind, length in properties:
        if length:
            offset = at + np.dtype(fields).itemsize if fields else at
            if offset + np.dtype(length).itemsize > len(body):
                return None
            size = int(np.frombuffer(body, dtype=order + length, count=1, offset=offset)[0])
            fields += [(f"{key}#", order + length), (key, order + kind, (size,))]
        else:
            fields.append((key, order + kind))
    return np.dtype(fields)


def _ply_rows(
    body: bytes, at: int, name: str, rows: int, properties: list[tuple[str, str, str]], order: str
) -> tuple[dict[str, Any], int]:
    columns: dict[str, list[object]] = {key: [] for key, _, _ in properties}
    for row in range(rows):
        for key, kind, length in properties:
            size, width = 1, np.dtype(kind).itemsize
            if length:
                if at + np.dtype(length).itemsize > len(body):
                    raise _cut_short(name, row, rows)
                size = int(np.frombuffer(body, dtype=order + length, count=1, offset=at)[0])
                at += np.dtype(length).itemsize
            if size < 0 or at + size * width > len(body):
                raise _cut_short(name, row, rows)
            values = np.frombuffer(body, dtype=order + kind, count=size, offset=at)
            columns[key].append(values if length else values[0])
            at += size * width
    return {key: np.array(column, dtype=object) for key, column in columns.items()}, at


def parse_stl(data: bytes) -> Soup:
    """Return the triangles of an STL file, text or binary; every triangle has points of its own."""
    if len(data) >= 84:
        count = int(np.frombuffer(data, dtype="<u4", count=1, offset=80)[0])
        if len(data) == 84 + 50 * count:
            return _stl_binary(data, count)
    if data.lstrip()[:5] == b"solid" and b"\0" not in data[:65536]:
        return _stl_text(data)
    if len(data) >= 84 and len(data) < 84 + 50 * count <= 84 + 50 * 10**8:
        message = f"the STL file promises {count} triangles and holds {(len(data) - 84) // 50}"
        raise BadFile("FILE-TRUNCATED", message, "the file was cut short")
    raise BadFile("FILE-FORMAT", "this is neither a text nor a binary STL file")


def _stl_binary(data: bytes, count: int) -> Soup:
    rows = np.frombuffer(data, dtype=[("floats", "<f4", (4, 3)), ("extra", "<u2")], count=count, offset=84)
    points = rows["floats"][:, 1:].reshape(-1, 3).astype(np.float64)
    return Soup(points, np.arange(3 * count).reshape(-1, 3))


def _stl_text(data: bytes) -> Soup:
    points: list[list[float]] = []
    bad_lines: list[int] = []
    ended = False
    for number, line in enumerate(data.decode("utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        if words[:1] == ["vertex"]:
            try:
                points.append([float(words[1]), float(words[2]), float(words[3])])
            except (ValueError, IndexError):
                bad_lines.append(number)
        ended = ended or words[:1] == ["endsolid"]
    if not ended or len(points) % 3:
        raise BadFile("FILE-TRUNCATED", "the STL text does not come to `endsolid`", "the file was cut short")
    return Soup(np.array(points).reshape(-1, 3), np.arange(len(points)).reshape(-1, 3), _bad_lines(bad_lines))
