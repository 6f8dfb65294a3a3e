"""Every kind of camera URL gives grey frames, and a missing one says what is missing."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.camera import open_camera, snapshot
from drivers.errors import TransportError
from simulators.camera.scene import Bed, Camera, Scene
from simulators.camera.serve import Source, server

SMALL = Scene(camera=Camera(size_px=(160, 120), mm_per_px=2.0, focal_px=200.0), bed=Bed(marks=()))


@pytest.fixture
def stream() -> Iterator[str]:
    made = server(Source(None, None, SMALL, count=12), 0)
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{made.server_address[1]}"
    made.shutdown()
    made.server_close()


def test_a_folder_gives_its_pictures_in_order_and_its_newest_as_snapshot(tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((80, 100, 3), 50 * k, np.uint8))
    with open_camera(str(tmp_path)) as camera:
        assert [int(camera.read().image.mean()) for _ in range(3)] == [0, 50, 100]
        with pytest.raises(TransportError, match="no more pictures"):
            camera.read()
    assert snapshot(str(tmp_path)).image.shape == (80, 100)
    assert int(snapshot(str(tmp_path)).image.mean()) == 100


def test_a_stream_gives_frames_until_it_is_unplugged(stream: str) -> None:
    with open_camera(f"{stream}/bed.mjpg") as camera:
        assert camera.read().image.shape == (120, 160)
        with pytest.raises(TransportError, match="unplugged"):
            for _ in range(20):
                camera.read()


def test_a_still_address_gives_the_exact_picture(stream: str) -> None:
    assert snapshot(f"{stream}/bed.png").image.shape == (120, 160)
    with pytest.raises(TransportError, match="no picture"):
        snapshot(f"{stream}/other.png")


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("/dev/video77", "no such device"),
        ("77", "does not open"),
        ("http://127.0.0.1:9/bed.mjpg", "does not open"),
        ("nowhere", "no such camera, picture or folder"),
    ],
)
def test_a_camera_that_is_not_there_is_named(url: str, reason: str) -> None:
    with pytest.raises(TransportError, match=reason):
        snapshot(url)


def test_a_file_that_is_no_picture_and_an_empty_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("not a picture")
    with pytest.raises(TransportError, match="not a picture"):
        snapshot(str(tmp_path))
    (tmp_path / "a.png").unlink()
    with pytest.raises(TransportError, match="holds no picture"):
        snapshot(str(tmp_path))
