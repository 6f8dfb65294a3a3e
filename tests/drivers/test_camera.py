"""Every kind of camera URL gives grey frames, and a missing one says what is missing."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.camera import open_camera, snapshot
from drivers.errors import DeviceError, TransportError
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


class Faulty(BaseHTTPRequestHandler):
    """A camera with a bad cable: each path fails in its own way."""

    def do_GET(self) -> None:
        self.send_response(200)
        film = self.path.endswith("mjpg")
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame" if film else "image/png")
        if not film:
            self.send_header("Content-Length", "1000000")
        self.end_headers()
        grain = np.random.default_rng(1).integers(0, 256, (240, 320)).astype(np.uint8)  # some kB, or nothing is shown
        body = cv2.imencode(".jpg" if film else ".png", grain)[1].tobytes()
        with contextlib.suppress(OSError):
            if self.path == "/stalls.mjpg":
                for _ in range(5):
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(body)}\r\n\r\n"
                    self.wfile.write(head.encode() + body + b"\r\n")
            if self.path == "/torn.png":
                self.wfile.write(body)
                return
            while not self.server.over.wait(0.2):  # type: ignore[attr-defined]
                if self.path == "/drips.png":
                    self.wfile.write(b"x")

    def log_message(self, format: str, *args: object) -> None:
        """Stay quiet."""


@pytest.fixture
def faulty(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr("drivers.camera.TIMEOUT_s", 1.0)
    made = ThreadingHTTPServer(("127.0.0.1", 0), Faulty)
    made.daemon_threads = True
    made.over = threading.Event()  # type: ignore[attr-defined]
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{made.server_address[1]}"
    made.over.set()  # type: ignore[attr-defined]
    made.shutdown()
    made.server_close()


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("silent.mjpg", "does not open"),
        ("silent.png", "a picture"),
        ("drips.png", "a picture"),
        ("torn.png", "ends in the middle"),
    ],
)
def test_a_camera_that_stalls_is_said_within_its_time(faulty: str, path: str, said: str) -> None:
    began_s = time.monotonic()
    with pytest.raises(DeviceError, match=said):
        snapshot(f"{faulty}/{path}")
    assert time.monotonic() - began_s < 60  # of a busy machine; the camera itself never ends


def test_a_stream_that_stalls_after_some_frames_is_said_and_hangs_nothing(faulty: str) -> None:
    began_s = time.monotonic()
    with open_camera(f"{faulty}/stalls.mjpg") as camera:
        assert camera.read().image.shape == (240, 320)
        with pytest.raises(DeviceError):
            for _ in range(9):
                camera.read()
    assert time.monotonic() - began_s < 60


def test_a_stream_that_has_restarted_gives_pictures_again() -> None:
    first = server(Source(None, None, SMALL), 0)
    port = first.server_address[1]
    url = f"http://127.0.0.1:{port}/bed.mjpg"
    threading.Thread(target=first.serve_forever, daemon=True).start()
    assert snapshot(url).image.shape == (120, 160)
    first.shutdown()
    first.server_close()
    with pytest.raises(TransportError, match="does not open"):
        snapshot(url)
    again = server(Source(None, None, SMALL), port)
    threading.Thread(target=again.serve_forever, daemon=True).start()
    assert snapshot(url).image.shape == (120, 160)
    again.shutdown()
    again.server_close()


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("/dev/video77", "no such device"),
        ("77", "does not open"),
        ("http://127.0.0.1:9/bed.mjpg", "does not open"),
        ("nowhere", "no such camera, picture or folder"),
        ("pyproject.toml", "neither a film nor a picture"),
        ("rtsp://127.0.0.1:9/x", "is it on"),
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
