"""A small bed camera, seen through its simulator: pictures are made once for all tests of this folder."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fabctl.vision import boards
from fabctl.vision.align import Alignment, align
from fabctl.vision.lens import Lens, calibrate, find_board
from simulators.camera.picture import Studio
from simulators.camera.scene import Camera, Charuco, Mark, Pose, Scene, Sheet

WHEN = "2026-11-22T00:00:00+00:00"
CAMERA = Camera(size_px=(1050, 725), mm_per_px=0.3, focal_px=1100.0, centre_offset_px=(5.0, -3.0))
BOARD = boards.Charuco("lens", 10, 7, 20.0, 15.0)
BED = boards.bed_marks((300.0, 200.0))
REGISTRATION = boards.registration_marks((150.0, 100.0))
SHEET = Sheet(
    (150.0, 100.0),
    poses=(Pose(0.0, 90.0, 40.0, 0.15, 1.003),),
    marks=tuple(Mark(m.id, m.x_mm, m.y_mm, m.side_mm) for m in REGISTRATION.marks),
    thickness_mm=2.3,
)


def bed_scene(sheet: Sheet | None = None, **camera: object) -> Scene:
    return Scene(camera=replace(CAMERA, **camera), sheet=sheet)  # type: ignore[arg-type]


class WebCamera(ThreadingHTTPServer):
    """A camera on the loopback that gives `pictures` one after the other, and then is unplugged."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Answer)
        self.pictures: list[NDArray[np.uint8]] = []

    def use_on(self, root: Path) -> None:
        """Make it the camera of the bench `sim` of the lab in `root`."""
        packaged = Path(__file__).resolve().parents[3] / "configs" / "benches" / "sim.yaml"
        url = f"http://127.0.0.1:{self.server_address[1]}/bed.png"
        file = root / "configs" / "benches" / "sim.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(packaged.read_text().replace("ready:camera", url))


class _Answer(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        pictures = cast(WebCamera, self.server).pictures
        if not pictures:
            self.close_connection = True
            return
        body = cv2.imencode(".png", pictures.pop(0))[1].tobytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Stay quiet."""


@pytest.fixture
def web_camera() -> Iterator[WebCamera]:
    made = WebCamera()
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield made
    made.shutdown()
    made.server_close()


@pytest.fixture(scope="session")
def board_pictures() -> list[NDArray[np.uint8]]:
    studio = Studio(Scene(camera=CAMERA, charuco=Charuco(10, 7, 20.0, 15.0)))
    return [studio.frame(k) for k in range(10)]


@pytest.fixture(scope="session")
def lens(board_pictures: list[NDArray[np.uint8]]) -> Lens:
    views = [find_board(picture, BOARD, f"view {k}")[0] for k, picture in enumerate(board_pictures)]
    return calibrate([view for view in views if view is not None], CAMERA.size_px, BOARD, WHEN).lens


@pytest.fixture(scope="session")
def bed() -> Studio:
    return Studio(bed_scene(SHEET))


@pytest.fixture(scope="session")
def bed_picture(bed: Studio) -> NDArray[np.uint8]:
    return bed.frame()


@pytest.fixture(scope="session")
def alignment(bed_picture: NDArray[np.uint8], lens: Lens) -> Alignment:
    return align(bed_picture, "bed", BED, lens, WHEN)
