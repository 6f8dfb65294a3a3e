"""From the words of a status block to a sample that can be believed, or a reason why not. No I/O, no clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.rig.registers import BadReply, RegisterMap

HEARTBEAT_MODULUS = 2**16
SLACK_S = 0.02  # two clocks of 100 ppm and the time of a frame on the line, with room


@dataclass(frozen=True, slots=True)
class Sample:
    """What the controller measured at one of its ticks. `force_N` is gross: no tare is taken off."""

    sequence: int
    time_s: float
    position_mm: float
    force_N: float
    state: str
    faults: tuple[str, ...]
    command_id: int
    command_state: str
    reason: str


@dataclass(frozen=True, slots=True)
class Asked:
    """One request for a sample: its number and the host's times around it."""

    request: int
    sent_s: float
    received_s: float


class Restarted(BadReply):
    """The controller's sequence ran backwards: it was restarted, and position and limits are gone."""


class Stale(BadReply):
    """The reply to an earlier request came: the line is out of step until it is drained."""


@dataclass(frozen=True, slots=True)
class ClockBounds:
    """Between which two values the host's time less the controller's lies, as known at `at_s` of the host's clock."""

    low_s: float
    high_s: float
    at_s: float

    def widened(self, now_s: float, drift_ratio: float) -> ClockBounds:
        """Return the bounds at `now_s`, two clocks drifting apart by at most `drift_ratio`."""
        more_s = drift_ratio * max(0.0, now_s - self.at_s)
        return ClockBounds(self.low_s - more_s, self.high_s + more_s, now_s)

    def narrowed(self, other: ClockBounds) -> ClockBounds:
        """Return what both leave open; `other` where they leave nothing."""
        low_s, high_s = max(self.low_s, other.low_s), min(self.high_s, other.high_s)
        return ClockBounds(low_s, high_s, other.at_s) if low_s <= high_s else other


