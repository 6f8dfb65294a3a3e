"""Press a rigid sphere into the deployed sheet: load against depth, in and out again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.deploy.levels import Layout, prolong, refine
from design.deploy.newton import Equilibrium, System, smallest_eigenvalue_N_mm, solve
from design.deploy.shell import Ints, Reals, neighbours
from design.errors import NotConverged

CONTACT_RATIO = 20.0  # stiffness of a contact point over median k_d: it sinks in by a thousandth of a millimetre or so
SOLVED_COUNT = 1500  # units are divided until the sheet has about this many triangles: the footprint is below a unit


@dataclass(frozen=True, slots=True)
class Response:
    """Load of an indenter, pressed in and drawn out along a common grid of depths from first contact."""

    depth_mm: Reals  # (k,) ascending from 0
    load_N: Reals  # (k,)
    unload_N: Reals  # (k,)
    indenter_radius_mm: float
    point_mm: tuple[float, float, float]  # of first contact, in the frame of the deployed mesh
    direction: tuple[float, float, float]  # unit vector into the surface
    residual_ratio: float  # the worst of all equilibria of the curve
    recovered_mm: float  # the furthest any vertex stays from where it began, after release
    iterations_count: int  # of all equilibria of the curve
    unstable_count: int  # equilibria that a small disturbance would leave; 0 where the curve can be followed
    smallest_eigenvalue_N_mm: float  # at the greatest depth

    def stiffness_N_mm(self, depth_mm: float) -> float:
        """Return the secant stiffness of loading to `depth_mm`."""
        return float(np.interp(depth_mm, self.depth_mm, self.load_N) / depth_mm)


@dataclass(frozen=True, slots=True)
class Sphere:
    """A rigid sphere that vertices cannot enter: energy ½·stiffness·penetration² at each."""

    centre_mm: Reals  # (3,)
    radius_mm: float
    stiffness_N_mm: Reals  # (n,)

    def _penetration(self, x: Reals) -> tuple[Ints, Reals, Reals]:
        away = x - self.centre_mm
        distance = np.linalg.norm(away, axis=1)
        touching = np.flatnonzero(distance < self.radius_mm)
        return touching, self.radius_mm - distance[touching], away[touching] / distance[touching, None]

    def energy(self, x_mm: Reals) -> float:
        """Return the energy, mJ."""
        touching, depth, _ = self._penetration(x_mm)
        return float(0.5 * np.sum(self.stiffness_N_mm[touching] * depth**2))

    def add(self, x_mm: Reals, gradient_N: Reals, blocks_N_mm: Reals) -> None:
        """Add gradient and Hessian blocks."""
        touching, depth, out = self._penetration(x_mm)
        k = self.stiffness_N_mm[touching]
        gradient_N[touching] -= (k * depth)[:, None] * out
        outer = out[:, :, None] * out[:, None, :]
        bend = depth / (self.radius_mm - depth)
        blocks_N_mm[touching] += k[:, None, None] * (outer - bend[:, None, None] * (np.eye(3) - outer))

    def force_N(self, x_mm: Reals) -> Reals:
        """Return the force `(3,)` that the sheet exerts on the sphere."""
        touching, depth, out = self._penetration(x_mm)
        return np.asarray(-np.sum((self.stiffness_N_mm[touching] * depth)[:, None] * out, axis=0))


def border(cells: Ints, vertex_count: int) -> NDArray[np.bool_]:
    """Return which vertices lie on the rim, `(n,)`."""
    unit, corner = np.nonzero(neighbours(cells) < 0)
    rim = np.zeros(vertex_count, dtype=bool)
    rim[cells[unit, (corner + 1) % 3]] = rim[cells[unit, (corner + 2) % 3]] = True
    return rim


def standing_rim(cells: Ints, x_mm: Reals) -> NDArray[np.bool_]:
    """Return the vertices `(n,)` of the rims that a sheet stands on: those below its middle height, all if none is.

    A vase stands on its foot and not on its lip, a pierced cap not on its hole.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    unit, corner = np.nonzero(neighbours(cells) < 0)
    start, end = cells[unit, (corner + 1) % 3], cells[unit, (corner + 2) % 3]
    graph = coo_matrix((np.ones(len(start)), (start, end)), shape=(len(x_mm), len(x_mm)))
    _, loop = connected_components(graph, directed=False)
    rim = border(cells, len(x_mm))
    middle = 0.5 * (x_mm[:, 2].min() + x_mm[:, 2].max())
    low = [k for k in np.unique(loop[rim]) if x_mm[loop == k, 2].mean() < middle]
    return np.asarray(rim & np.isin(loop, low) if low else rim)


