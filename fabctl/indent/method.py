"""From a method to a flat list of actions, and everything that speaks against it. Pure: nothing moves here."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.config.bench import RigConfig
from fabctl.config.method import (
    Approach,
    Cycles,
    Grid,
    Hold,
    Load,
    MethodConfig,
    Preload,
    Simple,
    Tare,
    Unload,
    Wait,
    Zero,
)
from fabctl.errors import UsageError
from fabctl.files import text_of

Kind = Literal["tare", "approach", "preload", "zero", "load", "hold", "unload", "wait", "travel"]


@dataclass(frozen=True, slots=True)
class Action:
    """One thing the stage does. `curve` numbers the load–unload pairs of a point from 1; 0 is none of them."""

    kind: Kind
    speed_mm_s: float = 0.0
    depth_mm: float | None = None
    force_N: float | None = None
    time_s: float = 0.0
    clearance_mm: float = 0.0
    travel_mm: float | None = None
    message: str = ""
    curve: int = 0
    condition: bool = False
    point: int = 0
    at_mm: tuple[float, float] | None = None


def actions(method: MethodConfig) -> tuple[Action, ...]:
    """Return what the stage does, one after the other."""
    found: list[Action] = []
    for step in method.steps:
        if isinstance(step, Grid):
            for y_mm in step.y_mm:
                for x_mm in step.x_mm:
                    point = max((a.point for a in found), default=0) + 1
                    found.append(Action("travel", step.speed_mm_s, point=point, at_mm=(x_mm, y_mm)))
                    inner = _numbered([a for s in step.steps for a in _expanded(s)])
                    found += [replace(a, point=point) for a in inner]
        else:
            found += _expanded(step)
    outer = _numbered([a for a in found if a.point == 0])
    numbered = iter(outer)
    return tuple(next(numbered) if a.point == 0 else a for a in found)


def _expanded(step: Simple) -> Iterator[Action]:
    if isinstance(step, Tare):
        yield Action("tare", time_s=step.time_s)
    elif isinstance(step, Approach):
        yield Action(
            "approach",
            step.speed_mm_s,
            force_N=step.trigger_N,
            clearance_mm=step.clearance_mm,
            travel_mm=step.travel_mm,
        )
    elif isinstance(step, Preload):
        yield Action("preload", step.speed_mm_s, force_N=step.force_N, time_s=step.time_s)
    elif isinstance(step, Zero):
        yield Action("zero")
    elif isinstance(step, Load):
        yield Action("load", step.speed_mm_s, step.depth_mm, step.force_N, curve=-1)
    elif isinstance(step, Unload):
        yield Action("unload", step.speed_mm_s, step.depth_mm, step.force_N, curve=-2)
    elif isinstance(step, Hold):
        speed = step.speed_mm_s if step.force_N is not None else 0.0
        yield Action("hold", speed, force_N=step.force_N, time_s=step.time_s, curve=-2)
    elif isinstance(step, Wait):
        yield Action("wait", message=step.message)
    else:
        yield from _cycles(step)


def _cycles(step: Cycles) -> Iterator[Action]:
    for _ in range(step.cycles_count):
        yield Action("load", step.speed_mm_s, step.depth_mm, step.force_N, curve=-1, condition=step.condition)
        if step.hold_s:
            yield Action("hold", time_s=step.hold_s, curve=-2, condition=step.condition)
        yield Action("unload", step.unload_speed_mm_s or step.speed_mm_s, curve=-2, condition=step.condition)
        if step.rest_s:
            yield Action("hold", time_s=step.rest_s)


def _numbered(found: Sequence[Action]) -> list[Action]:
    """Number the curves: every loading begins one, what belongs to it follows."""
    numbered: list[Action] = []
    curve = 0
    for action in found:
        curve += action.curve == -1
        rests = action.kind == "hold" and bool(numbered) and numbered[-1].kind == "unload"
        numbered.append(replace(action, curve=curve if action.curve and not rests else 0))
    return numbered


@dataclass(frozen=True, slots=True)
class Predicted:
    """The design's own response of the specimen: load over depth from first contact."""

    depth_mm: NDArray[np.float64]  # (k,)
    load_N: NDArray[np.float64]  # (k,)
    indenter_radius_mm: float | None = None

    def peak_N(self, depth_mm: float) -> float:
        """Return the greatest load up to `depth_mm`, the last one held beyond the prediction's end."""
        inside = self.depth_mm <= depth_mm
        return float(max(self.load_N[inside].max(initial=0.0), np.interp(depth_mm, self.depth_mm, self.load_N)))

    def secant_N_mm(self, depth_mm: float) -> float:
        """Return the predicted secant stiffness to `depth_mm`."""
        return float(np.interp(depth_mm, self.depth_mm, self.load_N) - self.load_N[0]) / depth_mm


