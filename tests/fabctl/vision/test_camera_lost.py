"""The camera goes in the middle of a job, or shows what was: said, and nothing is cut by it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import Frame
from fabctl.config.boards import config_of, with_offset, write_board
from fabctl.cut.by_camera import BedEye
from fabctl.errors import DEVICE, REFUSED, RefusedError
from fabctl.testing import SimulatedBench, _bench
from fabctl.vision.align import align, write_alignment
from fabctl.vision.bed import alignment_path
from fabctl.vision.lens import Lens
from simulators.camera.picture import Studio
from simulators.camera.scene import Scene
from tests.fabctl.vision.conftest import BED, REGISTRATION, SHEET, bed_scene
from tests.fabctl.vision.test_live_loop import cut_words, write_design

Picture = NDArray[np.uint8]


class WebCamera(ThreadingHTTPServer):
    """A camera that gives `left` more pictures, then is unplugged; frozen, it gives its first one for ever."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.studio, self.left, self.frozen, self.given = Studio(scene), 0, False, 0

    def body(self) -> bytes | None:
        if self.left <= 0:
            return None
        self.left -= 1
        self.given += 1
        return cv2.imencode(".png", self.studio.frame(0 if self.frozen else self.given))[1].tobytes()


class Answer(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = self.server.body()  # type: ignore[attr-defined]
        if body is None:
            self.close_connection = True
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Stay quiet."""


@pytest.fixture
def camera() -> Iterator[WebCamera]:
    made = WebCamera(bed_scene(SHEET))
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield made
    made.shutdown()
    made.server_close()


@pytest.fixture
def bench(tmp_path: Path, lens: Lens, bed_picture: Picture, camera: WebCamera) -> Iterator[SimulatedBench]:
    for made in _bench(tmp_path, ("laser",)):
        state = made.lab.bench_state("sim")
        now = datetime.now(UTC).isoformat()
        write_alignment(align(bed_picture, "bed", with_offset(BED, -300, -200), lens, now), alignment_path(state))
        write_board(config_of(REGISTRATION), tmp_path / "configs" / "boards" / "registration.yaml")
        file = tmp_path / "configs" / "benches" / "sim.yaml"
        file.parent.mkdir(parents=True)
        url = f"http://127.0.0.1:{camera.server_address[1]}/bed.png"
        packaged = Path(__file__).resolve().parents[3] / "configs" / "benches" / "sim.yaml"
        file.write_text(packaged.read_text().replace("ready:camera", url))
        yield made


@pytest.mark.slow
def test_unplugged_or_frozen_before_the_yes_cuts_nothing_and_unplugged_afterwards_harms_no_cut(
    bench: SimulatedBench, camera: WebCamera
) -> None:
    root = bench.lab.root
    design = write_design(root / "design")
    trace = bench.lab.bench_state("sim") / "laser-trace.csv"
    before = trace.read_bytes()

    camera.left = 0
    bench.fabctl(*cut_words(design), expect=DEVICE)
    camera.left = 1  # the look that plans the job, and none after the yes
    bench.fabctl(*cut_words(design), expect=DEVICE)
    camera.left, camera.frozen = 9, True
    bench.fabctl(*cut_words(design), expect=REFUSED)
    assert trace.read_bytes() == before
    assert not list((root / "runs").glob("*-cut-*"))
    assert not list((root / "specimens").glob("S-*"))

    camera.left, camera.frozen = 2, False
    done = bench.fabctl(*cut_words(design))
    assert camera.left == 0
    assert trace.read_bytes() != before
    bench.fabctl("cut", "inspect", done["specimen"], expect=DEVICE)


def test_the_same_picture_twice_is_no_second_look(
    tmp_path: Path, lens: Lens, bed_picture: Picture, bed: Studio
) -> None:
    now = datetime.now(UTC).isoformat()
    write_alignment(align(bed_picture, "bed", BED, lens, now), alignment_path(tmp_path))
    pictures = [bed_picture, bed_picture, bed.frame(7)]

    def take() -> Frame:
        return Frame(pictures.pop(0), "camera", datetime.now(UTC).isoformat())

    eye = BedEye(tmp_path, REGISTRATION, 2.3, take)
    assert eye.found.registration.marks_count == len(REGISTRATION.marks)
    with pytest.raises(RefusedError, match="PICTURE-SAME"):
        eye.look_again()
    eye.look_again()
