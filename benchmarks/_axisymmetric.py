"""A second opinion on the pressed cap: a round shell as its meridian alone, written without the triangles.

Finite differences along the meridian, large displacements, stiffness that may change along it, rest curvature zero as
in a sheet that was flat. Derivatives by complex steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
TINY = 1e-30  # of the complex step: nothing is subtracted, so it may be as small as one likes
STEP_MM = 1e-5  # of the differences between slopes
ROUNDS_COUNT = 60
FORCE_N = 1e-7  # left at rest; a cap answers with 1e-2


@dataclass(frozen=True, slots=True)
class Meridian:
    """A cap from its axis to its rim, `(n,)` nodes: what each would measure in peace and how stiff it is."""

    arc_mm: Array
    ring_mm: Array  # radius of each node's parallel circle in peace
    Y_N_mm: Array
    nu_ratio: Array
    D_mJ: Array
    bending_nu_ratio: float
    radius_mm: float


def spherical(
    radius_mm: float, half_angle_rad: float, count: int, properties: Callable[[Array], tuple[Array, Array, Array]],
    bending_nu_ratio: float = -1 / 3,
) -> tuple[Meridian, Array]:  # fmt: skip
    """Return a spherical cap and its nodes `(n, 2)` as (r, z); `properties(polar angle)` gives Y, ν and D."""
    polar = np.linspace(0, half_angle_rad, count)
    Y, nu, D = (np.broadcast_to(v, count).astype(float) for v in properties(polar))
    ring = radius_mm * np.sin(polar)
    nodes = np.column_stack([ring, radius_mm * np.cos(polar)])
    return Meridian(radius_mm * polar, ring, Y, nu, D, bending_nu_ratio, radius_mm), nodes


def _energies(m: Meridian, x: NDArray[np.complex128], ball: tuple[float, float, Array]) -> NDArray[np.complex128]:
    """Return the energy of every stencil of three nodes `(n − 2,)` from `x` `(n − 2, 3, 2)`."""
    rest = np.diff(m.arc_mm)
    step = x[:, 1:] - x[:, :-1]
    length = np.sqrt(step[..., 0] ** 2 + step[..., 1] ** 2)
    both = np.stack([rest[:-1], rest[1:]], axis=1)
    # Each side lies in two stencils and counts half in each, but the first and the last count whole.
    share = np.full(both.shape, 0.5)
    share[0, 0] = share[-1, 1] = 1.0
    middle = 0.5 * (m.ring_mm[1:] + m.ring_mm[:-1])
    ring = np.stack([middle[:-1], middle[1:]], axis=1)
    Y, nu, D = (0.5 * (v[1:] + v[:-1]) for v in (m.Y_N_mm, m.nu_ratio, m.D_mJ))
    Y, nu, D = (np.stack([v[:-1], v[1:]], axis=1) for v in (Y, nu, D))
    now = 0.5 * (x[:, 1:, 0] + x[:, :-1, 0])
    along, around = length / both - 1, now / ring - 1
    membrane = 0.5 * Y / (1 - nu**2) * (along**2 + around**2 + 2 * nu * along * around)
    turning = _turn(step, length) / both.mean(axis=1)
    parallel = -step[..., 1] / length / ring
    nub = m.bending_nu_ratio
    bending = 0.5 * D * (turning[:, None] ** 2 + parallel**2 + 2 * nub * turning[:, None] * parallel)
    total = np.sum((membrane + bending) * 2 * np.pi * ring * both * share, axis=1)
    return np.asarray(total + _contact(x, ball))


def _turn(step: NDArray[np.complex128], length: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return by how much the meridian turns at the middle node, positive on a dome."""
    a, b = step[:, 0], step[:, 1]
    cross = (a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]) / (length[:, 0] * length[:, 1])
    return np.asarray(np.arcsin(cross))


