"""Whether a picture can be measured in at all: not empty, not burnt out, not blurred beyond use, of the right size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding

MOST_SATURATED_RATIO = 0.25
LEAST_SPREAD_GREY = 6.0  # between the darkest and the lightest twentieth
LEAST_SIDE_PX = 64


def picture_findings(image: NDArray[np.uint8], source: str, size_px: tuple[int, int] | None = None) -> list[Finding]:
    """Return what speaks against measuring in a grey picture (h, w); `size_px` is what the lens was measured at."""
    if image.ndim != 2 or min(image.shape, default=0) < LEAST_SIDE_PX:
        return [Finding("PICTURE-EMPTY", f"a picture of shape {image.shape} holds nothing to measure", where=source)]
    found = []
    h, w = image.shape
    if size_px is not None and (w, h) != size_px:
        text = f"the picture is {w} x {h} px, the lens was measured at {size_px[0]} x {size_px[1]} px"
        hint = "set the camera as at the calibration, or calibrate again"
        found.append(Finding("PICTURE-SIZE", text, where=source, hint=hint))
    low, high = np.percentile(image, [5, 95])
    if high - low < LEAST_SPREAD_GREY:
        what = "black" if high < 20 else "white" if low > 235 else "one grey"
        text = f"the picture is all {what} (grey {low:.0f} to {high:.0f})"
        found.append(Finding("PICTURE-FLAT", text, where=source, hint="lens cap, light, exposure?"))
        return found
    burnt = float(np.mean(image >= 254))
    if burnt > MOST_SATURATED_RATIO:
        text = f"{burnt:.0%} of the picture is saturated, {MOST_SATURATED_RATIO:.0%} is the limit"
        found.append(Finding("PICTURE-SATURATED", text, where=source, hint="shorter exposure or less light"))
    return found
