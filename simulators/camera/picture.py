"""One frame of a scene, with the truth about it."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulators.camera.burn import F32, F64
from simulators.camera.optics import (
    Layer,
    View,
    bed_texture,
    board_layer,
    charuco_texture,
    compose,
    develop,
    flat_layer,
    sheet_texture,
    view_of,
)
from simulators.camera.scene import Scene

NOTHING_BURNED = np.empty((0, 4))


class Studio:
    """Renders a scene's frames; keeps what does not change from frame to frame."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.view: View = view_of(scene.camera)
        self.texel_mm = scene.texel_mm or scene.camera.mm_per_px / 3
        self._bed: F32 | None = None
        self._sheet: tuple[bytes, F32] | None = None
        self._light: tuple[bytes, F32] | None = None

    def frame(self, number: int = 0, trace: F64 = NOTHING_BURNED) -> NDArray[np.uint8]:
        """Return frame `number` (h, w), grey; the noise of each frame is its own, drawn from the scene's seed."""
        key = trace.tobytes()
        if self.scene.charuco is not None or self._light is None or self._light[0] != key:
            self._light = (key, compose(self.view, self.scene.camera.size_px, self._layers(number, trace)))
        rng = np.random.default_rng([self.scene.seed, 100 + number])
        return develop(self._light[1], self.scene.camera, rng)

    def truth(self) -> dict[str, Any]:
        """Return what a measurement of this scene ought to find."""
        view = self.view
        return {
            "K": view.K.tolist(),
            "distortion": view.distortion.tolist(),
            "R": view.R.tolist(),
            "t_mm": view.t_mm.tolist(),
            "scene": asdict(self.scene),
        }

    def _layers(self, number: int, trace: F64) -> list[Layer]:
        scene = self.scene
        if self._bed is None:
            self._bed = bed_texture(scene, self.texel_mm)
        layers = [flat_layer(self.view, self._bed, self.texel_mm, 0.0)]
        if scene.sheet is not None:
            key = trace.tobytes()
            if self._sheet is None or self._sheet[0] != key:
                self._sheet = (key, sheet_texture(scene, scene.sheet, trace, self.texel_mm))
            layers.append(flat_layer(self.view, self._sheet[1], self.texel_mm, scene.sheet.thickness_mm, scene.sheet))
        if scene.charuco is not None:
            texture = charuco_texture(scene.charuco, self.texel_mm)
            texel_mm = scene.charuco.square_mm / round(scene.charuco.square_mm / self.texel_mm)
            layers.append(board_layer(self.view, texture, texel_mm, *self.board_pose(number)))
        return layers

    def board_pose(self, number: int) -> tuple[F64, F64]:
        """Return how the board is held in frame `number`: its axes as columns and its middle in machine mm."""
        camera = self.scene.camera
        rng = np.random.default_rng([self.scene.seed, 50, number])
        w, h = (n * camera.mm_per_px for n in camera.size_px)
        third = [(-1, -1), (1, -1), (0, 0), (-1, 1), (1, 1), (0, -1), (0, 1), (-1, 0), (1, 0)][number % 9]
        place = np.array([*camera.looks_at_mm, rng.uniform(5, 60)]) + np.array([*third, 0.0]) * [0.22 * w, 0.2 * h, 0]
        tilt, to, turn = rng.uniform(0.1, 0.6), rng.uniform(0, 2 * math.pi), rng.uniform(-0.4, 0.4)
        axis = np.array([math.cos(to), math.sin(to), 0.0]) * tilt
        c, s = math.cos(turn), math.sin(turn)
        import cv2

        return np.asarray(cv2.Rodrigues(axis)[0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), place
