"""Energy, gradient and Hessian of the shell, exactly, in compiled loops.

Positions are `(n, 3)` in mm, energies mJ (= N·mm), forces N. Hessians are scattered straight into the data array of a
compressed sparse matrix; `slots` says where each 3×3 block begins and `stride` how far its rows are apart.
"""

# The loops are written out for the compiler; the formulas are in the docstrings.

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

Array = Any  # compiled code: arrays of float64 and int64, shapes in the docstrings


@njit(cache=True)  # type: ignore[untyped-decorator]
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)  # type: ignore[untyped-decorator]
def well(s: float, lam: float, kd: float, shares: Array, curve: Array) -> tuple[float, float, float]:
    """Return energy per area of an even stretch s and its first two slopes: ½k_d(s − λ)², or a whole curve if given.

    `curve` `(k − 1, 4)` are a spline's coefficients over `shares` `(k,)` of the way from flat to λ, highest power
    first; beyond its ends it goes on as a parabola.
    """
    if len(curve) == 0:
        return 0.5 * kd * (s - lam) ** 2, kd * (s - lam), kd
    span = lam - 1.0
    share = (s - 1.0) / span
    inside = min(max(share, shares[0]), shares[-1])
    at = 0
    while at < len(curve) - 1 and inside > shares[at + 1]:
        at += 1
    t = inside - shares[at]
    a, b, c, d = curve[at, 0], curve[at, 1], curve[at, 2], curve[at, 3]
    energy, slope, bend = ((a * t + b) * t + c) * t + d, (3 * a * t + 2 * b) * t + c, 6 * a * t + 2 * b
    beyond = share - inside
    if beyond != 0.0:
        bend = max(bend, kd * span * span)
        energy += slope * beyond + 0.5 * bend * beyond * beyond
        slope += bend * beyond
    return energy, slope / span, bend / (span * span)


@njit(cache=True)  # type: ignore[untyped-decorator]
def membrane(
    x: Array, cells: Array, area: Array, cot: Array, lam: Array, kd: Array, ks: Array, shares: Array, curves: Array,
    slots: Array, stride: Array, gradient: Array, hessian: Array, want: int,
) -> float:  # fmt: skip
    """Add the in-plane energy; return it.

    Per unit k_s(½Σ½cot|e|² − a) + ½k_d A(√(a/A) − λ)², a the present area: equal to A[½k_d(s−λ)² + ½k_s(σ1−σ2)²].
    Where `curves` `(m, k − 1, 4)` has rows, the first term is A·(that curve) instead: see `well`.
    `want` 0: energy only, 1: and gradient, 2: and Hessian.
    """
    total = 0.0
    e = np.empty((3, 3))
    normal = np.empty(3)
    da = np.empty((3, 3))
    none = np.empty((0, 4))
    for t in range(len(cells)):
        i0, i1, i2 = cells[t, 0], cells[t, 1], cells[t, 2]
        for c in range(3):
            e[0, c] = x[i2, c] - x[i1, c]
            e[1, c] = x[i0, c] - x[i2, c]
            e[2, c] = x[i1, c] - x[i0, c]
        _cross(e[2], -e[1], normal)
        twice = np.sqrt(_dot(normal, normal))
        a = 0.5 * twice
        ratio = a / area[t]
        s = np.sqrt(ratio)
        k = 0.25 * ks[t]
        dirichlet = cot[t, 0] * _dot(e[0], e[0]) + cot[t, 1] * _dot(e[1], e[1]) + cot[t, 2] * _dot(e[2], e[2])
        psi, rise, bend = well(s, lam[t], kd[t], shares, curves[t] if len(curves) else none)
        total += k * dirichlet - ks[t] * a + area[t] * psi
        if want == 0:
            continue
        inv = 1.0 / max(twice, 1e-300)
        for c in range(3):
            normal[c] *= inv
        slope = 0.5 * rise / s - ks[t]
        for i in range(3):
            _cross(normal, e[i], da[i])
            j, l = (i + 1) % 3, (i + 2) % 3
            for c in range(3):
                da[i, c] *= 0.5
                pull = 2 * k * (cot[t, l] * -e[l, c] + cot[t, j] * e[j, c])
                gradient[cells[t, i], c] += slope * da[i, c] + pull
        if want == 1:
            continue
        curve = 0.25 * (bend * s - rise) / (area[t] * s * ratio)
        for i in range(3):
            for j in range(3):
                start = slots[t, i, j]
                row = stride[cells[t, i]]
                along = 0.5 * inv * slope * _dot(e[i], e[j])
                if i == j:
                    dirich = 2 * k * (cot[t, (i + 1) % 3] + cot[t, (i + 2) % 3])
                    turn = 0.0
                else:
                    dirich = -2 * k * cot[t, 3 - i - j]
                    turn = -0.5 * slope if j == (i + 1) % 3 else 0.5 * slope
                for c in range(3):
                    for d in range(3):
                        value = along * normal[c] * normal[d] + curve * da[i, c] * da[j, d]
                        if c == d:
                            value += dirich
                        elif d == (c + 1) % 3:
                            value -= turn * normal[3 - c - d]
                        else:
                            value += turn * normal[3 - c - d]
                        hessian[start + c * row + d] += value
    return total


