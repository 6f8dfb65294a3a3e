"""A specimen as two force curves over depth, one for pressing and one for letting go, with the press between.

`push` is told where the tool of the rig stands and answers with the depth and force at which tool, frame and specimen
are in balance: the frame gives way by `compliance_mm_N` times the force, so on a falling branch steeper than the frame
the balance jumps (snap-through), and jumps back elsewhere on the way out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Curves:
    """Force over depth on an even grid from 0 (first contact); beyond its end the last slope goes on."""

    step_mm: float
    load_N: Sequence[float]
    unload_N: Sequence[float]

    @property
    def depth_max_mm(self) -> float:
        """Return the depth at which the table ends."""
        return self.step_mm * (len(self.load_N) - 1)


@dataclass
class Specimen:
    """Curves with a memory.

    `blend_mm` is the way it takes to change from the loading to the unloading curve. `virgin_ratio` is what a depth
    never reached before costs more (Mullins); `creep_ratio` of the force relaxes with `creep_s`. `tilt_N` is drawn per
    specimen elsewhere. All are zero for a specimen that is only its curves.
    """

    curves: Curves
    blend_mm: float = 0.15
    virgin_ratio: float = 0.0
    virgin_mm: float = 1.0
    creep_ratio: float = 0.0
    creep_s: float = 5.0
    depth_mm: float = 0.0
    force_N: float = 0.0
    _loading: float = field(default=0.0, repr=False)
    _deepest_mm: float = field(default=0.0, repr=False)
    _relaxed_N: float = field(default=0.0, repr=False)

    def push(self, tool_mm: float, compliance_mm_N: float, dt_s: float) -> tuple[float, float]:
        """Return (depth, force) with the tool at `tool_mm` below first contact, after `dt_s` more."""
        before_mm = self.depth_mm
        if tool_mm <= 0 and before_mm <= 0:
            self.depth_mm, self.force_N = tool_mm, 0.0
            self._relaxed_N *= max(0.0, 1 - dt_s / self.creep_s)
            return tool_mm, 0.0
        depth = self._balance(max(before_mm, 0.0), tool_mm, compliance_mm_N)
        elastic = self._force(depth, before_mm)
        self._loading = self._memory(depth, before_mm)
        self._deepest_mm = max(self._deepest_mm, depth)
        self._relaxed_N += (self.creep_ratio * elastic - self._relaxed_N) * min(1.0, dt_s / self.creep_s)
        self.depth_mm = depth
        self.force_N = max(0.0, elastic - self._relaxed_N) if depth > 0 else 0.0
        return self.depth_mm, self.force_N

    def _memory(self, depth_mm: float, before_mm: float) -> float:
        return min(1.0, max(0.0, self._loading + (depth_mm - max(before_mm, 0.0)) / self.blend_mm))

    def _force(self, depth_mm: float, before_mm: float) -> float:
        """Return the elastic force at `depth_mm`, coming from `before_mm`."""
        if depth_mm <= 0:
            return 0.0
        place = depth_mm / self.curves.step_mm
        k = min(int(place), len(self.curves.load_N) - 2)
        part = place - k
        up, down = self.curves.load_N, self.curves.unload_N
        loading = up[k] + (up[k + 1] - up[k]) * part
        if self.virgin_ratio:
            new = min(1.0, max(0.0, 1 + (depth_mm - self._deepest_mm) / self.virgin_mm))
            loading *= 1 + self.virgin_ratio * new
        if down is up:
            return loading
        unloading = down[k] + (down[k + 1] - down[k]) * part
        return unloading + (loading - unloading) * self._memory(depth_mm, before_mm)

    def _balance(self, start_mm: float, tool_mm: float, compliance_mm_N: float) -> float:
        """Walk from the last depth in the direction of motion to the first balance of tool, frame and specimen."""

        def gap(depth_mm: float) -> float:
            force = self._force(depth_mm, self.depth_mm) - self._relaxed_N
            return depth_mm + compliance_mm_N * force - tool_mm

        here, value = start_mm, gap(start_mm)
        step = self.curves.step_mm if value < 0 else -self.curves.step_mm
        while True:
            ahead = here + step
            if ahead <= 0 and step < 0:
                at_zero = gap(0.0)
                if at_zero > 0:
                    return min(0.0, tool_mm)
                return _between(0.0, at_zero, here, value)
            there = gap(ahead)
            if (there < 0) != (value < 0) or there == 0:
                return _refined(gap, here, value, ahead, there)
            here, value = ahead, there


def _between(low: float, at_low: float, high: float, at_high: float) -> float:
    return low if at_high == at_low else low + (high - low) * (0 - at_low) / (at_high - at_low)


def _refined(gap: object, a: float, at_a: float, b: float, at_b: float) -> float:
    """Return the root between a and b by three steps of regula falsi: the table is linear between its nodes."""
    assert callable(gap)
    middle = a
    for _ in range(3):
        middle = _between(a, at_a, b, at_b)
        value = gap(middle)
        if abs(value) < 1e-7:  # a tenth of a nanometre
            break
        if (value < 0) == (at_a < 0):
            a, at_a = middle, value
        else:
            b, at_b = middle, value
    return middle
