"""Feed, rapid and power overrides: the real-time bytes that lead from one percentage to another. Pure."""

from __future__ import annotations

from typing import Literal

Override = Literal["feed", "rapid", "power"]

RESET = {"feed": 0x90, "rapid": 0x95, "power": 0x99}
STEPS = {"feed": (0x91, 0x92, 0x93, 0x94), "power": (0x9A, 0x9B, 0x9C, 0x9D)}  # +10, -10, +1, -1
RAPIDS = {100: 0x95, 50: 0x96, 25: 0x97}
LEAST, MOST = 10, 200


def override_bytes(which: Override, percent: int) -> list[bytes]:
    """Return the bytes that set an override to `percent`, each to be sent on its own; raise `ValueError` out of range.

    They begin with the reset to 100 %, so that what stands now need not be known. The board takes one step of a kind at
    a time: a second before it has looked is the same step.
    """
    if which == "rapid":
        if percent not in RAPIDS:
            raise ValueError(f"rapids run at 100, 50 or 25 %, not {percent}")
        return [bytes([RAPIDS[percent]])]
    if not LEAST <= percent <= MOST:
        raise ValueError(f"{which} can be set from {LEAST} to {MOST} %, not to {percent}")
    up, down, one_up, one_down = STEPS[which]
    tens, ones = divmod(abs(percent - 100), 10)
    more = percent >= 100
    codes = [RESET[which], *[up if more else down] * tens, *[one_up if more else one_down] * ones]
    return [bytes([code]) for code in codes]
