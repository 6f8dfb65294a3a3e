"""Whether a register map fits the rig that answers, from what may always be read; and whether it fits itself. Pure.

A wrong word order, scale or address gives numbers that look like numbers. What no rig can say is told here, with the
key of the map that is to be changed, before anything moves.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from drivers.errors import ProtocolError
from drivers.rig.registers import Register, RegisterMap, Value

ANY_RIG = {"capacity": (1e-3, 1e6), "travel": (0.1, 1e4), "speed_max": (1e-3, 1e4)}  # N, mm, mm/s: of any bench
OVER_RATIO, UP_MM = 2.0, 1.0  # more force than twice the capacity, a homed stage so far above its switch: no reading
BEYOND_RATIO = 1.1  # and none so far beyond the travel
LATER_S = 0.5  # two readings of the sequence lie no farther apart than the host's clock says, and this
SAME = (
    ("position", ("command", "target"), ("settings", "travel_min", "travel_max", "safe_height")),
    ("force", ("command", "until"), ("settings", "force_min", "force_max")),
)


class MapDoubted(ProtocolError):
    """What the rig answers cannot be meant as the map reads it."""


def doubt_identity(registers: RegisterMap, words: Sequence[int]) -> None:
    """Raise `MapDoubted` where the identity block says what no rig is."""
    own, turned = registers.decode("identity", words), _turned(registers)
    odd = _odd_identity(own)
    if not odd:
        return
    if not _odd_identity(turned.decode("identity", words)):
        raise _other_order(registers, odd)
    raise MapDoubted(f"map {registers.name!r}: {odd}; check kind, scale and address there")


def doubt_status(
    registers: RegisterMap, words: Sequence[Sequence[int]], apart_s: float, capacity_N: float, travel_mm: float
) -> None:
    """Raise `MapDoubted` where two status blocks, read `apart_s` after each other, say what this rig cannot."""
    room = (apart_s, capacity_N, travel_mm)
    odd = _odd_status(registers, words, *room)
    if not odd:
        return
    turned = _turned(registers)
    if not _odd_status(turned, words, *room) and _runs(turned, words, apart_s):
        raise _other_order(registers, odd)
    raise MapDoubted(f"map {registers.name!r}: {odd}")


def contradictions(registers: RegisterMap) -> Iterator[str]:
    """Yield, in words, where registers that mean the same quantity count it differently."""
    status = {r.name: r for r in registers.blocks["status"].registers}
    for name, *others in SAME:
        read = status[name]
        for block, *names in others:
            for register in registers.blocks[block].registers:
                if register.name in names and not _counts_alike(read, register):
                    yield (
                        f"{block}.{register.name} counts in {_step(register):g} {register.unit}, "
                        f"status.{name} in {_step(read):g} {read.unit}"
                    )


def _counts_alike(one: Register, other: Register) -> bool:
    """Tell whether two registers agree in sign, and in step where they are of one kind."""
    a, b = _step(one), _step(other)
    return a * b > 0 and (one.kind != other.kind or abs(a - b) <= 1e-9 * abs(a))


def _step(register: Register) -> float:
    return register.scale_ratio or 1.0


def _turned(registers: RegisterMap) -> RegisterMap:
    return replace(registers, word_order="little" if registers.word_order == "big" else "big")


def _other_order(registers: RegisterMap, odd: str) -> MapDoubted:
    other = _turned(registers).word_order
    return MapDoubted(
        f"map {registers.name!r}: with word_order: {registers.word_order} {odd}, with {other} all fits; "
        f"set word_order: {other}"
    )


def _odd_identity(values: Mapping[str, Value]) -> str:
    """Return the first figure that no rig has, in words; nothing where all may be."""
    for name, (low, high) in ANY_RIG.items():
        if not low <= float(values[name]) <= high:
            return f"identity.{name} reads {values[name]:.4g}"
    return ""


def _odd_status(
    registers: RegisterMap, words: Sequence[Sequence[int]], apart_s: float, capacity_N: float, travel_mm: float
) -> str:
    values = registers.decode("status", words[-1])
    position_mm, force_N, state = float(values["position"]), float(values["force"]), int(values["state"])
    homed = "unhomed" not in registers.fault_names(int(values["faults"]))
    if outside := registers.outside("status", values):
        return f"status: {outside[0]}; check its scale, min and max"
    if state >= len(registers.states):
        return f"status.state reads {state}, the map names {len(registers.states)} states; check the block's address"
    if homed and not -UP_MM <= position_mm <= BEYOND_RATIO * travel_mm:
        return f"status.position reads {position_mm:.4g} mm on a travel of {travel_mm:g} mm; check its scale"
    if abs(force_N) > OVER_RATIO * capacity_N:
        return f"status.force reads {force_N:.4g} N on a cell of {capacity_N:g} N; check its scale"
    if not _runs(registers, words, apart_s) and _runs(_turned(registers), words, apart_s):
        return "status.sequence does not run with the clock"
    return ""


def _runs(registers: RegisterMap, words: Sequence[Sequence[int]], apart_s: float) -> bool:
    """Tell whether the sequence advances from one block to the next as time does."""
    size = 1 << 16 * next(r.words_count for r in registers.blocks["status"].registers if r.name == "sequence")
    counts = [int(registers.decode("status", block)["sequence"]) for block in words]
    return all(0 < (b - a) % size * registers.tick_s <= apart_s + LATER_S for a, b in itertools.pairwise(counts))