class Freshness:
    """Believes a status block only where it is whole, answers this very request, and is newer than the last one.

    The sequence counts the controller's ticks, so it must advance as the host's clock does: by no less than the time
    between the last reply and this request, by no more than that between the last request and this reply. Over many
    replies the difference of the two clocks is known to the shortest way there and back; a reading that is older than
    its own request by more than that is not believed. The load cell's heartbeat counts conversions and must advance
    as the sequence does, or the force is an old one under a new number.
    """

    def __init__(self, registers: RegisterMap) -> None:
        self._map = registers
        words = next(r.words_count for r in registers.blocks["status"].registers if r.name == "sequence")
        self._modulus: int = 1 << 16 * words
        self._bounds: ClockBounds | None = None
        self._last: tuple[int, int, Asked] | None = None
        self._elapsed_ticks = 0
        self._doubted: tuple[int, Asked] | None = None

    @property
    def last_sequence(self) -> int:
        """Return the newest believed sequence number, 0 before the first: what the watchdog is fed with."""
        return self._last[0] if self._last else 0

    def believe(self, words: Sequence[int], asked: Asked) -> Sample:
        """Return the sample, or raise `BadReply` with the reason."""
        values = self._map.decode("status", words)
        if not self._map.is_whole(words):
            raise BadReply(f"status: the block's check {values['check']} does not fit its words")
        if "request_echo" in values and values["request_echo"] != asked.request:
            raise Stale(f"status: answers request {values['request_echo']}, asked was {asked.request}: stale")
        if outside := self._map.outside("status", values):
            raise BadReply(f"status: {'; '.join(outside)}")
        self._doubt_a_pause(asked)
        sequence, heartbeat = int(values["sequence"]), int(values.get("heartbeat", -1))
        self._elapsed_ticks += self._advance(sequence, heartbeat, asked)
        self._last = (sequence, heartbeat, asked)
        self._narrow(asked)
        return Sample(
            sequence=sequence,
            time_s=self._elapsed_ticks * self._map.tick_s,
            position_mm=float(values["position"]),
            force_N=float(values["force"]),
            state=_name(self._map.states, int(values["state"])),
            faults=self._map.fault_names(int(values["faults"])),
            command_id=int(values["command_id"]),
            command_state=_name(self._map.command_states, int(values["command_state"])),
            reason=_name(self._map.reasons, int(values["command_reason"])),
        )

    def _doubt_a_pause(self, asked: Asked) -> None:
        """Refuse a reply during which the host itself stood still: its clock cannot bound the reply's age then."""
        took_s = asked.received_s - asked.sent_s
        most_s = self._map.timeout_s + self._map.response_max_s + SLACK_S
        if took_s > most_s:
            raise BadReply(f"status: took {took_s:.3f} s by the host's clock, at most {most_s:.3f} s can be judged")

    def _advance(self, sequence: int, heartbeat: int, asked: Asked) -> int:
        if self._last is None:
            # One reply alone could say anything; the first is believed when a second goes on from it.
            if not self._goes_on(sequence, asked):
                raise BadReply(f"status: sequence {sequence} is the first; a second must agree")
            self._doubted = None
            return 0
        before, beat, last = self._last
        ticks = (sequence - before) % self._modulus
        if ticks == 0:
            raise BadReply(f"status: sequence {sequence} was there before: frozen")
        if 2 * ticks >= self._modulus:
            self._doubt_a_restart(sequence, asked)
            raise BadReply(f"status: sequence {sequence} after {before}: it ran backwards")
        least_s, most_s = _passed_s(last, asked)
        if not least_s <= ticks * self._map.tick_s <= most_s:
            raise BadReply(
                f"status: sequence {sequence} is {ticks * self._map.tick_s:.3f} s after {before}, by the host's clock "
                f"{max(least_s, 0):.3f} to {most_s:.3f} s passed: jumped or stale"
            )
        if heartbeat >= 0:
            self._doubt_the_force(heartbeat, beat, ticks)
        if self._older_than_asked(ticks, asked):
            # Bounds drawn from a reply that was itself too old would refuse every true one: two that agree end that.
            if not self._goes_on(sequence, asked):
                raise BadReply(f"status: sequence {sequence} was read before or after its own request: stale")
            self._bounds = None
        self._doubted = None
        return ticks

    def _doubt_the_force(self, heartbeat: int, before: int, ticks: int) -> None:
        """Refuse a force that the converter has not renewed as often as the sequence says time passed."""
        if heartbeat == before:
            raise BadReply(f"status: the load cell's heartbeat {heartbeat} stands still while the sequence runs")
        if not self._map.heartbeat_s:
            return
        due = ticks * self._map.tick_s / self._map.heartbeat_s
        room = max(1.0, self._map.tick_s / self._map.heartbeat_s)
        off = (heartbeat - before - due + HEARTBEAT_MODULUS / 2) % HEARTBEAT_MODULUS - HEARTBEAT_MODULUS / 2
        if abs(off) > room:
            raise BadReply(
                f"status: the load cell's heartbeat is {off:+.0f} conversions off the sequence: an old force"
            )

    def _older_than_asked(self, ticks: int, asked: Asked) -> bool:
        """Tell whether the controller's clock, as far as it is known, puts the reading outside its own request."""
        if self._bounds is None:
            return False
        known = self._bounds.widened(asked.received_s, self._map.clock_drift_ratio)
        at_s = (self._elapsed_ticks + ticks) * self._map.tick_s
        room_s = self._map.tick_s
        return not (asked.sent_s <= at_s + known.high_s + room_s and asked.received_s >= at_s + known.low_s - room_s)

    def _narrow(self, asked: Asked) -> None:
        """Learn from a believed reply: it was read between its request and its arrival."""
        at_s = self._elapsed_ticks * self._map.tick_s
        own = ClockBounds(asked.sent_s - at_s - self._map.tick_s, asked.received_s - at_s, asked.received_s)
        before = self._bounds
        drift = self._map.clock_drift_ratio
        self._bounds = own if before is None else before.widened(asked.received_s, drift).narrowed(own)

    def _doubt_a_restart(self, sequence: int, asked: Asked) -> None:
        """Raise `Restarted` where two replies in a row run on from an earlier count; one alone is a bad reply."""
        if self._goes_on(sequence, asked):
            raise Restarted(f"status: the sequence goes on from {sequence}: the controller was restarted")

    def _goes_on(self, sequence: int, asked: Asked) -> bool:
        """Tell whether this reply goes on from the doubted one before it; it is the doubted one from now on."""
        doubted, self._doubted = self._doubted, (sequence, asked)
        if doubted is None:
            return False
        least_s, most_s = _passed_s(doubted[1], asked)
        passed_s = ((sequence - doubted[0]) % self._modulus) * self._map.tick_s
        return max(least_s, self._map.tick_s) <= passed_s <= most_s


def _passed_s(last: Asked, asked: Asked) -> tuple[float, float]:
    """Return the least and the most time that passed between two readings inside the controller."""
    return asked.sent_s - last.received_s - SLACK_S, asked.received_s - last.sent_s + SLACK_S


def _name(names: Sequence[str], code: int) -> str:
    return names[code] if code < len(names) else f"code{code}"
