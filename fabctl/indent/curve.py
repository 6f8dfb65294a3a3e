"""What one load–unload curve says: contact, stiffness, peak, snaps, energies, creep, recovery. Pure.

Depth is counted from contact, with the frame's give taken off: d = position − c F − contact. What cannot be found is
None, and `reasons` says why.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fabctl.indent.contact import Contact, find_contact
from fabctl.indent.extremum import vertex
from fabctl.indent.freepart import noise_of_N, without_spikes

Reals = NDArray[np.float64]

LOCAL_MM = 0.35  # half the width of the local fits: some indenter-radius percent, many samples
SMOOTH_MM = 0.6  # over a third of it the force is smoothed to look for extrema
PROMINENCE_SIGMA = 6.0  # a peak must stand out of the noise by so much
SNAP_SIGMA = 8.0  # a snap is a fall of the force between two samples of at least so many noises
SNAP_RATE = 6.0  # and of at least so many times the steepest change elsewhere
FOLLOWED_MM = 0.01  # a stage that went down by so much while holding has followed a force
T95 = 1.96
PRELOADED_SIGMA = 4.0  # a force of so many noises at the method's zero is a preload
ENOUGH_COUNT = 36  # samples of a loading that its figures may rest on


@dataclass(frozen=True, slots=True)
class Strokes:
    """The samples of one curve: loading, holding at the end of it, unloading. Force net of tare.

    `zero_position_mm` and `zero_N` are where a zero step of the method counted depth from, None without one.
    """

    load_position_mm: Reals
    load_N: Reals
    unload_position_mm: Reals
    unload_N: Reals
    hold_time_s: Reals = field(default_factory=lambda: np.zeros(0))
    hold_N: Reals = field(default_factory=lambda: np.zeros(0))
    zero_position_mm: float | None = None
    zero_N: float = 0.0
    hold_position_mm: Reals = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True)
class Valued:
    """A figure with half the width of its 95 % interval."""

    value: float
    ci95: float


@dataclass(frozen=True, slots=True)
class Snap:
    """A jump of the force between two samples: at which depth, by how much."""

    depth_mm: float
    fall_N: float


@dataclass(frozen=True, slots=True)
class CurveResult:
    """What one curve says; None where it says nothing, with the reason under the figure's name in `reasons`."""

    contact: Contact
    spikes_count: int = 0  # single samples that stood out and were left out
    stiffness_initial_N_mm: Valued | None = None
    stiffness_secant_N_mm: Valued | None = None
    stiffness_tangent_max_N_mm: Valued | None = None
    depth_max_mm: float | None = None
    force_max_N: float | None = None
    peak_depth_mm: float | None = None
    peak_N: float | None = None
    valley_depth_mm: float | None = None
    valley_N: float | None = None
    snap_through: Snap | None = None
    snap_back: Snap | None = None
    load_energy_mJ: float | None = None
    unload_energy_mJ: float | None = None
    hysteresis_ratio: float | None = None
    barrier_mJ: float | None = None
    relaxation_ratio: float | None = None
    creep_mm: float | None = None
    creep_ratio: float | None = None
    residual_mm: float | None = None
    recovery_ratio: float | None = None
    reasons: dict[str, str] = field(default_factory=dict)
    depth_mm: Reals = field(default_factory=lambda: np.zeros(0))
    load_N: Reals = field(default_factory=lambda: np.zeros(0))
    unload_depth_mm: Reals = field(default_factory=lambda: np.zeros(0))
    unload_N: Reals = field(default_factory=lambda: np.zeros(0))


