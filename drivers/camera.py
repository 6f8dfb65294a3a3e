"""Frames from a camera, a stream, a picture or a folder of pictures, all by OpenCV's VideoCapture or imread.

A URL is a device number (`0`), a device path (`/dev/video0`), `http://…` or `rtsp://…`, a picture, a film, or a folder
of pictures. Every frame is grey, 8 bits.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceTimeout, TransportError

PICTURES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"))
STREAMS = ("http://", "https://", "rtsp://", "tcp://", "udp://")
READABLE = "PNG, JPEG, TIFF, BMP or WebP; export others (HEIC, raw) as one of these"
TAIL_BYTES = 65536  # in which a picture's end mark must stand; telephones write more after it
TIMEOUT_s = 15.0
# Without this FFmpeg collects five seconds of a stream before it shows the first frame.
FFMPEG_OPTIONS = "probesize;32768|analyzeduration;0|fflags;nobuffer"
STALE_FRAMES_COUNT = 2  # a device keeps frames from before it was asked


@dataclass(frozen=True, slots=True)
class Frame:
    """One grey picture (h, w) and where it came from."""

    image: NDArray[np.uint8]
    source: str
    taken_utc: str


@dataclass
class Camera:
    """An open camera. `read` returns the next frame; a folder or file ends with `StopIteration`-like `None`."""

    url: str
    _capture: Any = None
    _files: list[Path] = field(default_factory=list)
    _next: int = 0
    _still: bool = False

    def read(self) -> Frame:
        """Return the next frame; raise `TransportError` where the camera is gone or has no more."""
        if self._still:
            return fetch_picture(self.url)
        if self._capture is None:
            return self._from_file()
        began = time.monotonic()
        with _quiet():
            good, image = self._capture.read()
        waited_s = time.monotonic() - began
        if good and image is not None:
            return _frame(image, self.url)
        if waited_s >= TIMEOUT_s * 0.9:
            raise DeviceTimeout(self.url, "a frame", waited_s, "is the camera still plugged in?")
        raise TransportError(self.url, "the camera gives no picture", "unplugged, or used by another program")

    def remaining(self) -> int | None:
        """Return how many frames are left, None for a live camera."""
        return None if self._capture is not None or self._still else len(self._files) - self._next

    def close(self) -> None:
        """Give the camera back."""
        if self._capture is not None:
            self._capture.release()

    def _from_file(self) -> Frame:
        if self._next >= len(self._files):
            raise TransportError(self.url, f"no more pictures after {len(self._files)}")
        path = self._files[self._next]
        self._next += 1
        return read_picture(path)

    def __enter__(self) -> Camera:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_camera(url: str) -> Camera:
    """Open the camera at `url`; raise `TransportError` saying what is missing."""
    path = Path(url.removeprefix("file://"))
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURES)
        if not files:
            raise TransportError(url, "the folder holds no picture", f"one of {', '.join(sorted(PICTURES))}")
        return Camera(url, _files=files)
    if path.is_file() and path.suffix.lower() in PICTURES:
        return Camera(url, _files=[path])
    if not (url.isdigit() or url.startswith((*STREAMS, "/dev/")) or path.is_file()):
        raise TransportError(url, "no such camera, picture or folder", "a device number, /dev/video…, a URL or a path")
    if url.startswith("/dev/") and not path.exists():
        raise TransportError(url, "there is no such device", "is the camera plugged in? `ls /dev/video*`")
    if url.startswith(("http://", "https://")) and Path(urllib.parse.urlsplit(url).path).suffix.lower() in PICTURES:
        return Camera(url, _still=True)
    return Camera(url, _capture=_capture(url))


def snapshot(url: str) -> Frame:
    """Return one fresh frame: of a folder the newest picture, of a device none that it kept from before."""
    path = Path(url.removeprefix("file://"))
    if path.is_dir():
        files = [p for p in path.iterdir() if p.suffix.lower() in PICTURES]
        if not files:
            raise TransportError(url, "the folder holds no picture", f"one of {', '.join(sorted(PICTURES))}")
        return read_picture(max(files, key=lambda p: (p.stat().st_mtime_ns, p.name)))
    with open_camera(url) as camera:
        if camera.remaining() is None and not url.startswith(STREAMS):
            for _ in range(STALE_FRAMES_COUNT):
                camera.read()
        return camera.read()


def read_picture(path: Path) -> Frame:
    """Return the picture in a file; the time is the file's."""
    try:
        raw = np.fromfile(path, dtype=np.uint8)
        taken_s = path.stat().st_mtime
    except OSError as fault:
        raise TransportError(str(path), fault.strerror or str(fault)) from fault
    return Frame(_decode(raw, str(path)), str(path), datetime.fromtimestamp(taken_s, UTC).isoformat())


