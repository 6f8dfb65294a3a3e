"""The other shapes a sheet may take: equilibria found from many starts, told apart, ordered by energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from design.deploy.compare import kabsch
from design.deploy.equilibrium import from_flat, pushed_flat, solve_level
from design.deploy.levels import Layout
from design.deploy.newton import Equilibrium
from design.deploy.shell import Reals
from design.errors import NotConverged

SAME_RATIO = 0.01  # of the sheet's size, RMS after alignment: nearer than that is the same shape


@dataclass(frozen=True, slots=True)
class Found:
    """One equilibrium and the starts that led to it."""

    equilibrium: Equilibrium
    starts: tuple[str, ...]


def starts(layout: Layout, count: int, seed: int) -> dict[str, Callable[[Layout], Reals]]:
    """Return named starts: up, down, and `count` random gentle bulges of the flat sheet, repeatable by `seed`."""
    named: dict[str, Callable[[Layout], Reals]] = {
        "up": lambda level: pushed_flat(level, 0.3),
        "down": lambda level: pushed_flat(level, -0.3),
    }
    rng = np.random.default_rng(seed)
    size = float(np.ptp(layout.flat_mm(), axis=0).max())
    for k in range(count):
        waves = rng.normal(size=(6, 2)) * np.pi / size
        phases, heights = rng.uniform(0, 2 * np.pi, 6), rng.normal(size=6) * 0.3
        named[f"random {k + 1}"] = _bulge(waves, phases, heights)
    return named


def _bulge(waves: Reals, phases: Reals, heights: Reals) -> Callable[[Layout], Reals]:
    def start(level: Layout) -> Reals:
        side = np.sum(heights * np.sin(level.corners_mm.mean(axis=1) @ waves.T + phases), axis=1)
        return pushed_flat(level, side)

    return start


def equilibria(
    layout: Layout,
    design_mm: Reals | None = None,
    count: int = 6,
    seed: int = 1,
    watch: Callable[[float, str], None] | None = None,
) -> tuple[list[Found], list[str]]:
    """Return the different stable equilibria found, lowest energy first, and the starts that led nowhere.

    Starts are the designed shape (where its points `(n, 3)` are given) and those of `starts`. A shape and its mirror
    image are two, unless turning makes them one.
    """
    found: list[Found] = []
    lost: list[str] = []
    named = starts(layout, count, seed)
    total = len(named) + (design_mm is not None)
    if design_mm is not None:
        try:
            _keep(found, solve_level(layout, design_mm), "designed")
        except NotConverged as fault:
            lost.append(f"designed: {fault}")
        if watch is not None:
            watch(1 / total, "designed")
    for k, (name, start) in enumerate(named.items()):
        try:
            _keep(found, from_flat(layout, start), name)
        except NotConverged as fault:
            lost.append(f"{name}: {fault}")
        if watch is not None:
            watch((k + 1 + (design_mm is not None)) / total, name)
    return sorted(found, key=lambda one: one.equilibrium.energy_mJ), lost


def _keep(found: list[Found], equilibrium: Equilibrium, name: str) -> None:
    for k, one in enumerate(found):
        if same_shape(one.equilibrium.x_mm, equilibrium.x_mm):
            found[k] = replace(one, starts=(*one.starts, name))
            return
    found.append(Found(equilibrium, (name,)))


def same_shape(one_mm: Reals, other_mm: Reals) -> bool:
    """Return whether turning and moving brings one shape onto the other, vertex by vertex."""
    rotation, shift = kabsch(one_mm, other_mm)
    rms = np.sqrt(np.mean(np.sum((one_mm @ rotation.T + shift - other_mm) ** 2, axis=1)))
    return bool(rms < SAME_RATIO * np.linalg.norm(np.ptp(other_mm, axis=0)))