def analyse_curve(strokes: Strokes, compliance_mm_N: float = 0.0, secant_mm: float = 2.0) -> CurveResult:
    """Return what the curve says, the frame's `compliance_mm_N` removed from every depth."""
    strokes, spikes_count = _calmed(strokes)
    u = strokes.load_position_mm - compliance_mm_N * strokes.load_N
    contact = _counted_from(u, strokes, compliance_mm_N)
    if contact.position_mm is None:
        return CurveResult(contact, spikes_count=spikes_count, reasons={"contact_mm": contact.reason})
    depth = u - contact.position_mm
    free_N = contact.baseline_N
    load_N = strokes.load_N - free_N - contact.baseline_N_mm * np.minimum(depth, 0.0)
    back = strokes.unload_position_mm - compliance_mm_N * strokes.unload_N - contact.position_mm
    unload_N = strokes.unload_N - free_N
    reasons: dict[str, str] = {}
    found: dict[str, object] = {}
    found |= _stiffness(depth, load_N, contact, secant_mm, reasons)
    found |= _extrema(depth, load_N, contact.noise_N, reasons)
    found |= _snaps(depth, load_N, back, unload_N, contact.noise_N, reasons)
    found |= _energies(depth, load_N, back, unload_N, reasons)
    found |= _barrier(depth, load_N, contact.noise_N, found, reasons)
    found |= _recovery(depth, back, unload_N, contact.noise_N, reasons)
    found |= _held(strokes, free_N, contact.position_mm, compliance_mm_N, reasons)
    return CurveResult(
        contact,
        spikes_count=spikes_count,
        depth_max_mm=float(depth.max()),
        force_max_N=float(load_N.max()),
        reasons=reasons,
        depth_mm=depth,
        load_N=load_N,
        unload_depth_mm=back,
        unload_N=unload_N,
        **found,  # type: ignore[arg-type]
    )


def _calmed(strokes: Strokes) -> tuple[Strokes, int]:
    """Return the strokes without disturbances of single samples, and how many they were."""
    found: list[Reals] = []
    count = 0
    for u, force_N in ((strokes.load_position_mm, strokes.load_N), (strokes.unload_position_mm, strokes.unload_N)):
        noise_N = noise_of_N(u, force_N)[0] if len(u) >= ENOUGH_COUNT else np.inf
        calm_N, more = without_spikes(force_N, noise_N)
        found, count = [*found, calm_N], count + more
    return replace(strokes, load_N=found[0], unload_N=found[1]), count


def _counted_from(u: Reals, strokes: Strokes, compliance_mm_N: float) -> Contact:
    """Return the contact, or where the curve begins under a preload the method's own zero."""
    contact = find_contact(u, strokes.load_N)
    if contact.position_mm is not None or strokes.zero_position_mm is None or len(u) < ENOUGH_COUNT:
        return contact
    noise_N, _ = noise_of_N(u, strokes.load_N)
    if strokes.zero_N < PRELOADED_SIGMA * noise_N:
        return contact
    zero_mm = strokes.zero_position_mm - compliance_mm_N * strokes.zero_N
    return Contact(zero_mm, kind="zero", noise_N=noise_N, start_N=strokes.zero_N)


@dataclass(frozen=True, slots=True)
class Local:
    """Force and slope of a curve at one depth, from a local quadratic fit, with standard errors."""

    force_N: float
    slope_N_mm: float
    force_se_N: float
    slope_se_N_mm: float


def local_fit(depth: Reals, force_N: Reals, at_mm: float, half_mm: float = LOCAL_MM) -> Local | None:
    """Return the local quadratic fit around `at_mm`, or None where fewer than eight samples lie there."""
    inside = np.abs(depth - at_mm) <= half_mm
    x, f = depth[inside] - at_mm, force_N[inside]
    if len(x) < 8 or x.min() > -0.3 * half_mm or x.max() < 0.3 * half_mm:
        return None
    design = np.column_stack([np.ones_like(x), x, x**2])
    weights, *_ = np.linalg.lstsq(design, f, rcond=None)
    residual = f - design @ weights
    variance = float(residual @ residual) / (len(x) - 3)
    covariance = np.linalg.inv(design.T @ design) * variance
    return Local(float(weights[0]), float(weights[1]), float(covariance[0, 0] ** 0.5), float(covariance[1, 1] ** 0.5))


def _stiffness(
    depth: Reals, load_N: Reals, contact: Contact, secant_mm: float, reasons: dict[str, str]
) -> dict[str, object]:
    found: dict[str, object] = {}
    if contact.slope_N_mm is not None and contact.slope_se_N_mm is not None:
        found["stiffness_initial_N_mm"] = Valued(contact.slope_N_mm, T95 * contact.slope_se_N_mm)
    else:
        begins = "the curve begins under a preload" if contact.kind == "zero" else ""
        reasons["stiffness_initial_N_mm"] = begins or "a Hertzian contact begins with slope zero"
    at = local_fit(depth, load_N, secant_mm, min(LOCAL_MM, 0.2 * secant_mm))
    if at is None:
        reasons["stiffness_secant_N_mm"] = f"the loading ends before {secant_mm:g} mm below contact"
    else:
        # An error of the contact moves the depth at which the force is read, and the depth it is divided by.
        rise_N = at.force_N - contact.start_N
        shift = (at.slope_N_mm - rise_N / secant_mm) * (contact.se_mm or 0.0)
        doubt = T95 * float(np.hypot(at.force_se_N, shift)) / secant_mm
        # Whether the drift before contact goes on under load, nobody knows: it widens the interval and stays in.
        found["stiffness_secant_N_mm"] = Valued(rise_N / secant_mm, doubt + abs(contact.drift_N_mm))
    places = np.arange(LOCAL_MM, float(depth.max()) - LOCAL_MM, LOCAL_MM / 2)
    slopes = [fit for place in places if (fit := local_fit(depth, load_N, float(place))) is not None]
    if slopes:
        steepest = max(slopes, key=lambda fit: fit.slope_N_mm)
        found["stiffness_tangent_max_N_mm"] = Valued(steepest.slope_N_mm, T95 * steepest.slope_se_N_mm)
    else:
        reasons["stiffness_tangent_max_N_mm"] = "the loading is too short for a local fit"
    return found


