"""A coupon on its specimen's page: measured expansions and open-close cycles against the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fabctl.records.folder import RunFolder, status_of
from fabctl.reports.indent_step import as_svg
from fabctl.reports.model import Fact, Figure, Step, Word
from fabctl.reports.numbers import with_half


def coupon_step(run: RunFolder) -> Step:
    """Return the part about a coupon's filled form."""
    result = run.result() or {}
    patches = result.get("patches", [])
    facts = tuple(_fact(patch) for patch in patches)
    figures = (plot(patches),) if patches else ()
    notes = tuple(f"patch {name}: not measured" for name in result.get("missing", []))
    cycles = sum(patch["cycles_count"] for patch in patches)
    summary = f"{len(patches)} patches measured, opened and closed {cycles} times altogether."
    return Step("Coupon", status_of(run), summary, facts, figures, notes)


def _fact(patch: Mapping[str, Any]) -> Fact:
    value = with_half(patch["expansion_ratio"], patch["uncertainty_ratio"])
    expected, off = patch["expected_ratio"], patch["off_ratio"]
    told = "the map: springs back" if expected is None else f"the map says {expected:.4f}: {off:+.4f} off"
    torn = patch["failed_at_count"]
    ended = (
        f"torn at cycle {torn} of {patch['cycles_count']}" if torn is not None else f"{patch['cycles_count']} cycles"
    )
    return Fact(f"{patch['patch']}, hinge {patch['hinge_mm']:.3f} mm", value, f"{told}; {ended}")


def coupon_verdict(run: RunFolder | None, cut: RunFolder | None) -> tuple[Word, str, list[str]]:
    """Return whether the map holds on this sheet, one sentence, and the reasons against a pass."""
    if cut is None or status_of(cut) != "done" or run is None:
        missing = [] if cut is not None and status_of(cut) == "done" else ["cut: not done yet"]
        unread = ["coupon: its form is not read yet (fabctl design coupon-read)"] if run is None else []
        return "incomplete", "Not every step has a result.", missing + unread
    result = run.result() or {}
    off = [patch for patch in result["patches"] if not patch["agrees"]]
    reasons = [
        f"patch {p['patch']}, hinge {p['hinge_mm']:.3f} mm: {p['off_ratio']:+.4f} off the map, more than its "
        f"uncertainty of {p['uncertainty_ratio']:.4f}"
        for p in off
    ]
    if off:
        return "fail", f"{len(off)} of {len(result['patches'])} patches do not expand as the map says.", reasons
    if result.get("missing"):
        return "incomplete", "Not every patch was measured.", [f"patch {name}" for name in result["missing"]]
    return "pass", "Every patch expands as the map says, within its uncertainty.", []


def plot(patches: Sequence[Mapping[str, Any]]) -> Figure:
    """Return measured and expected expansion, and the cycles, against the hinge, as SVG in the page."""
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=(6.2, 4.6), layout="constrained")
    above, below = canvas.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    hinge = [patch["hinge_mm"] for patch in patches]
    known = [patch for patch in patches if patch["expected_ratio"] is not None]
    above.plot([p["hinge_mm"] for p in known], [p["expected_ratio"] for p in known], "o-", color="#c8502d", mfc="none",
               label="the map (finite elements)")  # fmt: skip
    above.errorbar(hinge, [p["expansion_ratio"] for p in patches], [p["uncertainty_ratio"] for p in patches], fmt="o",
                   color="#0b6e99", capsize=3, label="measured, 95 %")  # fmt: skip
    above.set_ylabel("expansion, deployed over flat")
    above.legend(frameon=False)
    torn = [patch["failed_at_count"] is not None for patch in patches]
    width = 0.3 * min((b - a for a, b in zip(sorted(hinge), sorted(hinge)[1:], strict=False)), default=0.05)
    colours = ["#c8502d" if is_torn else "#9bb7c9" for is_torn in torn]
    counts = [p["cycles_count"] if p["failed_at_count"] is None else p["failed_at_count"] for p in patches]
    below.bar(hinge, counts, max(width, 0.005), color=colours)
    below.set(xlabel="hinge [mm]", ylabel="cycles")
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    caption = "Expansion against hinge width, and open-close cycles without tearing (red: torn at that cycle)."
    return Figure(as_svg(canvas), caption, True)
