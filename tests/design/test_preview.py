"""Pictures of designs can be read: no label lies on another."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from design.preview import few_ticks


@pytest.mark.parametrize("height_mm", [0.5, 8.0, 40.0, 180.0])
def test_the_ticks_of_a_picture_in_space_do_not_lie_on_each_other(height_mm: float) -> None:
    figure = Figure(figsize=(5, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    x, y = np.meshgrid(np.linspace(-90, 90, 7), np.linspace(-90, 90, 7))
    axes.plot_surface(x, y, height_mm * np.cos(x / 90) * np.cos(y / 90))
    axes.set_aspect("equal")
    few_ticks(axes)
    canvas.draw()
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        low, high = sorted(axis.get_view_interval())
        shown = [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
        boxes = [label.get_window_extent().shrunk(0.85, 0.85) for label in shown if label.get_text()]
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
