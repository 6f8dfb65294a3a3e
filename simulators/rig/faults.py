"""What goes wrong between a rig and its host, drawn from a seed. Each kind is one method."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from simulators.rig import registers as R
from simulators.rig.controller import Controller
from simulators.rig.modbus import DEVICE_FAILURE, Request, answer, rtu_frame, tcp_frame

KINDS = (
    "late",
    "lost",
    "request_lost",
    "short",
    "long",
    "wrong_unit",
    "exception",
    "bits",
    "noise",
    "torn",
    "twice",
    "stale",
    "frozen",
    "stuck_force",
    "jump",
)
ENDINGS = ("cable", "power")
STATUS_WORDS = R.STATUS_CHECK + 1


@dataclass
class Delivery:
    """What goes out on the line, each part after its own delay; `hang_up` breaks the line afterwards."""

    parts: list[tuple[float, bytes]] = field(default_factory=list)
    hang_up: bool = False
    kind: str = ""


@dataclass
class FaultyLine:
    """Puts a fault of one of `kinds` on a share `rate_ratio` of the requests."""

    rate_ratio: float = 0.0
    kinds: Sequence[str] = KINDS
    seed: int = 0
    late_s: tuple[float, float] = (0.12, 0.14)
    tell: Callable[[str, dict[str, object]], None] = lambda _kind, _facts: None
    injected_count: int = 0
    _before: bytes = b""
    _serial: bool = False

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        self._still: list[int] = [0] * (STATUS_WORDS - 1)

    def serve(self, request: Request, device: Controller, serial: bool) -> Delivery:
        """Answer one request, or what a bad day makes of it."""
        self._serial = serial
        kind = self.rng.choice(self.kinds) if self.kinds and self.rng.random() < self.rate_ratio else ""
        if kind:
            self.injected_count += 1
            self.tell("injected", {"kind": kind, "function": request.pdu[0]})
        delivery: Delivery = getattr(self, f"_{kind or 'good'}")(request, device)
        delivery.kind = kind
        if delivery.parts:
            self._before = delivery.parts[-1][1]
        if not kind:
            self._still = device.status_words()[:-1]
        return delivery

    def frame(self, request: Request, pdu: bytes, unit: int | None = None) -> bytes:
        """Return the reply as it goes on this line."""
        unit = request.unit if unit is None else unit
        return rtu_frame(unit, pdu) if self._serial else tcp_frame(request.transaction, unit, pdu)

    def _good(self, request: Request, device: Controller) -> Delivery:
        return Delivery([(0.0, self.frame(request, answer(request.pdu, device)))])

    def _late(self, request: Request, device: Controller) -> Delivery:
        return Delivery([(self.rng.uniform(*self.late_s), self.frame(request, answer(request.pdu, device)))])

    def _lost(self, request: Request, device: Controller) -> Delivery:
        answer(request.pdu, device)
        return Delivery()

    def _request_lost(self, request: Request, device: Controller) -> Delivery:
        return Delivery()

    def _short(self, request: Request, device: Controller) -> Delivery:
        return self._resized(request, device, -self.rng.randint(1, 4))

    def _long(self, request: Request, device: Controller) -> Delivery:
        return self._resized(request, device, self.rng.randint(1, 4))

    def _resized(self, request: Request, device: Controller, more: int) -> Delivery:
        pdu = answer(request.pdu, device)
        if pdu[0] in (3, 4, 23):
            words = max(1, pdu[1] // 2 + more)
            pdu = bytes([pdu[0], 2 * words]) + (pdu[2:] + bytes(8))[: 2 * words]
        return Delivery([(0.0, self.frame(request, pdu))])

    def _wrong_unit(self, request: Request, device: Controller) -> Delivery:
        return Delivery([(0.0, self.frame(request, answer(request.pdu, device), unit=request.unit + 1))])

    def _exception(self, request: Request, device: Controller) -> Delivery:
        return Delivery([(0.0, self.frame(request, bytes([request.pdu[0] | 0x80, DEVICE_FAILURE])))])

    def _bits(self, request: Request, device: Controller) -> Delivery:
        raw = bytearray(self.frame(request, answer(request.pdu, device)))
        for _ in range(self.rng.randint(1, 5)):
            raw[self.rng.randrange(2 if self._serial else 8, len(raw))] ^= 1 << self.rng.randrange(8)
        return Delivery([(0.0, bytes(raw))])

    def _noise(self, request: Request, device: Controller) -> Delivery:
        noise = self.rng.randbytes(self.rng.randint(1, 12))
        return Delivery([(0.0, noise + self.frame(request, answer(request.pdu, device)))])

    def _torn(self, request: Request, device: Controller) -> Delivery:
        raw = self.frame(request, answer(request.pdu, device))
        return Delivery([(0.0, raw[: self.rng.randrange(1, len(raw))])])

    def _twice(self, request: Request, device: Controller) -> Delivery:
        raw = self.frame(request, answer(request.pdu, device))
        return Delivery([(0.0, raw), (0.002, raw)])

    def _stale(self, request: Request, device: Controller) -> Delivery:
        """Answer with the reply to the request before, as a gateway with a queue does."""
        answer(request.pdu, device)
        before = self._before
        if not self._serial and len(before) > 2:  # such a gateway puts the new transaction's number on it
            before = request.transaction.to_bytes(2, "big") + before[2:]
        return Delivery([(0.0, before)] if before else [])

    def _frozen(self, request: Request, device: Controller) -> Delivery:
        """Answer with an old measurement under a new request number, as a stalled firmware does."""
        return self._edited(request, device, lambda words: [*self._still[:2], *words[2:4], *self._still[4:]])

    def _stuck_force(self, request: Request, device: Controller) -> Delivery:
        """Answer with a force that the converter has stopped to renew."""
        return self._edited(
            request, device, lambda words: [*words[:3], self._still[3], *words[4:12], *self._still[12:]]
        )

    def _jump(self, request: Request, device: Controller) -> Delivery:
        """Answer with a sequence number that is some seconds off, forwards or backwards."""
        off = self.rng.choice((-1, 1)) * self.rng.randint(500, 100_000)

        def moved(words: list[int]) -> list[int]:
            number = ((words[0] << 16 | words[1]) + off) % 2**32
            return [number >> 16, number & 0xFFFF, *words[2:]]

        return self._edited(request, device, moved)

    def _cable(self, request: Request, device: Controller) -> Delivery:
        return Delivery(hang_up=True)

    def _power(self, request: Request, device: Controller) -> Delivery:
        device.power_cycle()
        return Delivery()

    def _edited(self, request: Request, device: Controller, edit: Callable[[list[int]], list[int]]) -> Delivery:
        """Change the words of a status reply and put the right check under them; other replies go out as they are."""
        pdu = answer(request.pdu, device)
        if pdu[0] in (3, 23) and pdu[1] == 2 * STATUS_WORDS:
            words = edit([int.from_bytes(pdu[k : k + 2], "big") for k in range(2, len(pdu), 2)][:-1])
            words = [*words[: STATUS_WORDS - 1], R.status_check(words[: STATUS_WORDS - 1])]
            pdu = pdu[:2] + b"".join(word.to_bytes(2, "big") for word in words)
        return Delivery([(0.0, self.frame(request, pdu))])
