"""Pictures as telephones, machine cameras and bad cables make them: measured rightly, or refused by name."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fabctl.cli.common import run_guarded
from fabctl.cli.main import cli
from fabctl.config.boards import config_of, write_board
from fabctl.errors import REFUSED, USAGE
from fabctl.vision.bed import alignment_path, lens_path
from fabctl.vision.lens import Lens, find_board, write_lens
from fabctl.workspace import Workspace
from simulators.camera.picture import Studio
from tests.fabctl.vision.conftest import BED, BOARD, bed_scene

Picture = NDArray[np.uint8]
Deep = NDArray[np.uint16]


def encoded(picture: NDArray[np.uint8] | Deep, suffix: str = ".png", *how: int) -> bytes:
    return cv2.imencode(suffix, picture, list(how))[1].tobytes()


def turned_by_note(picture: Picture, orientation: int) -> bytes:
    """Return a JPEG of the sensor's picture with an EXIF note that says how to turn it."""
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01" + orientation.to_bytes(2, "big") + b"\x00\x00"
    tiff = b"MM\x00\x2a\x00\x00\x00\x08" + b"\x00\x01" + entry + b"\x00\x00\x00\x00"
    body = b"Exif\x00\x00" + tiff
    jpeg = encoded(picture, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95)
    return jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:]


def with_alpha(picture: Picture) -> bytes:
    return encoded(np.dstack([picture] * 3 + [np.full_like(picture, 128)]))


