"""The other shapes a sheet may take: equilibria found from many starts, told apart, ordered by energy."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from design.deploy.compare import kabsch
from design.deploy.equilibrium import from_flat, pushed_flat, rolled, solve_level
from design.deploy.levels import Layout
from design.deploy.newton import Equilibrium
from design.deploy.shell import Ints, Reals, neighbours
from design.errors import NotConverged

BUMP_HEIGHT_RATIO = 0.5  # of a bump's width: how far it is pushed through, well past flat
SMALLEST_BUMP_COUNT = 4  # units
MOST_BUMPS_COUNT = 12  # the largest ones are turned over
LARGE_BUMP_RATIO = 0.25  # of the largest one's units: a second bump smaller than that is not turned over
SAME_RATIO = 0.01  # of the sheet's size, RMS after alignment: nearer than that is the same shape


@dataclass(frozen=True, slots=True)
class Found:
    """One equilibrium and the starts that led to it."""

    equilibrium: Equilibrium
    starts: tuple[str, ...]


def starts(layout: Layout, count: int, seed: int) -> dict[str, Callable[[Layout], Reals]]:
    """Return named starts: up, down, and `count` random gentle bulges of the flat sheet, repeatable by `seed`.

    A sheet with a re-joined seam starts as a cylinder, either side out.
    """
    if layout.rejoined_count():
        return {"rolled": rolled, "rolled inside out": functools.partial(rolled, outward=-1.0)}
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


def bumps(layout: Layout) -> list[Ints]:
    """Return the groups of units `(k,)` that become domes or bowls, largest first.

    A sheet of expansion λ takes the Gaussian curvature −Δ log λ/λ², whose sign tells domes from saddles; which way a
    dome stands the expansions do not say.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    across = neighbours(layout.cells)
    beside, height = across >= 0, np.log(layout.expansion_ratio)
    for _ in range(2):  # one unit's neighbours are too near to tell curvature from noise
        height = (height + np.sum(np.where(beside, height[across], 0), axis=1)) / (1 + beside.sum(axis=1))
    domed = np.sum(np.where(beside, height[across] - height[:, None], 0), axis=1) < 0
    one, side = np.nonzero(beside & domed[:, None] & domed[across])
    graph = coo_matrix((np.ones(len(one)), (one, across[one, side])), shape=(len(domed), len(domed)))
    _, part = connected_components(graph, directed=False)
    groups = [np.flatnonzero((part == k) & domed) for k in np.unique(part[domed])]
    groups = [group for group in groups if len(group) >= SMALLEST_BUMP_COUNT]
    return sorted(groups, key=len, reverse=True)[:MOST_BUMPS_COUNT]


def turned_over(layout: Layout, x_mm: Reals, bump: Ints, side: float) -> Reals:
    """Return the shape `(n, 3)` with a bump pushed along the surface's normal, to `side` (±1)."""
    flat, centre = layout.flat_mm(), layout.corners_mm[bump].mean(axis=(0, 1))
    width = float(np.sqrt(len(bump) * np.sqrt(0.1875)) * layout.edge_mm)
    a, b, c = (x_mm[layout.cells[bump, k]] for k in range(3))
    normal = np.cross(b - a, c - a).sum(axis=0)
    normal /= np.linalg.norm(normal)
    near = np.exp(-2 * np.sum((flat - centre) ** 2, axis=1) / width**2)
    stretch = float(layout.expansion_ratio[bump].mean())
    return np.asarray(x_mm + side * BUMP_HEIGHT_RATIO * stretch * width * near[:, None] * normal)


