"""The photogrammetry's own pictures: a sheet of coded marks on the table, the specimen on it, and a COLMAP text model.

The model's poses are in the cloud's frame and unit, off by what a bundle adjustment leaves. Pixel centres are at halves
there, as COLMAP has them.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.camera.optics import View, bed_texture, compose, develop, flat_layer, view_of
from simulators.camera.scene import Bed, Camera, Mark, Scene
from simulators.photogrammetry import Floats, Scan

SIDE_MM = 15.0
FIRST_ID = 100
TEXEL_MM = 0.1
SHOTS_COUNT = 12
WOBBLE_RAD = 5e-5  # a tenth of a pixel
LENS = Camera(
    size_px=(1600, 1200),
    focal_px=1800.0,
    mm_per_px=0.25,
    blur_px=1.0,
    tilt_rad=0.6,
    distortion_ratio=(-0.1, 0.03, 0.0005, -0.0004, 0.0),
)


def marks_mm(size_mm: tuple[float, float]) -> tuple[Mark, ...]:
    """Return six marks along the border of the sheet."""
    (w, h), m = size_mm, SIDE_MM
    places = [(m, m), (w / 2, m), (w - m, m), (w - m, h - m), (w / 2, h - m), (m, h - m)]
    return tuple(Mark(FIRST_ID + k, x, y, SIDE_MM) for k, (x, y) in enumerate(places))


def write_shots(
    folder: Path, cloud: Scan, vertices_mm: Floats, faces: NDArray[np.int64], size_mm: tuple[float, float], seed: int
) -> None:
    """Write `images/` and the model's `cameras.txt` and `images.txt`; the specimen stands in the sheet's middle."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
    corner = np.array([*((low + high)[:2] - np.array(size_mm)) / 2, low[2]])  # the sheet's origin in the mesh's frame
    scene = Scene(camera=LENS, bed=Bed(size_mm, marks=marks_mm(size_mm)), seed=seed)
    texture = bed_texture(scene, TEXEL_MM)
    lines = []
    for k in range(SHOTS_COUNT):
        rng = np.random.default_rng([seed, 7, k])
        view = _around(k, size_mm, rng)
        light = compose(view, LENS.size_px, [flat_layer(view, texture, TEXEL_MM, 0.0)])
        _stand_before(light, view, vertices_mm - corner, faces)
        name = f"shot-{k:02d}.png"
        cv2.imwrite(str(folder / "images" / name), develop(light, LENS, rng))
        lines.append(_line(k + 1, name, view, cloud, corner, rng))
    w, h = LENS.size_px
    K, d = view_of(LENS).K, LENS.distortion_ratio
    lens = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *d[:4]]
    numbers = " ".join(repr(float(value)) for value in lens)
    (folder / "cameras.txt").write_text(f"# camera id, model, width, height, parameters\n1 OPENCV {w} {h} {numbers}\n")
    (folder / "images.txt").write_text("# id, qw qx qy qz, tx ty tz, camera id, name\n" + "".join(lines))


def _around(k: int, size_mm: tuple[float, float], rng: np.random.Generator) -> View:
    from dataclasses import replace

    reach = 1.3 * max(size_mm[0] / LENS.size_px[0], size_mm[1] / LENS.size_px[1])
    middle = (size_mm[0] / 2, size_mm[1] / 2)
    turn, to = float(rng.uniform(-1, 1)), 2 * math.pi * k / SHOTS_COUNT
    return view_of(replace(LENS, mm_per_px=reach, looks_at_mm=middle, tilt_to_rad=to, turn_rad=turn))


def _stand_before(light: NDArray[np.float32], view: View, points_mm: Floats, faces: NDArray[np.int64]) -> None:
    """Draw the specimen, dark rubber lit from above, over the table."""
    pixels = np.rint(view.project(points_mm) * 16).astype(np.int32)
    corners = points_mm[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lit = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    depth = (corners.mean(axis=1) @ view.R.T + view.t_mm)[:, 2]
    for face in np.argsort(-depth):
        cv2.fillConvexPoly(light, pixels[faces[face]], 0.05 + 0.1 * float(lit[face]), cv2.LINE_8, 4)


def _line(number: int, name: str, view: View, cloud: Scan, corner_mm: Floats, rng: np.random.Generator) -> str:
    """Return the picture's two lines: its pose in the cloud's frame, and no feature points."""
    from scipy.spatial.transform import Rotation

    wobble = np.asarray(cv2.Rodrigues(rng.normal(0, WOBBLE_RAD, 3))[0])
    R = wobble @ view.R @ cloud.rotation.T
    t = wobble @ (cloud.scale_ratio * (view.t_mm - view.R @ corner_mm)) - R @ cloud.translation
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    numbers = " ".join(repr(float(value)) for value in (w, x, y, z, *t))
    return f"{number} {numbers} 1 {name}\n\n"
