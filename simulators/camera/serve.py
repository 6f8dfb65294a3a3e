"""The camera on a loopback port: `/bed.mjpg` a stream, `/bed.png` one exact frame, `/reload` after moving things."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.camera.burn import F64, read_trace
from simulators.camera.picture import NOTHING_BURNED, Studio
from simulators.camera.scene import Scene, read_scene

BOUNDARY = "frame"
JPEG_QUALITY = 97
FRAME_S = 0.1

Frame = NDArray[np.uint8]


class Source:
    """Gives the next frame; renders anew when the scene or the burn trace has changed on disk."""

    def __init__(
        self,
        scene: Path | None,
        trace: Path | None,
        default: Scene,
        count: int | None = None,
        zero_mm: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self._scene, self._trace, self._default, self._left = scene, trace, default, count
        self._zero = np.array([0.0, *zero_mm, 0.0])
        self._stamp: tuple[object, ...] = ()
        self._studio: Studio | None = None
        self._rows: F64 = NOTHING_BURNED
        self._number = 0
        self._lock = threading.Lock()

    def next(self) -> Frame | None:
        """Return the next frame; None once the camera is unplugged (`count` frames were given)."""
        with self._lock:
            if self._left is not None and self._number >= self._left:
                return None
            studio = self.studio()
            frame = studio.frame(self._number, self._rows)
            self._number += 1
            return frame

    def studio(self) -> Studio:
        """Return the renderer of the scene as it is on disk now."""
        stamp = (_stamp(self._scene), _stamp(self._trace))
        if self._studio is None or stamp != self._stamp:
            if self._studio is None or stamp[0] != self._stamp[0]:
                present = self._scene is not None and self._scene.is_file()
                self._studio = Studio(read_scene(self._scene) if present and self._scene else self._default)
            present = self._trace is not None and self._trace.is_file()
            self._rows = read_trace(self._trace) + self._zero if present and self._trace else NOTHING_BURNED
            self._stamp = stamp
        return self._studio


def _stamp(path: Path | None) -> tuple[int, int] | None:
    if path is None or not path.is_file():
        return None
    state = path.stat()
    return state.st_mtime_ns, state.st_size


def server(source: Source, port: int) -> ThreadingHTTPServer:
    """Return a server on the loopback, not yet serving."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/bed.png":
                _send_one(self, source.next())
            elif self.path == "/bed.mjpg":
                _send_stream(self, source.next)
            else:
                self.send_error(404, "only /bed.mjpg and /bed.png")

        def log_message(self, format: str, *args: object) -> None:
            """Stay quiet: standard error is for what went wrong."""

    made = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    made.daemon_threads = True
    return made


def _send_one(handler: BaseHTTPRequestHandler, frame: Frame | None) -> None:
    if frame is None:
        handler.send_error(503, "the camera is unplugged")
        return
    body = cv2.imencode(".png", frame)[1].tobytes()
    handler.send_response(200)
    handler.send_header("Content-Type", "image/png")
    handler.send_header("Content-Length", str(len(body)))
    handler.end_headers()
    handler.wfile.write(body)


def _send_stream(handler: BaseHTTPRequestHandler, next_frame: Callable[[], Frame | None]) -> None:
    handler.send_response(200)
    handler.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
    handler.end_headers()
    try:
        while (frame := next_frame()) is not None:
            body = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(body)}\r\n\r\n"
            handler.wfile.write(head.encode() + body + b"\r\n")
            time.sleep(FRAME_S)
    except (BrokenPipeError, ConnectionResetError):
        return  # the viewer has gone
