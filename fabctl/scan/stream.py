"""Clouds read a piece at a time and thinned on the way, so that no file is ever held whole.

Every point gets a random number; those with the smallest stay. That is an even draw whatever the file's length, needs
no second pass, and the same seed keeps the same points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.errors import RefusedError, UnreadableInput
from fabctl.scan.columns import HEAD_BYTES, Columns, comma_is_decimal, named_columns, said_columns

Floats = NDArray[np.float64]
Triple = tuple[int, int, int]

PIECE = 500_000  # points of a binary file read at once
TEXT_BYTES = 32_000_000  # bytes of a text file read at once
COLUMNS = 9  # of a text file: place, normal, colour
KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Piece:
    """Some points of a file; `extra` has six columns, the normal and the colour (0 to 255), NaN where there is none."""

    points: Floats  # (n, 3)
    extra: NDArray[np.float32]  # (n, 6)


@dataclass(frozen=True, slots=True)
class Drawn:
    """What was kept of a file, how many points it holds, and how many of them are not numbers."""

    points: Floats
    normals: Floats | None
    colours: NDArray[np.uint8] | None
    total_count: int
    not_numbers_count: int


def draw(pieces: Iterator[Piece], most: int, seed: int) -> Drawn:
    """Return up to `most` points of all the pieces, drawn evenly, in the file's order."""
    rng = np.random.default_rng(seed)
    held: list[tuple[Floats, Floats, NDArray[np.float32]]] = []
    limit, count, total, lost = 1.0, 0, 0, 0
    for piece in pieces:
        good = np.asarray(np.isfinite(piece.points).all(axis=1))
        lost += int((~good).sum())
        total += len(good)
        key = rng.random(len(good))
        good &= key < limit
        held.append((key[good], piece.points[good], piece.extra[good]))
        count += int(good.sum())
        if count > 1.3 * most:
            held, limit, count = *_smallest(held, most), most
    if count > most:
        held, _ = _smallest(held, most)
    if not held:
        return Drawn(np.zeros((0, 3)), None, None, 0, 0)
    points, extra = np.concatenate([h[1] for h in held]), np.concatenate([h[2] for h in held])
    normals = extra[:, :3].astype(np.float64) if np.isfinite(extra[:, :3]).all() else None
    colours = np.clip(np.round(extra[:, 3:]), 0, 255).astype(np.uint8) if np.isfinite(extra[:, 3:]).all() else None
    return Drawn(points, normals, colours, total, lost)


def _smallest(
    held: list[tuple[Floats, Floats, NDArray[np.float32]]], most: int
) -> tuple[list[tuple[Floats, Floats, NDArray[np.float32]]], float]:
    """Return the points with the `most` smallest keys, piece by piece, and the key they end at."""
    limit = float(np.partition(np.concatenate([key for key, _, _ in held]), most)[most])
    kept = []
    for key, points, extra in held:
        stays = key < limit
        kept.append((key[stays], points[stays], extra[stays]))
    return kept, limit


def _extra(normals: Floats | None, colours: Floats | None, count: int) -> NDArray[np.float32]:
    found = np.full((count, 6), np.nan, dtype=np.float32)
    if normals is not None:
        found[:, :3] = normals
    if colours is not None:
        found[:, 3:] = colours
    return found


# --- PLY -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """A PLY file that is points alone: its numbers' kinds and where they begin."""

    form: str  # ascii, binary_little_endian, binary_big_endian
    count: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    offset: int


def ply_header(path: Path) -> PlyHeader | None:
    """Return the header, or None where the file is a mesh or not of the plain kind read here."""
    form, elements, names, kinds = "", [], [], []
    with path.open("rb") as stream:
        if stream.readline(80).strip() != b"ply":
            return None
        for _ in range(500):
            words = stream.readline(1000).decode("ascii", errors="replace").split()
            if not words or words[0] == "end_header":
                break
            if words[0] == "format" and len(words) > 1:
                form = words[1]
            elif words[0] == "element" and len(words) == 3:
                elements.append((words[1], int(words[2]) if words[2].isdigit() else -1))
            elif words[0] == "property" and elements and elements[-1][0] == "vertex":
                if len(words) != 3 or words[1] not in KINDS:
                    return None
                kinds.append(KINDS[words[1]])
                names.append(words[2])
        offset = stream.tell()
    filled = [e for e in elements if e[1] != 0]
    plain = len(filled) == 1 and filled[0][0] == "vertex" and filled[0][1] > 0 and elements[0][0] == "vertex"
    unique = len(set(names)) == len(names) and {"x", "y", "z"} <= set(names)
    return PlyHeader(form, filled[0][1], tuple(names), tuple(kinds), offset) if plain and unique else None


