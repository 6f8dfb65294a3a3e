"""Two designs side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from design.bundle import Bundle

# What a person reads: the fact, what it is called, what it is multiplied by, and its format.
ROWS: tuple[tuple[str, str, float, str], ...] = (
    ("cells_count", "cells", 1, ".0f"),
    ("cell_mm", "cell edge, mm", 1, ".3g"),
    ("sheet_width_mm", "sheet width, mm", 1, ".1f"),
    ("sheet_height_mm", "sheet height, mm", 1, ".1f"),
    ("sheets_count", "sheets", 1, ".0f"),
    ("expansion_low_ratio", "least expansion", 1, ".4f"),
    ("expansion_high_ratio", "greatest expansion", 1, ".4f"),
    ("cut_mm", "cut, m", 1e-3, ".2f"),
    ("travel_mm", "travel, m", 1e-3, ".2f"),
    ("cut_time_s", "cutting time, min", 1 / 60, ".1f"),
    ("deviation_mean_mm", "off the target, mean, mm", 1, ".3f"),
    ("deviation_max_mm", "off the target, largest, mm", 1, ".3f"),
    ("stiffness_2mm_N_mm", "stiffness to 2 mm, N/mm", 1, ".4f"),
)
GAPS: tuple[tuple[str, str, str], ...] = (
    ("t_mm", "t", " mm"),
    ("theta_deg", "θ", "°"),
    ("expansion_ratio", "expansion", ""),
    ("hinge_mm", "hinge", " mm"),
)


def compare(a: Bundle, b: Bundle) -> dict[str, Any]:
    """Return the facts of both designs, what B has over A, and how far cells at the same place differ."""
    facts_a, facts_b = _facts(a), _facts(b)
    numbers = [key for key in facts_a if isinstance(facts_a[key], int | float) and key in facts_b]
    ratios = {key: facts_b[key] / facts_a[key] for key in numbers if facts_a[key]}
    found: dict[str, Any] = {"a": facts_a, "b": facts_b, "b_over_a_ratio": ratios}
    found["same_files"] = sorted(name for name, d in a.manifest["files"].items() if b.manifest["files"].get(name) == d)
    found["same_library"] = a.manifest["library"] == b.manifest["library"]
    rows_a, rows_b = ({(row["cx_mm"], row["cy_mm"]): row for row in bundle.cells()} for bundle in (a, b))
    shared = sorted(rows_a.keys() & rows_b.keys())
    found["cells_at_the_same_place_count"] = len(shared)
    for name, _, _ in GAPS if shared else ():
        gap = [abs(float(rows_a[place][name]) - float(rows_b[place][name])) for place in shared]
        found[f"largest_difference_{name}"] = max(gap)
    return found


def _facts(bundle: Bundle) -> dict[str, Any]:
    facts = dict(bundle.manifest["facts"])
    facts["sheet_width_mm"], facts["sheet_height_mm"] = facts["sheet_mm"]
    return facts | {"sheets_count": len(facts.get("sheets_mm", [facts["sheet_mm"]]))}


def compared_lines(found: Mapping[str, Any]) -> Iterator[str]:
    """Return a comparison as a table with units; a dash where a design has no such number."""
    yield f"{'':28}{'A':>12}{'B':>12}{'B over A':>12}"
    for key, name, factor, form in ROWS:
        sides = [found[side].get(key) for side in ("a", "b")]
        if any(side is not None for side in sides):
            told = "".join(f"{'–' if side is None else format(factor * side, form):>12}" for side in sides)
            ratio = found["b_over_a_ratio"].get(key)
            yield f"{name:28}{told}{'–' if ratio is None else format(ratio, '.3f'):>12}"
    yield "both from the same library" if found["same_library"] else "from different libraries of cells"
    shared = found["cells_at_the_same_place_count"]
    if not shared:
        yield "no cells lie at the same place in both"
        return
    gaps = [f"{name} {found[f'largest_difference_{key}']:.3g}{unit}" for key, name, unit in GAPS]
    yield f"{shared} cells lie at the same place in both; they differ by at most {', '.join(gaps)}"
