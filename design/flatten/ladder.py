"""Can a sheet become this surface? One rung after the other, until the library's range is enough.

Global scale → the rim optimised → where it does not fit, and whether that is proven → cones, or the nearest surface
that fits, where asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from design.errors import FlattenError, NotConverged
from design.findings import Finding
from design.flatten.bound import proven_bound
from design.flatten.flat import flatten
from design.flatten.nearest import Feasible, closest_feasible
from design.flatten.result import Flattening, FlattenOptions
from design.surface import TriMesh, boundary_loops

Values = NDArray[np.float64]
Remedy = Literal["none", "cones", "nearest", "both"]
Rung = Literal["scale", "rim", "cones", "nearest"]
MOST_CONES_count = 6
ALLOWANCE_log = 0.005  # least allowance for averaging logarithms of expansions instead of areas
Emit = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Limits:
    """Expansions the library offers, and the cells' size."""

    low_ratio: float
    high_ratio: float
    cell_mm: float = 10.0

    def range_ratio(self) -> float:
        """Return the largest expansion over the smallest."""
        return self.high_ratio / self.low_ratio


@dataclass(frozen=True, slots=True)
class Step:
    """One rung: what was tried, the spread it leaves, whether that is within the library, and its price."""

    rung: Rung
    spread_ratio: float
    fits: bool
    detail: str
    flattening: Flattening