def ply_pieces(path: Path, header: PlyHeader) -> Iterator[Piece]:
    """Yield the points of the file; raises `RefusedError` where it ends before its header says."""
    if header.form == "ascii":
        yield from _ply_text(path, header)
        return
    order = ">" if header.form == "binary_big_endian" else "<"
    row = np.dtype([(n, order + k) for n, k in zip(header.names, header.kinds, strict=True)])
    with path.open("rb") as stream:
        stream.seek(header.offset)
        left = header.count
        while left > 0:
            table = np.fromfile(stream, dtype=row, count=min(PIECE, left))
            if len(table) == 0:
                raise _cut_short(path, header.count, left)
            left -= len(table)
            yield _ply_piece({name: table[name] for name in header.names}, header)


def _ply_text(path: Path, header: PlyHeader) -> Iterator[Piece]:
    left, width = header.count, len(header.names)
    for rows, _ in text_rows(path, header.offset, width):
        rows = rows[:left]
        left -= len(rows)
        yield _ply_piece({name: rows[:, k] for k, name in enumerate(header.names)}, header)
        if left == 0:
            return
    raise _cut_short(path, header.count, left)


def _ply_piece(column: dict[str, NDArray[np.generic]], header: PlyHeader) -> Piece:
    def stacked(names: tuple[str, ...]) -> Floats | None:
        if not set(names) <= set(column):
            return None
        return np.stack([np.asarray(column[n], dtype=np.float64) for n in names], axis=1)

    points = stacked(("x", "y", "z"))
    assert points is not None
    colours = stacked(("red", "green", "blue"))
    if colours is not None:
        kind = header.kinds[header.names.index("red")]
        full = 65535.0 if kind == "u2" else 1.0 if kind[0] == "f" and colours.max(initial=0.0) <= 1 else 255.0
        colours = colours * (255.0 / full)
    return Piece(points, _extra(stacked(("nx", "ny", "nz")), colours, len(points)))


def _cut_short(path: Path, count: int, left: int) -> RefusedError:
    said = f"the file ends after {count - left} of {count} points"
    return UnreadableInput(f"{path}: cannot be compared", [Finding("SCAN-CUT", said, where=str(path))])


# --- text ------------------------------------------------------------------------------------------------------------


def text_rows(
    path: Path, offset: int = 0, width: int | None = None, *, decimal_comma: bool = False
) -> Iterator[tuple[Floats, int]]:
    """Yield rows of numbers and how many lines in between hold none; the first line with three numbers sets the width.

    Numbers are parted by blanks, commas or semicolons; with `decimal_comma` the comma belongs to the number.
    """
    marks = bytes.maketrans(b",;\t", b".  " if decimal_comma else b"   ")
    with path.open("rb") as stream:
        stream.seek(offset)
        while True:
            text = stream.read(TEXT_BYTES)
            if not text:
                return
            text += stream.readline()
            text = text.translate(marks)
            if width is None:
                width = _width(text)
            if width is not None:
                yield _rows(text, width)
            else:
                yield np.zeros((0, 3)), text.count(b"\n")


def _width(text: bytes) -> int | None:
    for line in text.splitlines():
        row = _numbers(line)
        if row is not None and len(row) >= 3:
            return len(row)
    return None


