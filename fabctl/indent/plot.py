"""Force against displacement, loading and unloading, as the paper's Fig. 4 shows its two caps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from fabctl.indent.analysis import Numbered

COLOURS = ("#0b6e99", "#c8502d", "#5b7f2b", "#7a4fa3", "#8a6d1f", "#444c55")
DASHES = (0, (5, 4))  # wide enough to be seen as such where several curves lie on each other


def draw_curves(groups: Mapping[str, Sequence[Numbered]], path: Path) -> bool:
    """Draw every curve with a contact, one colour a group, solid in and dashed out; False where there is none."""
    drawn = {name: [n for n in found if len(n.result.depth_mm)] for name, found in groups.items()}
    if not any(drawn.values()):
        return False
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for colour, (name, found) in zip(COLOURS * len(drawn), drawn.items(), strict=False):
        for k, n in enumerate(found):
            result = n.result
            label = f"{name} ({len(found)} curve{'s' * (len(found) > 1)})" if k == 0 else None
            axes.plot(result.depth_mm, result.load_N, color=colour, lw=1.2, label=label)
            axes.plot(result.unload_depth_mm, result.unload_N, color=colour, lw=0.8, ls=DASHES, alpha=0.7)
            if result.peak_depth_mm is not None and result.peak_N is not None:
                axes.plot(result.peak_depth_mm, result.peak_N, "v", color=colour, ms=5)
    axes.set_xlabel("displacement [mm]")
    axes.set_ylabel("force [N]")
    axes.axhline(0, color="#999", lw=0.6)
    axes.axvline(0, color="#999", lw=0.6)
    axes.margins(x=0.02)
    axes.legend(frameon=False, title="solid: loading, dashed: unloading", title_fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    return True
