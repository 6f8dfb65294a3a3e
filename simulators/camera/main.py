"""`python -m simulators camera`: a picture, a folder of pictures, or a stream on the loopback."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path

import cv2

from simulators.camera.scene import Pose, Scene, Sheet
from simulators.camera.serve import Source, server


def default_scene(seed: int) -> Scene:
    """Return the bed with its marks and a bare sheet of rubber in its middle."""
    return replace(Scene(), seed=seed, sheet=Sheet((240.0, 150.0), poses=(Pose(0.0, 30.0, 25.0),), thickness_mm=2.3))


def main(words: list[str]) -> int:
    """Run the camera until SIGTERM, or until its pictures are written."""
    parser = argparse.ArgumentParser(prog="python -m simulators camera", description=__doc__)
    parser.add_argument("--scene", type=Path, help="JSON file of what stands before the lens; read again when changed")
    parser.add_argument("--trace", type=Path, help="the laser simulator's burn trace: t_s,x_mm,y_mm,power_frac")
    parser.add_argument(
        "--zero-mm",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("X", "Y"),
        help="where on the bed the trace is zero",
    )
    parser.add_argument("--truth", type=Path, help="folder for the answer key")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--http", type=int, metavar="PORT", help="serve /bed.mjpg and /bed.png; 0 takes a free port")
    parser.add_argument("--picture", type=Path, help="write one PNG and end")
    parser.add_argument("--folder", type=Path, help="write --count PNGs into this folder and end")
    parser.add_argument("--count", type=int, default=None, help="how many frames; a stream is unplugged after them")
    given = parser.parse_args(words)
    try:
        source = Source(given.scene, given.trace, default_scene(given.seed), given.count, tuple(given.zero_mm))
        truth = source.studio().truth()
    except (OSError, ValueError) as fault:
        print(f"camera: {fault}", file=sys.stderr)
        return 2
    if given.truth:
        given.truth.mkdir(parents=True, exist_ok=True)
        (given.truth / "camera.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    if given.picture:
        return 0 if cv2.imwrite(str(given.picture), source.next()) else 1
    if given.folder:
        return _write_folder(source, given.folder, given.count or 1)
    return _serve(source, given.http or 0)


def _write_folder(source: Source, folder: Path, count: int) -> int:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        cv2.imwrite(str(folder / f"frame-{number:04d}.png"), source.next())
    return 0


def _serve(source: Source, port: int) -> int:
    made = server(source, port)
    stop = threading.Event()
    for name in (signal.SIGTERM, signal.SIGINT):
        signal.signal(name, lambda *_: stop.set())
    threading.Thread(target=made.serve_forever, daemon=True).start()
    print(f"ready http://127.0.0.1:{made.server_address[1]}/bed.mjpg", flush=True)
    stop.wait()
    made.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