def _rows(text: bytes, width: int) -> tuple[Floats, int]:
    """Return the numbers in rows: at once where every line is well made, line by line where not."""
    lines = text.count(b"\n") + (0 if text.endswith(b"\n") else 1)
    try:
        flat = np.array(text.split(), dtype=np.float64)
    except ValueError:
        flat = np.zeros(0)
    if len(flat) == lines * width:
        return flat.reshape(-1, width), 0
    found = [_numbers(line) for line in text.splitlines() if line.strip()]
    good = [row[:width] for row in found if row is not None and len(row) >= width]
    return np.array(good, dtype=np.float64).reshape(-1, width), len(found) - len(good)


def _numbers(line: bytes) -> list[float] | None:
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        return None


def text_pieces(path: Path, skipped: list[int], said: list[Finding]) -> Iterator[Piece]:
    """Yield the points of a text file; lines without a point are counted in `skipped`.

    Columns are those the header names, which is `said`; without one they are `x y z [nx ny nz] [r g b]`.
    """
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    named = named_columns(head, str(path))
    if named is not None:
        said.append(said_columns(named))
    meant: tuple[Triple, Triple | None, Triple | None, float] | None = None
    for rows, lost in text_rows(path, decimal_comma=comma_is_decimal(head)):
        skipped.append(lost)
        if len(rows) == 0:
            continue
        meant = meant or (_meaning(rows) if named is None else _as_named(rows, named, path))
        places, normals, colours, gain = meant
        yield Piece(
            np.ascontiguousarray(rows[:, places]),
            _extra(
                None if normals is None else rows[:, normals],
                None if colours is None else gain * rows[:, colours],
                len(rows),
            ),
        )


def _as_named(rows: Floats, named: Columns, path: Path) -> tuple[Triple, Triple | None, Triple | None, float]:
    if rows.shape[1] < named.width:
        said = f"the header names {named.width} columns, the rows have {rows.shape[1]}"
        raise RefusedError(f"{path}: cannot be compared", [Finding("SCAN-HEADER", said, where=str(path))])
    most = 0.0 if named.colours is None else float(rows[:, named.colours].max())
    gain = 255.0 if most <= 1 else 1.0 if most <= 255 else 1 / 257
    return named.places, named.normals, named.colours, gain


def _meaning(rows: Floats) -> tuple[Triple, Triple | None, Triple | None, float]:
    """Return the columns of places, normals and colours by their range, and what makes the colours 0 to 255."""
    normals = colours = None
    gain = 1.0
    for at in range(3, min(rows.shape[1], COLUMNS + 1) - 2):
        some = rows[:, at : at + 3]
        length = np.linalg.norm(some, axis=1)
        if normals is None and float(np.mean(np.abs(length - 1) < 0.02)) > 0.9:
            normals = at
        elif colours is None and (normals is None or at >= normals + 3) and some.min() >= 0 and some.max() <= 255:
            colours, gain = at, 255.0 if some.max() <= 1 else 1.0
            if rows.shape[1] == 7 and at == 3:  # x y z intensity r g b
                colours = 4
    return (0, 1, 2), _three_from(normals), _three_from(colours), gain


def _three_from(first: int | None) -> Triple | None:
    return None if first is None else (first, first + 1, first + 2)


# --- LAS -------------------------------------------------------------------------------------------------------------


def las_pieces(path: Path) -> Iterator[Piece]:
    """Yield the points of a LAS or LAZ file; raises `RefusedError` for what is none."""
    import laspy

    try:
        with laspy.open(path) as file:
            coloured = "red" in file.header.point_format.dimension_names
            gain: float | None = None
            for part in file.chunk_iterator(PIECE):
                points = np.stack([np.asarray(part.x), np.asarray(part.y), np.asarray(part.z)], axis=1)
                colours = None
                if coloured:
                    colours = np.stack(
                        [np.asarray(part[k], dtype=np.float64) for k in ("red", "green", "blue")], axis=1
                    )
                    gain = gain or (1 / 257 if len(colours) and colours.max() > 255 else 1.0)
                    colours = colours * gain
                yield Piece(points.astype(np.float64), _extra(None, colours, len(points)))
    except (laspy.errors.LaspyException, OSError, ValueError) as fault:
        said = Finding("SCAN-LAS", "not a LAS file, or damaged", where=str(path))
        raise UnreadableInput(f"{path}: cannot be compared", [said]) from fault
