"""What must be said about an alignment: why there is none, what else fits, which side is shown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from design.findings import Finding
from fabctl.scan.clean import Cleaned, Part
from fabctl.scan.judge import Judged
from fabctl.scan.symmetry import Symmetries
from fabctl.scan.target import Target

LIKE_SIZE_RATIO = 0.5  # of the specimen's cells; a cluster that large may be another specimen
UNLIKE_SIZE_RATIO = 5.0  # no scan of the target is as much larger or smaller

Status = Literal["aligned", "symmetric", "ambiguous", "failed", "mirrored"]


def left_aside(cleaned: Cleaned, part: Part) -> Iterator[Finding]:
    """Yield a warning where the scan holds another thing about as large as the one compared."""
    sizes = np.bincount(cleaned.cluster[cleaned.cluster >= 0])
    taken = np.bincount(cleaned.cluster[(cleaned.cluster >= 0) & part.cells], minlength=len(sizes))
    if len(sizes) == 0 or "plane kept" in part.name:
        return
    others = np.flatnonzero((taken == 0) & (sizes > LIKE_SIZE_RATIO * taken.max()))
    if len(others):
        yield Finding(
            "SCAN-OTHERS",
            f"{len(others)} more thing(s) of about the specimen's size lie in the scan and were not compared",
            level="warning",
            hint="if there are several specimens, cut the cloud apart and compare each",
        )


def _why_no_fit(best: Judged, cleaned: Cleaned, part: Part, target: Target) -> str:
    across_mm = best.pose.scale_ratio * float(np.linalg.norm(np.ptp(cleaned.cells.centre[part.cells], axis=0)))
    if 1 / UNLIKE_SIZE_RATIO < across_mm / target.diagonal_mm < UNLIKE_SIZE_RATIO:
        return "is it the right target and cloud, and is the specimen's own cloud large enough?"
    return (
        f"in this pose the cloud measures {across_mm:.3g} mm across, the target {target.diagonal_mm:.3g} mm; "
        "with --scale known: is --unit-mm right?"
    )


def findings_of(
    status: Status,
    best: Judged,
    alternatives: tuple[Judged, ...],
    part: Part,
    cleaned: Cleaned,
    symmetries: Symmetries,
    target: Target,
) -> Iterator[Finding]:
    """Yield what must be said about an alignment that ended with `status`."""
    if status == "failed":
        yield Finding(
            "SCAN-NO-FIT",
            f"no pose explains the cloud: the best leaves {best.score_frac:.2%} of the diagonal (rms), covers "
            f"{best.coverage_frac:.0%} of the target and explains {best.explained_frac:.0%} of the points",
            hint=_why_no_fit(best, cleaned, part, target),
        )
    if status == "mirrored":
        yield Finding(
            "SCAN-MIRROR",
            f"the cloud is the mirror image of the target (fits to {best.score_frac:.2%} of the diagonal): the "
            "specimen was deployed to the other side, or cut from the mirrored pattern",
            hint="snap it to the other side, or compare with the mirrored target",
        )
    if status == "ambiguous":
        worst = max(a.score_frac for a in alternatives) / best.score_frac - 1
        yield Finding(
            "SCAN-AMBIGUOUS",
            f"{len(alternatives)} other poses fit within {worst:.1%} of the best; geometry cannot decide",
            hint="give three datum points (--datum), markers, or scan more of the specimen",
        )
    if status == "symmetric":
        for line in symmetries.describe():
            yield Finding(
                "SCAN-SYMMETRY",
                f"the target has a symmetry, so the pose is known only up to it: {line}",
                level="warning",
                hint="datum points (--datum) decide; the numbers hold for every such pose listed",
            )
    if status in ("aligned", "symmetric"):
        yield from left_aside(cleaned, part)
    if status in ("aligned", "symmetric", "ambiguous") and cleaned.table is not None and "plane kept" not in part.name:
        up = best.pose.rotation @ cleaned.table.normal
        area = target.mesh.face_areas_mm2()
        a, b, c = (target.mesh.vertices_mm[target.mesh.faces[:, k]] for k in range(3))
        facing = np.cross(b - a, c - a).sum(axis=0) / (2 * area.sum())
        if float(facing @ up) < -0.3:
            yield Finding(
                "SCAN-OTHER-SIDE",
                "on its table the specimen shows its back: it lies upside down or was deployed to the other side",
                level="warning",
                hint="look which face is marked; for a target that is its own mirror image geometry cannot tell",
            )
