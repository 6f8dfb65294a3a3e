"""The way from flat to deployed: equilibria while every unit grows from its cut size to its full expansion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from design.deploy.levels import Layout
from design.deploy.newton import System, solve
from design.deploy.shell import Reals
from design.errors import NotConverged


def deployment(
    layout: Layout, x_mm: Reals, frames_count: int = 16, watch: Callable[[float], None] | None = None
) -> list[Reals]:
    """Return shapes `(n, 3)` from nearly flat to `x_mm`, each at rest for its share of the expansion.

    Followed backwards from the deployed shape, which is unambiguous; units that snap one by one pass through other
    shapes. Ends early where the shrinking sheet finds no rest (the frames before it are returned).
    """
    frames, system = [x_mm], System(layout.shell())
    shares = np.linspace(1.0, 0.0, frames_count)[1:]
    for k, share in enumerate(shares):
        smaller = replace(layout, expansion_ratio=1 + share * (layout.expansion_ratio - 1))
        shrink = float(np.mean(smaller.expansion_ratio)) / _mean_stretch(layout, frames[-1])
        middle = frames[-1].mean(axis=0)
        try:
            found = solve(system.of(smaller.shell()), middle + shrink * (frames[-1] - middle), tolerance_ratio=1e-7)
        except NotConverged:
            break
        frames.append(_laid(found.x_mm, frames[-1]))
        if watch is not None:
            watch((k + 1) / len(shares))
    return frames[::-1]


def _mean_stretch(layout: Layout, x: Reals) -> float:
    a, b = x[layout.cells[:, 0]], x[layout.cells[:, 1]]
    return float(np.mean(np.linalg.norm(b - a, axis=1)) / layout.edge_mm)


def _laid(x: Reals, like: Reals) -> Reals:
    from design.deploy.compare import kabsch

    rotation, shift = kabsch(x, like)
    return np.asarray(x @ rotation.T + shift)


def followed(frames_mm: Sequence[Reals], end_mm: Reals) -> list[Reals]:
    """Return shapes moved rigidly: the last one onto `end_mm`, each earlier one onto the one after it."""
    laid = [_laid(frames_mm[-1], end_mm)]
    for x in frames_mm[-2::-1]:
        laid.append(_laid(x, laid[-1]))
    return laid[::-1]
