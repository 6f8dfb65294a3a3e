"""Two designs side by side."""

from __future__ import annotations

from typing import Any

from design.bundle import Bundle


def compare(a: Bundle, b: Bundle) -> dict[str, Any]:
    """Return the facts of both designs, what B has over A, and how far cells at the same place differ."""
    facts_a, facts_b = a.manifest["facts"], b.manifest["facts"]
    numbers = [key for key in facts_a if isinstance(facts_a[key], int | float) and key in facts_b]
    ratios = {key: facts_b[key] / facts_a[key] for key in numbers if facts_a[key]}
    found: dict[str, Any] = {"a": dict(facts_a), "b": dict(facts_b), "b_over_a_ratio": ratios}
    found["same_files"] = sorted(name for name, d in a.manifest["files"].items() if b.manifest["files"].get(name) == d)
    found["same_library"] = a.manifest["library"] == b.manifest["library"]
    rows_a, rows_b = ({(row["cx_mm"], row["cy_mm"]): row for row in bundle.cells()} for bundle in (a, b))
    shared = sorted(rows_a.keys() & rows_b.keys())
    found["cells_at_the_same_place_count"] = len(shared)
    for name in ("t_mm", "theta_deg", "expansion_ratio", "hinge_mm") if shared else ():
        gap = [abs(float(rows_a[place][name]) - float(rows_b[place][name])) for place in shared]
        found[f"largest_difference_{name}"] = max(gap)
    return found