@dataclass(frozen=True, slots=True)
class FeasibilityReport:
    """What `feasibility` found. `excess_log` says for each face how far its expansion lies outside the library."""

    limits: Limits
    steps: tuple[Step, ...]
    bound_ratio: float | None  # no cone-free single sheet spreads less; None where none was asked for or found
    proven_infeasible: bool
    scale_ratio: float  # factor on the rim step's flat that places its expansions best in the library
    excess_log: Values  # (m,) ln of the part outside: positive above the range, negative below, 0 within
    nearest: Feasible | None
    findings: tuple[Finding, ...]

    def best(self) -> Step | None:
        """Return the first rung that fits, if one does."""
        return next((step for step in self.steps if step.fits), None)

    def flattening(self) -> Flattening:
        """Return the flat to build with: of the first rung that fits, else of the one that spreads least."""
        step = self.best() or min(self.steps, key=lambda step: step.spread_ratio)
        return step.flattening

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON, without the arrays."""
        steps = [
            {"rung": step.rung, "spread_ratio": step.spread_ratio, "fits": step.fits, "detail": step.detail}
            for step in self.steps
        ]
        return {
            "limits_ratio": [self.limits.low_ratio, self.limits.high_ratio],
            "fits": self.best() is not None,
            "steps": steps,
            "bound_ratio": self.bound_ratio,
            "proven_infeasible": self.proven_infeasible,
            "outside_faces_count": int(np.count_nonzero(self.excess_log)),
            "nearest_rms_mm": self.nearest.rms_mm if self.nearest else None,
            "nearest_rms_ratio": self.nearest.rms_ratio if self.nearest else None,
            "findings": [finding.as_dict() for finding in self.findings],
        }

    def colors(self, mesh: TriMesh) -> NDArray[np.uint8]:
        """Return a colour per vertex, `(n, 3)`: grey fits, red asks for too much expansion, blue for too little."""
        worst = max(float(np.abs(self.excess_log).max()), 1e-12)
        total = np.bincount(mesh.faces.ravel(), np.repeat(self.excess_log, 3), len(mesh.vertices_mm))
        excess = total / np.maximum(np.bincount(mesh.faces.ravel(), minlength=len(total)), 1) / worst
        # Whatever lies outside at all is to be seen, so colour begins a third of the way.
        depth = np.where(excess == 0, 0, np.sign(excess) * (0.35 + 0.65 * np.abs(excess).clip(0, 1)))[:, None]
        ends = np.where(depth > 0, [200.0, 30, 40], [40.0, 80, 200])
        return np.asarray(190 + (ends - 190) * np.abs(depth), dtype=np.uint8)


def feasibility(
    mesh: TriMesh,
    limits: Limits,
    options: FlattenOptions | None = None,
    remedy: Remedy = "none",
    emit: Emit = lambda _done, _message: None,
) -> FeasibilityReport:
    """Climb the ladder for `mesh`; `remedy` says what to try where no cone-free sheet fits.

    Raises `FlattenError` where the surface cannot be laid flat at all.
    """
    asked = options or FlattenOptions()
    emit(0.0, "global scale")
    steps = [_step("scale", flatten(mesh, replace(asked, cones_count=0)), limits, "only the scale of the flat is free")]
    if not steps[0].fits:
        emit(0.1, "optimising the rim")
        rim = flatten(mesh, replace(asked, boundary="optimised", cones_count=0))
        steps.append(_step("rim", rim, limits, "the rim's scale factors are free"))
    placed = steps[-1].flattening
    scale_ratio = placement(placed.expansion_ratio, mesh.face_areas_mm2(), limits)
    excess_log = outside_log(placed.expansion_ratio / scale_ratio, limits)
    if steps[-1].fits:
        return FeasibilityReport(
            limits, tuple(steps), None, False, scale_ratio, excess_log, None, _verdict(steps, limits)
        )
    emit(0.2, "looking for a proof")
    is_tube = any(seam.closes_tube for seam in placed.seams)
    bound_ratio = _bound(mesh, placed, limits, is_tube)
    proven = bound_ratio is not None and bound_ratio > limits.range_ratio()
    found = [*_verdict(steps, limits), *_where(mesh, excess_log), _proof_finding(bound_ratio, proven, limits, is_tube)]
    if remedy in ("cones", "both"):
        steps += _try_cones(mesh, limits, asked, emit, found)
    seam = replace(asked, seam="tube") if is_tube else asked  # decided: not to be tried as a disk at every stage
    near = _try_nearest(mesh, limits, seam, emit, found) if remedy in ("nearest", "both") else None
    if near is not None:
        detail = f"the surface was moved by {near.rms_mm:.2f} mm RMS ({near.rms_ratio:.2%} of its diagonal)"
        steps.append(_step("nearest", near.flattening, limits, detail))
    return FeasibilityReport(limits, tuple(steps), bound_ratio, proven, scale_ratio, excess_log, near, tuple(found))


def _bound(mesh: TriMesh, placed: Flattening, limits: Limits, is_tube: bool) -> float | None:
    """Return the proven bound, less what this mesh's faces may differ from its scale factors; None without a proof."""
    try:
        bound = proven_bound(mesh, boundary_loops(mesh), limits.cell_mm, is_tube).spread_ratio
    except NotConverged:
        return None
    by_faces = np.log(placed.spread_ratio())
    by_scale_factors = np.ptp(placed.u)
    return float(bound * np.exp(-max(ALLOWANCE_log, abs(by_faces - by_scale_factors))))


def placement(expansion_ratio: Values, areas_mm2: Values, limits: Limits) -> float:
    """Return the factor by which to enlarge the flat so that its expansions lie best in the library's range.

    In the middle where they all fit; else so that the squared excess, over the area, is least.
    """
    logs = np.log(expansion_ratio)
    low, high = np.log(limits.low_ratio), np.log(limits.high_ratio)
    if np.ptp(logs) <= high - low:
        return float(np.exp((logs.max() + logs.min() - low - high) / 2))
    shifts = np.linspace(logs.min() - low, logs.max() - high, 200)
    cost = [np.sum(areas_mm2 * outside_log(np.exp(logs - shift), limits) ** 2) for shift in shifts]
    return float(np.exp(shifts[int(np.argmin(cost))]))


def outside_log(expansion_ratio: Values, limits: Limits) -> Values:
    """Return ln of how far each expansion lies outside the range; negative below it."""
    logs = np.log(expansion_ratio)
    return np.asarray(logs - np.clip(logs, np.log(limits.low_ratio), np.log(limits.high_ratio)))


def _step(rung: Rung, flat: Flattening, limits: Limits, detail: str) -> Step:
    spread = flat.spread_ratio()
    return Step(rung, spread, spread <= limits.range_ratio(), detail, flat)


