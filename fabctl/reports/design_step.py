"""The design and the cut on a specimen's page."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from fabctl.records.folder import RunFolder, status_of
from fabctl.records.words import is_simulated
from fabctl.reports.model import Fact, Figure, Step, picture

PATTERN = "The pattern as it is cut, coloured by what each cell expands by"
CAPTIONS = {
    "": f"{PATTERN}.",
    "predicted": f"{PATTERN}; beside it the deployed shape and the force under an indenter, as predicted.",
    "coupon": f"{PATTERN}, and the notches between which each patch is measured.",
}


def design_step(design: Path) -> Step:
    """Return the part about the design folder."""
    cells = _rows(design / "cells.csv")
    findings = _findings(design / "findings.json")
    expansions = [float(row["expansion_ratio"]) for row in cells]
    hinges = [float(row["hinge_mm"]) for row in cells]
    facts = [Fact("cells", str(len(cells)))]
    if expansions:
        facts.append(Fact("expansion", _range(min(expansions), max(expansions)), "deployed over flat length"))
        facts.append(Fact("hinges", _range(min(hinges), max(hinges), "mm")))
    sheet = _paths(design / "paths.json").get("sheet_mm")
    if sheet:
        facts.append(Fact("sheet", f"{sheet[0]:.1f} × {sheet[1]:.1f} mm"))
    figures: tuple[Figure, ...] = ()
    coupon, predicted = "coupon" * (design / "coupon.yaml").is_file(), "predicted" * (design / "deployed.ply").is_file()
    if (design / "preview.png").is_file():
        figures = (picture(design / "preview.png", CAPTIONS[coupon or predicted], wide=True),)
    notes = tuple(f"{f['level']}: {f['message']}" for f in findings if f.get("level") != "info")
    return Step("Design", "done", f"{len(cells)} bistable cells laid out flat.", tuple(facts), figures, notes)


def cut_step(run: RunFolder) -> Step:
    """Return the part about the cut."""
    result, manifest = run.result() or {}, run.manifest()
    material, made_up = manifest.get("config", {}).get("material", {}), bool(is_simulated(manifest))
    facts = [Fact("material", str(material.get("name", "?")), f"{material.get('thickness_mm', '?')} mm thick")]
    if "burnt_mm" in result:
        facts.append(Fact("burnt", f"{result['burnt_mm'] / 1000:.2f} m", f"{result['lines_count']} lines of G-code"))
    if "actual_s" in result:
        quick = ", for a real laser; a simulated one runs faster" if made_up else ""
        facts.append(Fact("time", f"{result['actual_s']:.0f} s", f"estimated {result['estimate_s']:.0f} s{quick}"))
    if "firmware" in result:
        facts.append(Fact("board", str(result["firmware"])))
    if "job_sha256" in result:
        facts.append(Fact("program", str(result["job_sha256"])[:16], "sha256"))
    outcome = run.outcome() or {}
    notes = tuple(f"{f['level']}: {f['message']}" for f in result.get("findings", []))
    said = str(
        outcome.get("message") or "Cut to the end." if outcome.get("status") == "done" else "Not cut to the end."
    )
    return Step("Cut", status_of(run), said, tuple(facts), (), notes, made_up)


def _range(low: float, high: float, unit: str = "") -> str:
    told = f"{low:.3f} to {high:.3f}" if f"{low:.3f}" != f"{high:.3f}" else f"{low:.3f}"
    return f"{told} {unit}".strip()


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(line for line in stream if not line.startswith("#")))


def _paths(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def _findings(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    found = json.loads(path.read_text(encoding="utf-8"))
    return list(found["findings"] if isinstance(found, dict) else found)