def _contact(x: NDArray[np.complex128], ball: tuple[float, float, Array]) -> NDArray[np.complex128]:
    """Return the energy of springs against a sphere on the axis at (height, radius), `(n − 2,)` of the stencils."""
    height, radius, stiffness = ball
    total = np.zeros(len(x), dtype=complex)
    for place, owned in ((1, slice(None)), (0, slice(0, 1))):  # the axis node belongs to the first stencil
        some = x[owned, place]
        away = np.sqrt(some[:, 0] ** 2 + (some[:, 1] - height) ** 2 + TINY)
        weight = stiffness[1:-1] if place == 1 else stiffness[:1]
        total[owned] += np.where(away.real < radius, 0.5 * weight * (radius - away) ** 2, 0)
    return total


def _slopes(m: Meridian, x: Array, ball: tuple[float, float, Array]) -> Array:
    """Return the slope of every stencil's energy, `(n − 2, 3, 2)`."""
    out = np.empty(x.shape)
    for node in range(3):
        for axis in range(2):
            moved = x.astype(complex)
            moved[:, node, axis] += TINY * 1j
            out[:, node, axis] = _energies(m, moved, ball).imag / TINY
    return out


def _assembled(m: Meridian, x: Array, ball: tuple[float, float, Array]) -> tuple[Array, Array]:
    """Return gradient `(2n,)` and Hessian in dense form; a meridian is short."""
    n = len(x)
    where = np.arange(n - 2)[:, None] + np.arange(3)
    dofs = (2 * where[..., None] + np.arange(2)).reshape(n - 2, 6)
    local = x[where]
    gradient, hessian = np.zeros(2 * n), np.zeros((2 * n, 2 * n))
    np.add.at(gradient, dofs, _slopes(m, local, ball).reshape(-1, 6))
    for k in range(6):
        nudge = np.zeros((3, 2))
        nudge.flat[k] = STEP_MM
        change = (_slopes(m, local + nudge, ball) - _slopes(m, local - nudge, ball)) / (2 * STEP_MM)
        np.add.at(hessian, (dofs, dofs[:, k : k + 1]), change.reshape(-1, 6))
    return gradient, 0.5 * (hessian + hessian.T)


def at_rest(m: Meridian, nodes: Array, fixed: NDArray[np.bool_], ball: tuple[float, float, Array]) -> Array:
    """Return the nodes at rest with some degrees of freedom `(n, 2)` fixed; raise where none is found."""
    x, free = nodes.copy(), np.flatnonzero(~fixed.ravel())
    where = np.arange(len(x) - 2)[:, None] + np.arange(3)
    for _ in range(ROUNDS_COUNT):
        gradient, hessian = _assembled(m, x, ball)
        if np.abs(gradient[free]).max() < FORCE_N:
            return x
        step = np.zeros(x.size)
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        step = step.reshape(x.shape) * min(1.0, 1.0 / np.abs(step).max())
        before, length = float(_energies(m, x[where].astype(complex), ball).real.sum()), 1.0
        while length > 1e-4:
            after = float(_energies(m, (x + length * step)[where].astype(complex), ball).real.sum())
            if after <= before + 1e-12 * abs(before):
                break
            length /= 2
        x = x + length * step
    raise ArithmeticError(f"the meridian finds no rest: {np.abs(gradient[free]).max():.1e} N")


def pressed_N(m: Meridian, nodes: Array, ball_mm: float, depths_mm: Array, stiffness_N_mm: float = 4.0) -> Array:
    """Return the load of a rigid sphere at the apex at each depth, the rim held where it belongs."""
    spring = stiffness_N_mm * np.gradient(m.arc_mm)  # per node, whole ring
    fixed = np.zeros((len(nodes), 2), dtype=bool)
    fixed[0, 0] = True
    fixed[-1] = True
    x = at_rest(m, nodes, fixed, (1e9, 0.0, spring))
    foot, loads = float(x[0, 1]), []
    for depth in depths_mm:
        height = foot - float(depth) + ball_mm
        x = at_rest(m, x, fixed, (height, ball_mm, spring))
        away = np.hypot(x[:, 0], x[:, 1] - height)
        push = spring * np.maximum(0.0, ball_mm - away)
        loads.append(float(np.sum(push[:-1] * (height - x[:-1, 1]) / away[:-1])))
    return np.array(loads)