@njit(cache=True)  # type: ignore[untyped-decorator]
def fold_angle(x: Array, hinge: Array) -> Array:
    """Return the signed angle from the left unit's normal to the right one's, about the edge."""
    e, p, q = x[hinge[1]] - x[hinge[0]], x[hinge[2]] - x[hinge[0]], x[hinge[3]] - x[hinge[0]]
    left, right, both = np.empty(3), np.empty(3), np.empty(3)
    _cross(e, p, left)
    _cross(q, e, right)
    _cross(left, right, both)
    return np.arctan2(_dot(both, e) / np.sqrt(_dot(e, e)), _dot(left, right))


@njit(cache=True)  # type: ignore[untyped-decorator]
def bending(
    x: Array, hinges: Array, fold: Array, rest: Array,
    slots: Array, stride: Array, gradient: Array, hessian: Array, want: int,
) -> float:  # fmt: skip
    """Add the folding energy Σ½·fold·(θ − θ0)²; return it.

    With q = n/height of each side, ∇θ is −q at the far corner and q shared by the edge's ends in barycentric measure;
    differentiating these once more gives the Hessian, no term left out.
    """
    total = 0.0
    e, far = np.empty(3), np.empty(3)
    big = np.empty(3)
    q = np.empty(3)
    first = np.empty((4, 3))
    second = np.empty((12, 12))
    share = np.empty(3)
    dshare = np.empty((3, 3))  # of the share w, by (start, end, far)
    dq = np.empty((3, 3, 3))  # of q, by (start, end, far), [which, component of q, component of x]
    turn = np.empty((3, 3))
    for h in range(len(hinges)):
        theta = fold_angle(x, hinges[h])
        excess = theta - rest[h]
        total += 0.5 * fold[h] * excess * excess
        if want == 0:
            continue
        first[:] = 0.0
        second[:] = 0.0
        start, end = hinges[h, 0], hinges[h, 1]
        for c in range(3):
            e[c] = x[end, c] - x[start, c]
        ee = _dot(e, e)
        length = np.sqrt(ee)
        for side in range(2):
            corner = hinges[h, 2 + side]
            sign = 1.0 if side == 0 else -1.0
            for c in range(3):
                far[c] = x[corner, c] - x[start, c]
            _cross(e, far, big)
            for c in range(3):
                big[c] *= sign
            nn = _dot(big, big)
            w = _dot(far, e) / ee
            share[0], share[1], share[2] = 1 - w, w, -1.0
            for c in range(3):
                q[c] = big[c] * length / nn
            for k in range(3):
                local = k if k < 2 else 2 + side
                for c in range(3):
                    first[local, c] += share[k] * q[c]
            if want == 1:
                continue
            for c in range(3):
                dshare[1, c] = (far[c] - 2 * w * e[c]) / ee
                dshare[2, c] = e[c] / ee
                dshare[0, c] = -dshare[1, c] - dshare[2, c]
            # ∂N/∂end = −[far]×, ∂N/∂far = [e]× (times sign); then q = N|e|/|N|²
            for k in range(1, 3):
                lever = far if k == 1 else e
                flip = -sign if k == 1 else sign
                turn[0, 0] = turn[1, 1] = turn[2, 2] = 0.0
                turn[0, 1], turn[0, 2] = -flip * lever[2], flip * lever[1]
                turn[1, 0], turn[1, 2] = flip * lever[2], -flip * lever[0]
                turn[2, 0], turn[2, 1] = -flip * lever[1], flip * lever[0]
                for d in range(3):
                    inward = (big[0] * turn[0, d] + big[1] * turn[1, d] + big[2] * turn[2, d]) * 2 / nn
                    for c in range(3):
                        value = length / nn * (turn[c, d] - big[c] * inward)
                        if k == 1:
                            value += big[c] * e[d] / (length * nn)
                        dq[k, c, d] = value
            for c in range(3):
                for d in range(3):
                    dq[0, c, d] = -dq[1, c, d] - dq[2, c, d]
            for k in range(3):
                row = 3 * (k if k < 2 else 2 + side)
                for m in range(3):
                    col = 3 * (m if m < 2 else 2 + side)
                    # share[2] is constant, so only the ends' shares move
                    moves = 0.0 if k == 2 else (1.0 if k == 1 else -1.0)
                    for c in range(3):
                        for d in range(3):
                            second[row + c, col + d] += share[k] * dq[m, c, d] + moves * q[c] * dshare[m, d]
        force = fold[h] * excess
        for k in range(4):
            for c in range(3):
                gradient[hinges[h, k], c] += force * first[k, c]
        if want == 1:
            continue
        for k in range(4):
            row_step = stride[hinges[h, k]]
            for m in range(4):
                begin = slots[h, k, m]
                for c in range(3):
                    for d in range(3):
                        even = 0.5 * (second[3 * k + c, 3 * m + d] + second[3 * m + d, 3 * k + c])
                        hessian[begin + c * row_step + d] += fold[h] * first[k, c] * first[m, d] + force * even
    return total