def _extrema(depth: Reals, load_N: Reals, noise_N: float, reasons: dict[str, str]) -> dict[str, object]:
    """Find the first maximum of the loading and the minimum after it, where they stand out of the noise."""
    smooth = _smooth(depth, load_N, SMOOTH_MM / 3)
    loaded = np.flatnonzero(depth > 0)
    if len(loaded) < 20:
        return _none(reasons, "the loading is too short", "peak", "valley")
    band = PROMINENCE_SIGMA * noise_N
    first = _first_maximum(smooth, loaded, band)
    if first is None:
        return _none(reasons, "the force rises to the end of the loading", "peak", "valley")
    peak = vertex(depth, load_N, first)
    found: dict[str, object] = {"peak_depth_mm": peak[0], "peak_N": peak[1]}
    after = np.arange(first, loaded[-1] + 1)
    lowest = int(after[int(np.argmin(smooth[after]))])
    if lowest >= loaded[-1] - 3 or smooth[lowest:].max() - smooth[lowest] < band:
        return found | _none(reasons, "the force falls to the end of the loading", "valley")
    valley = vertex(depth, load_N, lowest)
    return found | {"valley_depth_mm": valley[0], "valley_N": valley[1]}


def _first_maximum(smooth: Reals, loaded: NDArray[np.intp], band: float) -> int | None:
    """Return the first sample that the force falls away from by more than `band` before it rises above it again."""
    best = int(loaded[0])
    for k in loaded:
        if smooth[k] > smooth[best]:
            best = int(k)
        elif smooth[best] - smooth[k] > band:
            return best
    return None


def _snaps(
    depth: Reals, load_N: Reals, back: Reals, unload_N: Reals, noise_N: float, reasons: dict[str, str]
) -> dict[str, object]:
    through = _jump(depth, load_N, noise_N, falling=True)
    again = _jump(back, unload_N, noise_N, falling=False)
    found: dict[str, object] = {}
    if through is None:
        reasons["snap_through"] = "the force never falls at once during loading"
    else:
        found["snap_through"] = through
    if again is None:
        reasons["snap_back"] = "the force never rises at once during unloading"
    else:
        found["snap_back"] = again
    return found


def _jump(depth: Reals, force_N: Reals, noise_N: float, falling: bool) -> Snap | None:
    loaded = depth > 0
    steps = np.diff(force_N) * (-1 if falling else 1)
    steps[~(loaded[1:] & loaded[:-1])] = 0.0
    if len(steps) < 20:
        return None
    k = int(np.argmax(steps))
    others = np.delete(np.abs(steps), slice(max(0, k - 2), k + 3))
    if steps[k] < SNAP_SIGMA * noise_N or steps[k] < SNAP_RATE * float(np.quantile(others, 0.99)):
        return None
    return Snap(float(depth[k]), float(steps[k]))


def _energies(depth: Reals, load_N: Reals, back: Reals, unload_N: Reals, reasons: dict[str, str]) -> dict[str, object]:
    """Return the work done on the specimen on the way in, and given back on the way out, N·mm = mJ."""
    into = _work_mJ(depth, load_N)
    if len(back) < 10:
        return {"load_energy_mJ": into} | _none(reasons, "there is no unloading", "unload_energy", "hysteresis")
    out = -_work_mJ(back, unload_N)
    found: dict[str, object] = {"load_energy_mJ": into, "unload_energy_mJ": out}
    if into > 0:
        found["hysteresis_ratio"] = (into - out) / into
    return found


