"""Poses of photogrammetry pictures from COLMAP's text model: `cameras.txt` and `images.txt`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fabctl.errors import UsageError
from fabctl.files import picture_of, text_of
from fabctl.vision.boards import MarkSheet
from fabctl.vision.markers import find_markers
from fabctl.vision.scale import ScanScale, ShotPose, scale_by_shots
from fabctl.vision.template import F64

# model -> where fx, fy, cx, cy and k1, k2, p1, p2 stand among its parameters
MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
}


def read_model(folder: Path) -> dict[str, ShotPose]:
    """Return picture name -> pose; raise `UsageError` naming file and line."""
    lenses = {}
    for number, words in _rows(folder / "cameras.txt"):
        try:
            lenses[words[0]] = _lens(words[1], [float(word) for word in words[4:]])
        except (KeyError, IndexError, ValueError) as fault:
            known = ", ".join(MODELS)
            raise UsageError(
                f"{folder / 'cameras.txt'}:{number}: not a camera ({_why(fault)}); known are {known}"
            ) from fault
    poses = {}
    # Each picture has two lines; the second lists its feature points, and may be empty.
    for number, words in _rows(folder / "images.txt", every_second=True):
        try:
            quaternion, t = np.array(words[1:5], dtype=np.float64), np.array(words[5:8], dtype=np.float64)
            K, distortion = lenses[words[8]]
            poses[" ".join(words[9:])] = ShotPose(K, distortion, _rotation(quaternion), t)
        except (KeyError, IndexError, ValueError) as fault:
            raise UsageError(f"{folder / 'images.txt'}:{number}: not a picture's pose ({_why(fault)})") from fault
    if not poses:
        raise UsageError(f"{folder / 'images.txt'}: no pictures")
    return poses


def scale_from_pictures(model: Path, pictures: Path, sheet: MarkSheet) -> ScanScale:
    """Return scale and first pose of a scan from its pictures: marks found, placed by the poses, compared with `sheet`.

    COLMAP puts pixel centres at halves; OpenCV at whole numbers.
    """
    known = {mark.id for mark in sheet.marks}
    shots = []
    for name, pose in read_model(model).items():
        markers = find_markers(picture_of(pictures / name).image, sheet.family)
        shots.append((pose, {m.id: m.centre_px + 0.5 for m in markers if m.id in known}))
    return scale_by_shots(shots, sheet)


def _rows(path: Path, every_second: bool = False) -> list[tuple[int, list[str]]]:
    lines = text_of(path, "a COLMAP text model").splitlines()
    rows = [(n, line.split()) for n, line in enumerate(lines, start=1) if not line.startswith("#")]
    if every_second:
        return [row for row in rows[::2] if row[1]]
    return [row for row in rows if row[1]]


def _why(fault: Exception) -> str:
    """Return what a line of numbers lacks, in words."""
    if isinstance(fault, KeyError):
        return f"{fault.args[0]} is not known"
    return "too few words" if isinstance(fault, IndexError) else "a number was expected"


def _lens(model: str, numbers: list[float]) -> tuple[F64, F64]:
    (fx, fy, cx, cy), more = MODELS[model]
    K = np.array([[numbers[fx], 0, numbers[cx]], [0, numbers[fy], numbers[cy]], [0, 0, 1.0]])
    distortion = np.zeros(4)
    distortion[: len(more)] = [numbers[k] for k in more]
    return K, distortion


def _rotation(quaternion: F64) -> F64:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