def read_predicted(path: Path) -> Predicted:
    """Return a design's `response.csv`; raise `UsageError` where it is not one."""
    try:
        lines = text_of(path, "a design's response.csv").splitlines()
        rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
        depth = np.array([float(row["depth_mm"]) for row in rows])
        load = np.array([float(row["load_N"]) for row in rows])
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError(f"{path}: not a response of a design: no numbers under depth_mm and load_N") from fault
    if not lines or not lines[0].startswith("# fabctl response 1") or len(depth) < 2:
        raise UsageError(f"{path}: not a response of version 1")
    facts = dict(part.strip().split("=", 1) for part in lines[0].split(";")[1:] if "=" in part)
    radius = facts.get("indenter_radius_mm")
    return Predicted(depth, load, float(radius) if radius else None)


def time_s(plan: Sequence[Action], travel_speed_mm_s: float, approach_mm: float = 10.0) -> float:
    """Return about how long the plan takes; waiting for the operator counts nothing."""
    return sum(times_s(plan, travel_speed_mm_s, approach_mm))


def times_s(plan: Sequence[Action], travel_speed_mm_s: float, approach_mm: float = 10.0) -> list[float]:
    """Return about how long each action takes."""
    found, depth_mm, clearance_mm = [], 0.0, 1.0
    for action in plan:
        own = action.time_s + 0.1
        if action.kind == "approach":
            clearance_mm = action.clearance_mm
            own += approach_mm / action.speed_mm_s + clearance_mm / action.speed_mm_s
            depth_mm = -clearance_mm
        elif action.kind in ("load", "unload", "preload"):
            goal = (
                action.depth_mm if action.depth_mm is not None else (-clearance_mm if action.kind == "unload" else 2.0)
            )
            own += abs(goal - depth_mm) / action.speed_mm_s
            depth_mm = goal
        elif action.kind == "travel":
            own += 2 * approach_mm / travel_speed_mm_s + 15 / action.speed_mm_s
        found.append(own)
    return found


def check(
    plan: Sequence[Action],
    method: MethodConfig,
    rig: RigConfig,
    predicted: Predicted | None,
    has_stage: bool = True,
) -> list[Finding]:
    """Return everything that speaks against running `plan` on this rig with this specimen."""
    found = list(_order(plan))
    if method.limits.force_N > rig.force_limit_N:
        found.append(
            Finding(
                "METHOD-FORCE",
                f"the method's limit {method.limits.force_N:g} N is above the bench's {rig.force_limit_N:g} N",
                where="limits.force_N",
                value=method.limits.force_N,
                unit="N",
                limit=rig.force_limit_N,
            )
        )
    if method.limits.travel_mm > rig.travel_mm:
        found.append(
            Finding(
                "METHOD-TRAVEL",
                f"the method's travel {method.limits.travel_mm:g} mm is longer than the rig's {rig.travel_mm:g} mm",
                where="limits.travel_mm",
                value=method.limits.travel_mm,
                unit="mm",
                limit=rig.travel_mm,
            )
        )
    if method.safe_height_mm >= method.limits.travel_mm:
        found.append(_beyond("METHOD-SAFE-HEIGHT", "the safe height", method.safe_height_mm, method))
    deepest_mm = max((a.depth_mm for a in plan if a.depth_mm is not None), default=0.0)
    if deepest_mm > method.limits.travel_mm:
        found.append(_beyond("METHOD-DEPTH", "the greatest depth", deepest_mm, method))
    clearance_mm = max((a.clearance_mm for a in plan), default=0.0)
    if clearance_mm > method.limits.travel_mm:
        found.append(_beyond("METHOD-CLEARANCE", "the clearance of the approach", clearance_mm, method))
    if any(action.kind == "travel" for action in plan) and not has_stage:
        found.append(Finding("METHOD-STAGE", "the method has a grid, and this rig's map has no stage to move"))
    for action in plan:
        if action.force_N is not None and action.force_N >= method.limits.force_N:
            found.append(
                Finding(
                    "METHOD-STEP-FORCE",
                    f"{action.kind} to {action.force_N:g} N reaches the limit of {method.limits.force_N:g} N",
                    hint="the limit acts on the untared force; leave room",
                    value=action.force_N,
                    unit="N",
                    limit=method.limits.force_N,
                )
            )
    loads = [a for a in plan if a.kind == "load"]
    deepest = max((a.depth_mm for a in loads if a.depth_mm is not None), default=None)
    if deepest is not None and deepest <= method.secant_mm and all(a.force_N is None for a in loads):
        text = f"the secant is to {method.secant_mm:g} mm, the method loads to {deepest:g} mm: it will not be found"
        found.append(Finding("METHOD-SECANT", text, "warning", hint="load deeper, or give a smaller secant_mm"))
    if predicted is None:
        found.append(Finding("METHOD-NO-PREDICTION", "no predicted response to check the method against", "warning"))
    else:
        found += _out_of_reach(plan, predicted)
        found += _against(predicted, deepest, method, rig) if deepest is not None else ()
    return found