def run(tmp_path: Path, lens: Lens, data: bytes, name: str, monkeypatch: pytest.MonkeyPatch, *more: str) -> int:
    """Align by a picture file; return the exit code."""
    write_lens(lens, lens_path(Workspace(tmp_path).bench_state("sim")))
    write_board(config_of(BED), tmp_path / "configs" / "boards" / "bed.yaml")
    (tmp_path / name).write_bytes(data)
    words = ["camera", "align", "--image", str(tmp_path / name), "--json", *more]
    monkeypatch.setattr(sys, "argv", ["fabctl", "--home", str(tmp_path), *words])
    return run_guarded(cli)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda p: encoded(p.astype(np.uint16) * 257), "a.png"),
        (lambda p: encoded(p.astype(np.uint16) * 257, ".tiff"), "a.tiff"),
        (lambda p: encoded(p.astype(np.uint16) * 16), "a.png"),
        (lambda p: encoded(cv2.cvtColor(p, cv2.COLOR_GRAY2BGR)), "a.png"),
        (with_alpha, "a.png"),
        (lambda p: encoded(p, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 25), "a.jpg"),
        (lambda p: encoded(p) + b"some bytes of the telephone's own", "a.png"),
        *((lambda p, k=k: turned_by_note(p, k), "a.jpg") for k in range(1, 9)),
    ],
    ids=[
        "16 bit",
        "16 bit TIFF",
        "12 in 16 bit",
        "colour",
        "alpha",
        "JPEG 25",
        "trailer",
        *map("EXIF {}".format, "12345678"),
    ],
)
def test_every_kind_of_picture_of_the_bed_aligns_it(
    make: Callable[[Picture], bytes],
    name: str,
    tmp_path: Path,
    lens: Lens,
    bed_picture: Picture,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert run(tmp_path, lens, make(bed_picture), name, monkeypatch) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["marks_count"] == len(BED.marks) - 2  # which the sheet covers
    assert made["rms_mm"] < 0.05


def two_beds(_: Picture) -> bytes:
    scene = bed_scene()
    again = tuple(replace(m, x_mm=m.x_mm + 46.0) for m in scene.bed.marks if m.id in (4, 5))
    return encoded(Studio(replace(scene, bed=replace(scene.bed, marks=(*scene.bed.marks, *again)))).frame())


def cropped(picture: Picture) -> bytes:
    """Marks cut by the border: the corner ones only half in the picture."""
    seen = np.full_like(picture, 90)
    seen[180:560, 80:] = picture[180:560, 80:]
    return encoded(seen)


@pytest.mark.parametrize(
    ("make", "ended", "said"),
    [
        (lambda _: b"", USAGE, "is empty"),
        (lambda _: b"words", USAGE, "not a picture"),
        (lambda _: b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00heic" + bytes(4000), USAGE, "export others (HEIC"),
        (lambda p: encoded(p, ".jpg")[:30000], USAGE, "ends in the middle"),
        (lambda p: encoded(p)[:60000], USAGE, "ends in the middle"),
        (lambda p: encoded(p.astype(np.float32) / 255, ".tiff"), USAGE, "float32 values"),
        (lambda p: encoded(np.ascontiguousarray(p[:, ::-1])), REFUSED, "MARKS-MIRRORED"),
        (lambda p: encoded(cv2.resize(p, None, fx=2, fy=2)), REFUSED, "PICTURE-SIZE"),
        (lambda p: encoded(np.ascontiguousarray(np.rot90(p))), REFUSED, "PICTURE-SIZE"),
        (two_beds, REFUSED, "MARKS-TWICE"),
        (cropped, REFUSED, "MARKS-"),
    ],
    ids=[
        "nothing",
        "words",
        "HEIC",
        "torn JPEG",
        "torn PNG",
        "float",
        "mirror",
        "larger",
        "portrait",
        "two beds",
        "cropped",
    ],
)
def test_what_cannot_be_aligned_by_is_refused_by_name(
    make: Callable[[Picture], bytes],
    ended: int,
    said: str,
    tmp_path: Path,
    lens: Lens,
    bed_picture: Picture,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = make(bed_picture)
    name = "a.tiff" if data[:2] in (b"II", b"MM") else "a.jpg" if data[:2] == b"\xff\xd8" else "a.png"
    assert run(tmp_path, lens, data, name, monkeypatch) == ended
    assert said in capsys.readouterr().err
    assert not alignment_path(Workspace(tmp_path).bench_state("sim")).exists()


def test_a_picture_upside_down_aligns_to_the_same_places(
    tmp_path: Path,
    lens: Lens,
    bed_picture: Picture,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The camera mounted the other way round; the lens measured so as well."""
    w, h = lens.size_px
    K = lens.K.copy()
    K[:2, 2] = w - 1 - K[0, 2], h - 1 - K[1, 2]
    turned = replace(lens, K=K, distortion=lens.distortion * np.array([1, 1, -1, -1, 1.0]))
    data = encoded(np.ascontiguousarray(bed_picture[::-1, ::-1]))
    assert run(tmp_path, turned, data, "a.png", monkeypatch) == 0
    assert json.loads(capsys.readouterr().out)["rms_mm"] < 0.05


def test_a_bed_board_is_no_board_for_the_lens_and_the_sheets_marks_are_no_bed(bed_picture: Picture) -> None:
    view, found = find_board(bed_picture, BOARD, "bed")
    assert view is None
    assert found
    view, found = find_board(np.ascontiguousarray(bed_picture[:, ::-1]), BOARD, "bed")
    assert view is None


def test_a_picture_of_fifty_megapixels_is_searched(tmp_path: Path) -> None:
    from drivers.camera import read_picture
    from fabctl.vision.markers import find_markers

    page = np.full((6000, 8400), 190, np.uint8)
    page[2880:3540, 4880:5540] = 255  # the paper that the marker is printed on
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250), 7, 420)
    page[3000:3420, 5000:5420] = np.maximum(drawn, 40)
    cv2.imwrite(str(tmp_path / "large.jpg"), cv2.GaussianBlur(page, (0, 0), 2.0))  # no lens is sharper at that size
    (marker,) = find_markers(read_picture(tmp_path / "large.jpg").image)
    assert marker.id == 7
    assert marker.centre_px == pytest.approx([5209.5, 3209.5], abs=0.01 * 60)  # a hundredth of a module
