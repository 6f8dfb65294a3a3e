"""Runs by name, analysed anew, and groups of them compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fabctl.errors import RecordError, UsageError
from fabctl.events import Emit, Event, silent
from fabctl.indent.analysis import Numbered, analyse, conditioning_curves, read_samples, summarise_run
from fabctl.indent.compare import Ratio, bca, describe, fieller
from fabctl.indent.plot import draw_curves
from fabctl.records.folder import RunFolder, status_of
from fabctl.workspace import SPECIMEN, Workspace

COMPARED = ("stiffness_initial_N_mm", "stiffness_secant_N_mm", "force_max_N", "load_energy_mJ", "barrier_mJ")


def find_runs(lab: Workspace, name: str) -> list[RunFolder]:
    """Return the runs a word means: a run, or all tests of a specimen that hold samples."""
    if not SPECIMEN.fullmatch(name):
        return [lab.run(name)]
    tests = lab.runs_of(name, "indent")
    found = [run for run in tests if (run.path / "samples.csv").is_file() and status_of(run) != "refused"]
    if not found:
        raise UsageError(f"{name} has no test yet; `fabctl indent run {name}` makes one")
    return found


def parse_groups(lab: Workspace, runs: Sequence[str], groups: Sequence[str]) -> dict[str, list[RunFolder]]:
    """Return the named groups; runs outside any group are one each."""
    named = {name: find_runs(lab, name) for name in runs}
    for words in groups:
        name, equals, members = words.partition("=")
        if not equals or not members:
            raise UsageError(f"--group {words!r}: write NAME=RUN,RUN,…")
        named[name] = [run for member in members.split(",") for run in find_runs(lab, member)]
    return named


def analyse_groups(
    named: Mapping[str, Sequence[RunFolder]], picture: Path | None = None, emit: Emit = silent
) -> dict[str, Any]:
    """Return every run's figures, every group's spread, and the ratio of each group to the last."""
    body: dict[str, Any] = {"groups": {}, "ratios": []}
    values: dict[str, dict[str, list[float]]] = {}
    for name, runs in named.items():
        results = [_renewed(run, emit) for run in runs]
        values[name] = _by_specimen(runs, results)
        entries = [
            {"run": run.run_id, "status": status_of(run), "result": result}
            for run, result in zip(runs, results, strict=True)
        ]
        body["groups"][name] = {"runs": entries, **_spreads(name, values[name])}
    *others, last = named
    for name in others:
        body["ratios"] += _ratios(name, values[name], last, values[last])
    if picture is not None:
        drawn = draw_curves({name: [n for run in runs for n in _curves(run)] for name, runs in named.items()}, picture)
        body["picture"] = str(picture) if drawn else None
    return body


def _renewed(run: RunFolder, emit: Emit) -> dict[str, Any]:
    """Analyse a run anew; what a finished run noted beside its figures is kept."""
    emit(Event("stage", f"analysing {run.run_id}"))
    body = {**(run.result() or {}), **summarise_run(run)}
    if run.outcome() is not None:
        run.write_result(body)
    return body


def _by_specimen(runs: Sequence[RunFolder], results: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """Return one value a specimen and figure: several runs of one specimen are not several specimens."""
    found: dict[str, list[float]] = {}
    for figure in COMPARED:
        own: dict[str, list[float]] = {}
        for run, result in zip(runs, results, strict=True):
            if result.get(figure) is not None:
                own.setdefault(str(run.manifest().get("specimen") or run.run_id), []).append(float(result[figure]))
        found[figure] = [float(np.mean(each)) for each in own.values()]
    return found


def _spreads(name: str, values: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    return {f: asdict(describe(name, each)) for f, each in values.items() if len(each) >= 2}


def _ratios(
    above: str, a: Mapping[str, Sequence[float]], below: str, b: Mapping[str, Sequence[float]]
) -> list[dict[str, Any]]:
    found = []
    for figure in COMPARED:
        if not a[figure] or not b[figure]:
            continue
        if min(len(a[figure]), len(b[figure])) < 2:
            found.append({"figure": figure, "above": above, "below": below, **asdict(_bare(a[figure], b[figure]))})
            continue
        for ratio in (fieller(a[figure], b[figure]), bca(a[figure], b[figure], np.random.default_rng(1))):
            found.append({"figure": figure, "above": above, "below": below, **asdict(ratio)})
    return found


def _bare(above: Sequence[float], below: Sequence[float]) -> Ratio:
    """Return a ratio without an interval, and why it has none."""
    reason = f"{len(above)} and {len(below)} specimens; an interval needs at least two of each"
    return Ratio(float(np.mean(above) / np.mean(below)), None, None, 0.95, "means", reason)


def _curves(run: RunFolder) -> list[Numbered]:
    config = run.manifest().get("config", {})
    calibration = config.get("calibration") or {}
    skipped = set(conditioning_curves(run.manifest()))
    try:
        samples = read_samples(run.path / "samples.csv")
    except RecordError:
        return []
    found = analyse(
        samples,
        float(calibration.get("compliance_mm_N") or 0.0),
        float(config.get("method", {}).get("secant_mm", 2.0)),
        float(calibration.get("gain_ratio") or 1.0),
    )
    return [n for n in found if (n.point, n.curve) not in skipped]