def _against(predicted: Predicted, deepest_mm: float, method: MethodConfig, rig: RigConfig) -> Iterator[Finding]:
    peak_N = predicted.peak_N(deepest_mm)
    if peak_N >= method.limits.force_N:
        yield Finding(
            "METHOD-PREDICTED-FORCE",
            f"pressed to {deepest_mm:g} mm the specimen is predicted to answer with {peak_N:.2f} N, "
            f"the limit is {method.limits.force_N:g} N",
            hint="load less deep, or raise limits.force_N",
            value=peak_N,
            unit="N",
            limit=method.limits.force_N,
        )
    if deepest_mm > predicted.depth_mm[-1]:
        yield Finding(
            "METHOD-BEYOND-PREDICTION",
            f"the prediction ends at {predicted.depth_mm[-1]:g} mm, the method goes to {deepest_mm:g} mm",
            "warning",
        )
    radius = predicted.indenter_radius_mm
    if radius is not None and abs(radius - rig.indenter_radius_mm) > 0.01 * radius:
        yield Finding(
            "METHOD-INDENTER",
            f"predicted for a sphere of {radius:g} mm, on the rig is one of {rig.indenter_radius_mm:g} mm",
            "warning",
        )


def _beyond(code: str, what: str, value_mm: float, method: MethodConfig) -> Finding:
    limit_mm = method.limits.travel_mm
    text = f"{what}, {value_mm:g} mm, lies beyond the method's travel of {limit_mm:g} mm"
    return Finding(code, text, value=value_mm, unit="mm", limit=limit_mm)


def _out_of_reach(plan: Sequence[Action], predicted: Predicted) -> Iterator[Finding]:
    """Say which forces the specimen is predicted never to answer with: the stage would go on to its travel's end."""
    most_N = float(predicted.load_N.max())
    for kind, force_N in sorted({(a.kind, a.force_N) for a in plan if a.force_N is not None and a.kind != "unload"}):
        if force_N > most_N:
            yield Finding(
                "METHOD-OUT-OF-REACH",
                f"{kind} to {force_N:g} N: down to {predicted.depth_mm[-1]:g} mm the specimen is predicted to answer "
                f"with {most_N:.3g} N at most",
                "warning",
                hint="a smaller force, or a depth instead",
            )


def _order(plan: Sequence[Action]) -> Iterator[Finding]:
    """Say where a step needs another before it."""
    tared = found_contact = pressed = touching = False
    for k, action in enumerate(plan):
        where = f"step {k + 1} ({action.kind})"
        if action.kind == "travel":
            tared = found_contact = False
        if action.kind == "tare":
            tared = True
        elif action.kind == "approach":
            found_contact = True
            if not tared:
                yield Finding(
                    "METHOD-TARE", "an approach without a tare before it", where=where, hint="add {step: tare}"
                )
        elif action.kind in ("load", "preload", "zero", "unload") and not found_contact:
            yield Finding("METHOD-APPROACH", "no contact is known here", where=where, hint="add {step: approach}")
        if action.kind == "tare" and touching:
            text = "a tare while the specimen is pressed would take its force for zero"
            yield Finding("METHOD-TARE-PRESSED", text, where=where, hint="unload before it")
        if action.kind == "hold" and action.force_N is not None and not touching:
            text = f"{action.force_N:g} N are to be held where nothing is pressed"
            yield Finding("METHOD-HOLD", text, where=where, hint="load to that force before it")
        touching = _touches(action, touching)
        if action.kind == "load" and pressed:
            text = "this curve begins under a preload: without a zero after it nothing can be counted from contact"
            yield Finding("METHOD-PRELOAD", text, "warning", where=where, hint="add {step: zero} after the preload")
        pressed = action.kind == "preload" or (pressed and action.kind in ("hold", "wait", "tare"))


def _touches(action: Action, before: bool) -> bool:
    """Tell whether the indenter stands in contact after an action; `before` is how it stood."""
    if action.kind in ("load", "preload"):
        return True
    if action.kind == "unload":
        return action.depth_mm is not None or action.force_N is not None
    return before and action.kind not in ("approach", "travel")