def hinted(layout: Layout, x_mm: Reals, hints: Sequence[tuple[float, float, float]]) -> Equilibrium:
    """Return the rest of a sheet near `x_mm` whose bumps are pushed to given sides: hints are (x_mm, y_mm, side ±1).

    Places count from the middle of the flat's box, as a specification's regions do; each means the bump nearest to it,
    and +1 the side that units run counter-clockwise to. One after the other, each from the rest before it. Where there
    is no bump, or a place is beside the sheet, `ValueError`; a bump that does not stay on its side shows in the shape
    and its energy.
    """
    places, centre = bumps(layout), layout.corners_mm.mean(axis=1)
    if not places:
        raise ValueError("the sheet has no bump that could stand to either side")
    middle = 0.5 * (layout.corners_mm.min(axis=(0, 1)) + layout.corners_mm.max(axis=(0, 1)))
    half = 0.5 * (layout.corners_mm.max(axis=(0, 1)) - layout.corners_mm.min(axis=(0, 1)))
    for x, y, side in hints:
        if abs(x) > half[0] or abs(y) > half[1]:
            raise ValueError(
                f"({x:g}, {y:g}) mm lies beside the sheet, whose cells reach {half[0]:.0f} mm to the left and right of "
                f"their middle and {half[1]:.0f} mm up and down"
            )
        away = np.linalg.norm(centre - middle - [x, y], axis=1)
        bump = min(places, key=lambda group: float(away[group].min()))
        rest = solve_level(layout, turned_over(layout, x_mm, bump, side))
        x_mm = rest.x_mm
    return rest


def _designed_starts(layout: Layout, design_mm: Reals) -> dict[str, Reals]:
    """Return the intended shape, and the same with one bump after the other pushed to either side."""
    return {"designed": design_mm, **_turnings(layout, design_mm, bumps(layout), "designed, bump")}


def _turnings(layout: Layout, x_mm: Reals, places: list[Ints], name: str) -> dict[str, Reals]:
    return {
        f"{name} {k + 1} {word}": turned_over(layout, x_mm, bump, side)
        for k, bump in enumerate(places)
        for side, word in ((1.0, "up"), (-1.0, "down"))
    }


def _second_turnings(layout: Layout, found: list[Found]) -> dict[str, Reals]:
    """Return every shape that a bump turned over has led to, with each large bump turned over as well."""
    places = bumps(layout)
    large = [bump for bump in places if len(bump) >= LARGE_BUMP_RATIO * len(places[0])]
    named: dict[str, Reals] = {}
    for one in found:
        if one.starts[0].startswith("designed, bump"):
            named |= _turnings(layout, one.equilibrium.x_mm, large, f"{one.starts[0]}, then bump")
    return named


def equilibria(
    layout: Layout,
    design_mm: Reals | None = None,
    count: int = 6,
    seed: int = 1,
    watch: Callable[[float, str], None] | None = None,
) -> tuple[list[Found], list[str]]:
    """Return the different stable equilibria found, lowest energy first, and the starts that led nowhere.

    Starts are the designed shape (where its points `(n, 3)` are given), the same with each bump turned over, those
    of `starts`, and the shapes so found by turning a bump over with a second bump turned over. A shape and its mirror
    image are two, unless turning makes them one.
    """
    found: list[Found] = []
    lost: list[str] = []

    def look(ways: Mapping[str, Callable[[], Equilibrium]], begin: float, end: float) -> None:
        for k, (name, way) in enumerate(ways.items()):
            try:
                _keep(found, way(), name)
            except NotConverged as fault:
                lost.append(f"{name}: {fault}")
            if watch is not None:
                watch(begin + (end - begin) * (k + 1) / len(ways), name)

    def from_shapes(named: dict[str, Reals]) -> dict[str, Callable[[], Equilibrium]]:
        return {name: functools.partial(solve_level, layout, x) for name, x in named.items()}

    near = {} if design_mm is None else _designed_starts(layout, design_mm)
    flat = {name: functools.partial(from_flat, layout, start) for name, start in starts(layout, count, seed).items()}
    look(from_shapes(near), 0.0, 0.4)
    look(flat, 0.4, 0.7)
    look(from_shapes(_second_turnings(layout, found)), 0.7, 1.0)
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
