"""Specimens in closed form, whose every figure is known: for checking a rig, a driver and an analysis."""

from __future__ import annotations

import math
from collections.abc import Callable

from simulators.specimens.curve import Curves

STEP_MM = 0.005
DEPTH_MM = 30.0


def tabulate(force_N: Callable[[float], float], unload_ratio: float = 1.0, depth_mm: float = DEPTH_MM) -> Curves:
    """Return the closed form on a grid fine enough that its straight pieces do not show."""
    load = [force_N(k * STEP_MM) for k in range(round(depth_mm / STEP_MM) + 1)]
    return Curves(STEP_MM, load, load if unload_ratio == 1 else [unload_ratio * force for force in load])


def hertz(E_MPa: float = 0.05, nu_ratio: float = 0.45, radius_mm: float = 8.0) -> Curves:
    """Return a rigid sphere on an elastic half-space, F = 4/3 E/(1−ν²) √R d^1.5 (Hertz 1882)."""
    factor = 4 / 3 * E_MPa / (1 - nu_ratio**2) * math.sqrt(radius_mm)
    return tabulate(lambda d: factor * d**1.5)


def linear(stiffness_N_mm: float = 0.5) -> Curves:
    """Return a spring."""
    return tabulate(lambda d: stiffness_N_mm * d)


def softening(stiffness_N_mm: float = 0.5, depth_mm: float = 4.0) -> Curves:
    """Return a cap that softens, F = k d0 (√(1 + 2d/d0) − 1): slope k at contact, concave everywhere."""
    return tabulate(lambda d: stiffness_N_mm * depth_mm * (math.sqrt(1 + 2 * d / depth_mm) - 1))


def bistable(peak_mm: float = 3.0, valley_mm: float = 9.0, scale_N_mm3: float = 0.02) -> Curves:
    """Return a cubic, dF/dd = 3a (d − p)(d − v) with F(0) = 0: maximum at p, minimum at v."""

    def force(d: float) -> float:
        return scale_N_mm3 * (d**3 - 1.5 * (peak_mm + valley_mm) * d**2 + 3 * peak_mm * valley_mm * d)

    return tabulate(force)


BY_NAME: dict[str, Callable[[], Curves]] = {
    "hertz": hertz,
    "linear": linear,
    "softening": softening,
    "bistable": bistable,
}