def first_contact(x_mm: Reals, point_mm: Reals, direction: Reals, radius_mm: float) -> float:
    """Return how far along `direction` from `point_mm` the sphere's foot can go before a vertex touches it.

    The sphere comes along the line through `point_mm`; the answer is the least over the vertices near that line.
    """
    away = x_mm - point_mm
    along = away @ direction
    aside = np.linalg.norm(away - along[:, None] * direction, axis=1)
    near = aside < radius_mm
    return float(np.min(along[near] + radius_mm - np.sqrt(radius_mm**2 - aside[near] ** 2)))


def indentation_response(
    layout: Layout,
    x_mm: Reals,
    indenter_radius_mm: float,
    depth_max_mm: float,
    steps_count: int = 24,
    point_mm: Reals | None = None,
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0),
    parts: int | None = None,
    watch: Callable[[float], None] | None = None,
) -> Response:
    """Return the load of a rigid sphere pressed to `depth_max_mm` at a point and drawn back, its lower rim held.

    `x_mm` is the deployed equilibrium of `layout`. The point is by default the highest against `direction`. Each unit
    is divided into `parts`² triangles (by default until there are about 1,500), because the footprint is smaller than
    a unit; the rim's vertices then stay where the free divided sheet has them. `watch(fraction)` sees progress.
    Frictionless under the sphere; no loss in the rubber: a difference between the curves is a snap.
    """
    if parts is None:
        parts = int(np.clip(round((SOLVED_COUNT / len(layout.cells)) ** 0.5), 1, 4))
    fine = refine(layout, parts)
    system = System(fine.shell())
    free = solve(system, x_mm if parts == 1 else prolong(layout, x_mm, fine))
    x = _on_top_of(free.x_mm[: layout.vertex_count], x_mm, free.x_mm)
    way = np.asarray(direction, float) / np.linalg.norm(direction)
    foot = x[int(np.argmin(x @ way))] if point_mm is None else np.asarray(point_mm, float)
    start = first_contact(x, foot, way, indenter_radius_mm)
    foot = foot + start * way
    rim = standing_rim(fine.cells, x)
    stiffness = np.full(fine.vertex_count, CONTACT_RATIO * float(np.median(system.shell.dilation_N_mm)))
    depths = np.linspace(0.0, depth_max_mm, steps_count + 1)
    loads: list[float] = []
    worst, begin, before, iterations, unstable, softest = 0.0, x, x, 0, 0, np.nan
    fixed = np.repeat(rim[:, None], 3, axis=1)
    for k, depth in enumerate([*depths, *depths[::-1]]):
        ball = Sphere(foot + (depth - indenter_radius_mm) * way, indenter_radius_mm, stiffness)
        found = _pressed(system, ball, fixed, x, before)
        iterations, unstable = iterations + found.iterations_count, unstable + (not found.stable)
        if k == len(depths) - 1:
            softest = smallest_eigenvalue_N_mm(system, found.x_mm, [ball], fixed)
        x, before, worst = found.x_mm, x, max(worst, found.residual_ratio)
        loads.append(float(ball.force_N(x) @ -way))
        if watch is not None:
            watch((k + 1) / (2 * len(depths)))
    back = float(np.linalg.norm(x - begin, axis=1).max())
    half = len(depths)
    there, again = np.array(loads[:half]), np.array(loads[half:])[::-1]
    point, into = (float(foot[0]), float(foot[1]), float(foot[2])), (float(way[0]), float(way[1]), float(way[2]))
    return Response(
        depths, there, again, indenter_radius_mm, point, into, worst, back, iterations, unstable, softest
    )  # fmt: skip


def _pressed(system: System, ball: Sphere, fixed: NDArray[np.bool_], x: Reals, before: Reals) -> Equilibrium:
    """Return the rest under the sphere, first from where the last two steps point, then from the last."""
    try:
        return solve(system, 2 * x - before, [ball], fixed, iterations_max=15)
    except NotConverged:
        return solve(system, x, [ball], fixed)


def _on_top_of(source_mm: Reals, goal_mm: Reals, all_mm: Reals) -> Reals:
    """Return `all_mm` moved as brings `source_mm` onto `goal_mm`."""
    from design.deploy.compare import kabsch

    rotation, shift = kabsch(source_mm, goal_mm)
    return np.asarray(all_mm @ rotation.T + shift)


def response_csv(response: Response) -> str:
    """Return the text of `response.csv`, version 1: one line of facts, a header, then one row a depth."""
    point = ",".join(f"{v:.6g}" for v in response.point_mm)
    direction = ",".join(f"{v:.6g}" for v in response.direction)
    head = (
        f"# fabctl response 1; indenter_radius_mm={response.indenter_radius_mm:.6g}; "
        f"point_mm={point}; direction={direction}\ndepth_mm,load_N,unload_N\n"
    )
    rows = zip(response.depth_mm, response.load_N, response.unload_N, strict=True)
    return head + "".join(f"{d:.6f},{f:.9g},{u:.9g}\n" for d, f, u in rows)