def _work_mJ(depth: Reals, force_N: Reals) -> float:
    inside = depth > 0
    return float(np.trapezoid(force_N[inside], depth[inside]))


def _barrier(
    depth: Reals, load_N: Reals, noise_N: float, known: dict[str, object], reasons: dict[str, str]
) -> dict[str, object]:
    """Return the energy up to the unstable balance: where, past the peak, the force falls to nothing."""
    peak_mm = known.get("peak_depth_mm")
    if not isinstance(peak_mm, float):
        return _none(reasons, "the force has no maximum: there is nothing to cross", "barrier_mJ")
    past = np.flatnonzero(depth > peak_mm)
    smooth = _smooth(depth, load_N, SMOOTH_MM / 6)
    down = past[smooth[past] <= max(2 * noise_N, 1e-6)]
    if not len(down):
        return _none(reasons, "the force stays above zero: no second stable state under this indenter", "barrier_mJ")
    end_mm = _zero_crossing(depth, load_N, int(down[0]), noise_N)
    inside = (depth > 0) & (depth <= end_mm)
    return {"barrier_mJ": float(np.trapezoid(load_N[inside], depth[inside]))}


def _zero_crossing(depth: Reals, load_N: Reals, near: int, noise_N: float) -> float:
    """Return where a line through the last falling part reaches zero."""
    part = np.arange(max(0, near - 60), near)
    part = part[load_N[part] > 3 * noise_N]
    if len(part) < 6:
        return float(depth[near])
    slope, offset = np.polyfit(depth[part], load_N[part], 1)
    return float(-offset / slope) if slope < 0 else float(depth[near])


def _recovery(depth: Reals, back: Reals, unload_N: Reals, noise_N: float, reasons: dict[str, str]) -> dict[str, object]:
    """Return at what depth the force is gone on the way out, and which share of the stroke came back."""
    if len(back) < 20 or depth.max() <= 0:
        return _none(reasons, "there is no unloading", "residual_mm", "recovery_ratio")
    order = np.argsort(back)
    free = find_contact(back[order], unload_N[order])
    if free.position_mm is None:
        return _none(reasons, f"the end of contact on unloading: {free.reason}", "residual_mm", "recovery_ratio")
    return {"residual_mm": free.position_mm, "recovery_ratio": 1.0 - free.position_mm / float(depth.max())}


def _held(
    strokes: Strokes, free_N: float, contact_mm: float, compliance_mm_N: float, reasons: dict[str, str]
) -> dict[str, object]:
    """Return which share of the force is lost where the stage stands, or how far it follows a force that is kept."""
    count = len(strokes.hold_N)
    if count < 20:
        why = "the method holds nowhere, or too shortly"
        return _none(reasons, why, "relaxation_ratio", "creep_mm", "creep_ratio")
    edge = max(3, count // 50)
    begin, end = (float(np.mean(part)) - free_N for part in (strokes.hold_N[:edge], strokes.hold_N[-edge:]))
    if begin <= 0:
        return _none(reasons, "no force is held", "relaxation_ratio", "creep_mm", "creep_ratio")
    place = strokes.hold_position_mm
    if len(place) != count or place[-1] - place[0] < FOLLOWED_MM:
        _none(reasons, "the stage stood: the force relaxed, nothing crept", "creep_mm", "creep_ratio")
        return {"relaxation_ratio": (begin - end) / begin}
    depth = place - compliance_mm_N * strokes.hold_N - contact_mm
    first, last = float(np.mean(depth[:edge])), float(np.mean(depth[-edge:]))
    _none(reasons, "the force was kept: the specimen crept", "relaxation_ratio")
    return {"creep_mm": last - first, "creep_ratio": (last - first) / first if first > 0 else None}


def _smooth(depth: Reals, force_N: Reals, half_mm: float) -> Reals:
    """Return the running mean of force over ± `half_mm` of stroke; samples are evenly spaced in depth."""
    spacing = float(np.median(np.abs(np.diff(depth)))) or 1e-3
    half = int(np.clip(half_mm / spacing, 1, len(force_N) // 8))
    padded = np.concatenate([np.full(half, force_N[0]), force_N, np.full(half, force_N[-1])])
    return np.convolve(padded, np.full(2 * half + 1, 1 / (2 * half + 1)), "valid")


def _none(reasons: dict[str, str], why: str, *names: str) -> dict[str, object]:
    for name in names:
        reasons[name] = why
    return {}
