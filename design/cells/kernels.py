"""Compiled inner loops: the energy of P2 triangles with two derivatives, and a banded LDLᵀ that counts signs.

Plane-stress neo-Hookean, per unit thickness, ψ(F) = μ/2 (F:F + c² − 3) − μ ln(cJ) + Λ/2 ln²(cJ), where the thickness
stretch c solves μ(c² − 1) + Λ ln(cJ) = 0 (so the first derivative needs no dc/dF).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile `function` once per machine; numba has no types of its own, so they are kept here."""
    return cast(Kernel, numba.njit(cache=True)(function))


def lame_MPa(E_MPa: float, nu_ratio: float) -> tuple[float, float]:
    """Return the three-dimensional Lamé constants (μ, Λ)."""
    return E_MPa / (2 * (1 + nu_ratio)), E_MPa * nu_ratio / ((1 + nu_ratio) * (1 - 2 * nu_ratio))


@compiled
def log_thickness(log_J: float, mu: float, lam: float) -> float:
    """Return ln c for ln J: the root of the convex, rising μ(e^{2z} − 1) + Λ(z + ln J)."""
    z = -lam / (lam + 2 * mu) * log_J
    for _ in range(50):
        e = math.exp(2 * z)
        step = (mu * (e - 1) + lam * (z + log_J)) / (2 * mu * e + lam)
        z -= step
        if abs(step) < 1e-15 * (1 + abs(z)):
            break
    return z


@compiled
def energy_density(F: Array, mu: float, lam: float, P: Array, H: Array, order: int) -> float:
    """Return ψ(F) for F (2, 2); fill P = dψ/dF for `order` ≥ 1 and H = d²ψ/dF² (4, 4) for `order` 2; inf for J ≤ 0."""
    J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
    if J <= 0.0:
        return np.inf
    log_J = math.log(J)
    z = log_thickness(log_J, mu, lam)
    c2 = math.exp(2 * z)
    log_cJ = z + log_J
    I1 = F[0, 0] ** 2 + F[0, 1] ** 2 + F[1, 0] ** 2 + F[1, 1] ** 2
    if order == 0:
        return float(mu / 2 * (I1 + c2 - 3) - mu * log_cJ + lam / 2 * log_cJ**2)
    slope = -mu * c2 / J  # dψ/dJ
    cof = np.empty(4)
    cof[0], cof[1], cof[2], cof[3] = F[1, 1], -F[1, 0], -F[0, 1], F[0, 0]
    for i in range(2):
        for j in range(2):
            P[i, j] = mu * F[i, j] + slope * cof[2 * i + j]
    if order == 2:
        # From μ(c² − 1) + Λ ln(cJ) = 0: d(c²)/dJ = −2Λc²/(J(2μc² + Λ)).
        curve = mu * c2 / J**2 * (1 + 2 * lam / (2 * mu * c2 + lam))
        for a in range(4):
            for b in range(4):
                H[a, b] = curve * cof[a] * cof[b]
            H[a, a] += mu
        H[0, 3] += slope
        H[3, 0] += slope
        H[1, 2] -= slope
        H[2, 1] -= slope
    return float(mu / 2 * (I1 + c2 - 3) - mu * log_cJ + lam / 2 * log_cJ**2)


@compiled
def total_energy(x: Array, elements: Ints, grads: Array, weights: Array, mu: float, lam: float) -> float:
    """Return the energy of the deformed nodes `x` (n, 2); inf where an element is turned over."""
    total = 0.0
    F, P, H = np.empty((2, 2)), np.empty((2, 2)), np.empty((4, 4))
    for e in range(elements.shape[0]):
        for q in range(weights.shape[1]):
            F[:] = 0.0
            for a in range(6):
                for i in range(2):
                    for j in range(2):
                        F[i, j] += x[elements[e, a], i] * grads[e, q, a, j]
            total += weights[e, q] * energy_density(F, mu, lam, P, H, 0)
            if total == np.inf:
                return np.inf
    return total


@compiled
def element_derivatives(
    x: Array, elements: Ints, grads: Array, weights: Array, mu: float, lam: float
) -> tuple[float, Array, Array]:
    """Return the energy, and per element its gradient (m, 12) and Hessian (m, 12, 12) in the node positions."""
    count = elements.shape[0]
    total = 0.0
    g, h = np.zeros((count, 12)), np.zeros((count, 12, 12))
    F, P, H = np.empty((2, 2)), np.empty((2, 2)), np.empty((4, 4))
    HB = np.empty((4, 12))
    for e in range(count):
        for q in range(weights.shape[1]):
            F[:] = 0.0
            for a in range(6):
                for i in range(2):
                    for j in range(2):
                        F[i, j] += x[elements[e, a], i] * grads[e, q, a, j]
            w = weights[e, q]
            total += w * energy_density(F, mu, lam, P, H, 2)
            if total == np.inf:
                return total, g, h
            for a in range(6):
                gx, gy = w * grads[e, q, a, 0], w * grads[e, q, a, 1]
                for i in range(2):
                    g[e, 2 * a + i] += P[i, 0] * gx + P[i, 1] * gy
                    for r in range(4):
                        HB[r, 2 * a + i] = H[r, 2 * i] * gx + H[r, 2 * i + 1] * gy
            for a in range(6):
                gx, gy = grads[e, q, a, 0], grads[e, q, a, 1]
                for i in range(2):
                    row = h[e, 2 * a + i]
                    for k in range(12):
                        row[k] += gx * HB[2 * i, k] + gy * HB[2 * i + 1, k]
    return total, g, h