def fetch_picture(url: str) -> Frame:
    """Return the picture that a web camera gives at `url`; it has TIMEOUT_s for all of it."""
    began_s = time.monotonic()
    parts = []
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_s) as answer:
            while part := answer.read1(1 << 16):
                parts.append(part)
                if time.monotonic() - began_s > TIMEOUT_s:
                    raise TimeoutError
            if getattr(answer, "length", None):
                raise TransportError(url, "the picture ends in the middle", "was the camera unplugged?")
    except TimeoutError as fault:
        raise DeviceTimeout(url, "a picture", TIMEOUT_s, "is the camera still plugged in?") from fault
    except (OSError, http.client.HTTPException) as fault:
        reason = getattr(fault, "reason", None) or str(fault) or type(fault).__name__
        raise TransportError(url, f"no picture: {reason}", "is the camera on?") from fault
    return Frame(_decode(np.frombuffer(b"".join(parts), np.uint8), url), url, datetime.now(UTC).isoformat())


def _decode(raw: NDArray[np.uint8], source: str) -> NDArray[np.uint8]:
    """Return a picture file's grey values, as the sensor saw them: a note on how to turn it is not followed.

    The lens was measured on the sensor, so a picture turned by its EXIF note would be another camera's.
    """
    import cv2

    if not _is_whole(raw):
        raise TransportError(source, "the picture ends in the middle", "still being written, or badly copied?")
    how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with _quiet():
            image = cv2.imdecode(raw, how) if raw.size else None
    except cv2.error as fault:
        raise TransportError(source, f"not a picture that can be read: {fault.err}", READABLE) from fault
    if image is None:
        raise TransportError(source, "not a picture that can be read", READABLE)
    return _eight_bits(image, source)


def _is_whole(raw: NDArray[np.uint8]) -> bool:
    """Say whether a JPEG or PNG has its end; OpenCV fills what is missing with grey and says nothing."""
    head, tail = raw[:8].tobytes(), raw[-TAIL_BYTES:].tobytes()
    if head.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in tail
    return b"IEND" in tail if head.startswith(b"\x89PNG") else True


def _eight_bits(image: NDArray[Any], source: str) -> NDArray[np.uint8]:
    """Return 8 bits of a picture of up to 16; 10 and 12 bits in 16 (machine cameras) are known by their range."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    if image.dtype != np.uint16:
        raise TransportError(source, f"a picture of {image.dtype} values", "8 or 16 bits a pixel")
    bits = next(bits for bits in (10, 12, 16) if int(image.max()) < 1 << bits)
    return np.asarray(image >> (bits - 8), dtype=np.uint8)


def _capture(url: str) -> Any:
    import cv2

    limit_ms = int(TIMEOUT_s * 1000)
    with _quiet():
        if url.isdigit() or url.startswith("/dev/"):
            capture = cv2.VideoCapture(int(url) if url.isdigit() else url, cv2.CAP_V4L2)
        else:
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 2 * limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
            capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, limits)
    if not capture.isOpened():
        capture.release()
        raise TransportError(url, "the camera does not open", _why_closed(url))
    return capture


def _why_closed(url: str) -> str:
    """Return what to look at where a camera does not open."""
    if url.startswith(STREAMS):
        return f"is it on, and this its address? it has {2 * TIMEOUT_s:g} s to answer"
    if url.isdigit() or url.startswith("/dev/"):
        return "plugged in, allowed (group video), not in use?"
    return f"neither a film nor a picture: {READABLE}"


def _frame(image: NDArray[Any], source: str) -> Frame:
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return Frame(np.asarray(grey, dtype=np.uint8), source, datetime.now(UTC).isoformat())


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the native libraries' chatter off standard error; our own message says what is wrong."""
    import cv2

    logging = cv2.utils.logging
    level = logging.getLogLevel()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", FFMPEG_OPTIONS)
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)