def _verdict(steps: list[Step], limits: Limits) -> tuple[Finding, ...]:
    last, room = steps[-1], limits.range_ratio()
    text = f"expansions spread by {last.spread_ratio:.3f}, the library by {room:.3f}"
    if not last.fits:
        hint = "cones, the nearest surface that fits, or a flatter target"
        return (Finding("FIT-SPREAD", f"with the best rim {text}", hint=hint),)
    if last.rung == "rim":
        return (
            Finding("FIT-RIM", f"with an optimised rim {text}; by the global scale alone it does not fit", "warning"),
        )
    return (Finding("FIT-SCALE", text, "info"),)


def _where(mesh: TriMesh, excess_log: Values) -> list[Finding]:
    """Say how much of the surface lies outside and where the worst of it is."""
    areas = mesh.face_areas_mm2()
    found = []
    for sign, words in ((1, "too much"), (-1, "too little")):
        out = sign * excess_log > 1e-9
        if out.any():
            worst = int((sign * excess_log).argmax())
            x, y, z = mesh.vertices_mm[mesh.faces[worst]].mean(axis=0)
            share = areas[out].sum() / areas.sum()
            most = np.expm1(abs(excess_log[worst]))
            text = f"{share:.1%} of the surface asks for {words} expansion, by {most:.1%} at most"
            found.append(Finding("FIT-WHERE", text, where=f"face {worst} near ({x:.1f}, {y:.1f}, {z:.1f}) mm"))
    return found


def _proof_finding(bound_ratio: float | None, proven: bool, limits: Limits, is_tube: bool) -> Finding:
    sheet = "sheet with one seam and no cones" if is_tube else "single sheet without cones"
    if bound_ratio is None:
        return Finding("FIT-UNPROVEN", f"not proven: no bound was found on what a {sheet} can do", "warning")
    if proven:
        text = f"proven: no {sheet} can do with less than {bound_ratio:.3f}; the library has {limits.range_ratio():.3f}"
        return Finding("FIT-PROVEN", text)
    text = f"not proven: a {sheet} with a rim of other shape might do with {bound_ratio:.3f}"
    return Finding("FIT-UNPROVEN", text, "warning", hint="more boundary modes may reach it")


def _try_cones(mesh: TriMesh, limits: Limits, options: FlattenOptions, emit: Emit, found: list[Finding]) -> list[Step]:
    """Add cones until the spread fits; return every try that could be laid flat."""
    steps = []
    for count in range(1, MOST_CONES_count + 1):
        emit(0.3 + 0.3 * count / MOST_CONES_count, f"{count} cone(s)")
        try:
            flat = flatten(mesh, replace(options, boundary="optimised", cones_count=count, seam="none"))
        except FlattenError as fault:
            found.append(Finding("FIT-CONES", f"{count} cone(s) cannot be laid flat: {fault.message}", "warning"))
            continue
        steps.append(_step("cones", flat, limits, f"{len(flat.seams)} cone(s), each with a seam to the rim"))
        if steps[-1].fits:
            text = f"{len(flat.seams)} cone(s) bring the spread to {flat.spread_ratio():.3f}"
            found.append(Finding("FIT-CONES", text, "info"))
            return steps
    found.append(Finding("FIT-CONES", f"{MOST_CONES_count} cones are not enough", "warning"))
    return steps


def _try_nearest(
    mesh: TriMesh, limits: Limits, options: FlattenOptions, emit: Emit, found: list[Finding]
) -> Feasible | None:
    try:
        near = closest_feasible(
            mesh,
            limits.range_ratio(),
            replace(options, boundary="optimised", cones_count=0),
            lambda done, message: emit(0.6 + 0.4 * done, message),
        )
    except NotConverged as fault:
        found.append(Finding("FIT-NEAREST", str(fault), "warning"))
        return None
    far = f"{near.rms_mm:.2f} mm RMS away ({near.rms_ratio:.2%} of the diagonal, at most {near.max_mm:.1f} mm)"
    found.append(Finding("FIT-NEAREST", f"a surface {far} fits", "info"))
    return near