@compiled
def gather(
    g: Array,
    h: Array,
    elements: Ints,
    masters: Ints,
    maps: Array,
    pull: Array,
    size: int,
    width: int,
) -> tuple[Array, Array, float, float, Array]:
    """Sum element derivatives into the unknowns (y, s) where node n stands at maps[n] @ y[masters[n]] + s·pull[n].

    `masters` (n, 2) is −1 where a column of `maps` (n, 2, 2) has no unknown. Returns the Hessian in y as a lower band,
    (size, width + 1) with [j, k] = H[j + k, j], its mixed column (size,), d²/ds², d/ds, and the gradient in y (size,).
    """
    band, mixed, grad = np.zeros((size, width + 1)), np.zeros(size), np.zeros(size)
    curve, slope = 0.0, 0.0
    block = np.empty((2, 2))
    for e in range(elements.shape[0]):
        for a in range(6):
            na = elements[e, a]
            for i in range(2):
                slope += g[e, 2 * a + i] * pull[na, i]
                for r in range(2):
                    if masters[na, r] >= 0:
                        grad[masters[na, r]] += maps[na, i, r] * g[e, 2 * a + i]
            for b in range(6):
                nb = elements[e, b]
                for i in range(2):
                    for j in range(2):
                        block[i, j] = h[e, 2 * a + i, 2 * b + j]
                for i in range(2):
                    along = block[i, 0] * pull[nb, 0] + block[i, 1] * pull[nb, 1]
                    curve += pull[na, i] * along
                    for r in range(2):
                        if masters[na, r] >= 0:
                            mixed[masters[na, r]] += maps[na, i, r] * along
                for r in range(2):
                    row = masters[na, r]
                    if row < 0:
                        continue
                    for s in range(2):
                        column = masters[nb, s]
                        if column < 0 or row < column:
                            continue
                        total = 0.0
                        for i in range(2):
                            for j in range(2):
                                total += maps[na, i, r] * block[i, j] * maps[nb, j, s]
                        band[column, row - column] += total
    return band, mixed, curve, slope, grad


@compiled
def split(
    h: Array, elements: Ints, inside: Ints, border: Ints, size: int, width: int, edge: int
) -> tuple[Array, Array, Array]:
    """Sum element Hessians into the band of the inside, (size, width + 1), its coupling to the border, and the border.

    `inside` and `border` (n, 2) number the coordinates of each node, -1 where it is not of that kind.
    Returns the band, (size, edge) and (edge, edge).
    """
    band, couple, rim = np.zeros((size, width + 1)), np.zeros((size, edge)), np.zeros((edge, edge))
    for e in range(elements.shape[0]):
        for a in range(6):
            for i in range(2):
                row, row_rim = inside[elements[e, a], i], border[elements[e, a], i]
                for b in range(6):
                    for j in range(2):
                        value = h[e, 2 * a + i, 2 * b + j]
                        column, column_rim = inside[elements[e, b], j], border[elements[e, b], j]
                        if row >= 0 and column >= 0:
                            if row >= column:
                                band[column, row - column] += value
                        elif row >= 0:
                            couple[row, column_rim] += value
                        elif column < 0:
                            rim[row_rim, column_rim] += value
    return band, couple, rim


@compiled
def factor_band(band: Array) -> int:
    """Overwrite the lower band with L (unit diagonal left out) and D, A = L D Lᵀ; return how many of D are negative.

    No pivoting: sound for definite matrices and, away from singular leading blocks, for the saddle points met here;
    by Sylvester the count is the number of negative eigenvalues.
    """
    size, width = band.shape[0], band.shape[1] - 1
    negative = 0
    for j in range(size):
        d = band[j, 0]
        if d < 0.0:
            negative += 1
        last = min(width, size - 1 - j)
        for i in range(1, last + 1):
            v = band[j, i]
            if v != 0.0:
                f = v / d
                target = band[j + i]
                for k in range(last + 1 - i):
                    target[k] -= f * band[j, i + k]
        for i in range(1, last + 1):
            band[j, i] /= d
    return negative


@compiled
def solve_band(band: Array, rhs: Array) -> Array:
    """Return A⁻¹ rhs for columns `rhs` (size, k), with `band` from `factor_band`."""
    size, width = band.shape[0], band.shape[1] - 1
    x = rhs.copy()
    for j in range(size):
        for i in range(1, min(width, size - 1 - j) + 1):
            f = band[j, i]
            if f != 0.0:
                for c in range(x.shape[1]):
                    x[j + i, c] -= f * x[j, c]
    for j in range(size - 1, -1, -1):
        for c in range(x.shape[1]):
            x[j, c] /= band[j, 0]
        for i in range(1, min(width, size - 1 - j) + 1):
            f = band[j, i]
            if f != 0.0:
                for c in range(x.shape[1]):
                    x[j, c] -= f * x[j + i, c]
    return x
