"""The indentation rig: identify, set limits, arm, move, sample, stop.

What moves is sent once. Every command carries a number that the controller repeats in its status; a motion whose number
does not appear there is followed by STOP and reported as `MotionUnknown`. The STOP carries a higher number, so that a
request that arrives late is refused by the controller. The watchdog lives in the controller and is fed with the newest
believed sequence number, by nothing but the reading of samples.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

from drivers.errors import DeviceRefused, DeviceTimeout, ProtocolError, TransportError
from drivers.rig.bus import ExceptionReply, RegisterBus, open_bus
from drivers.rig.plausible import MapDoubted, doubt_identity, doubt_status
from drivers.rig.refusals import MotionUnknown, RigFaulted, refused
from drivers.rig.registers import BadReply, RegisterMap, Value
from drivers.rig.samples import Asked, Freshness, Restarted, Sample, Stale

LOST = (DeviceTimeout, BadReply, ExceptionReply)  # one reply less; the next request may do better
LOOK_S = 0.02  # between two readings that show whether the sequence runs
THERE_MM, THERE_RATIO = 0.1, 0.005  # a motion that is done ends as near to its target
Guard = Literal["none", "above", "below"]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Limits:
    """What the controller itself enforces, on the untared force and the absolute position."""

    force_max_N: float
    force_min_N: float
    travel_min_mm: float
    travel_max_mm: float
    safe_height_mm: float
    acceleration_mm_s2: float
    watchdog_s: float


@dataclass(frozen=True, slots=True)
class Identity:
    """What the controller says it is."""

    model: str
    serial: int
    firmware: str
    capacity_N: float
    travel_mm: float
    speed_max_mm_s: float


class Indenter:
    """One rig on one bus. `hear` gets every believed sample, whoever asked for it."""

    def __init__(
        self,
        bus: RegisterBus,
        registers: RegisterMap,
        hear: Callable[[Sample], None] = lambda _: None,
        now_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.bus, self.registers, self.hear = bus, registers, hear
        self._now_s, self._sleep = now_s, sleep
        self._fresh = Freshness(registers)
        self._request = 0
        self._number = 0
        self._asked_s = -1.0
        self._sent_to = (0, 0.0, False)  # number, target and whether a force may end the newest motion before it
        self.lost_count = 0

    @property
    def next_number(self) -> int:
        """Return the number that the next command will carry."""
        return self._number + 1

    # --- reading

    def identify(self) -> Identity:
        """Return who answers; raise `ProtocolError` where it is not what the register map describes."""
        words = self._again(lambda: self._words("identity"))
        values = self.registers.decode("identity", words)
        if values["magic"] != self.registers.magic or values["version"] != self.registers.version:
            raise ProtocolError(
                f"{self.bus.url}: says {values['magic']:#06x} version {values['version']}, the map "
                f"{self.registers.name!r} describes {self.registers.magic:#06x} version {self.registers.version}; "
                "choose the right map in the bench file (rig.map), or check the unit id"
            )
        doubt_identity(self.registers, words)
        firmware = int(values["firmware"])
        return Identity(
            model=str(values["model"]),
            serial=int(values["serial"]),
            firmware=f"{firmware // 100}.{firmware % 100:02d}",
            capacity_N=float(values["capacity"]),
            travel_mm=float(values["travel"]),
            speed_max_mm_s=float(values["speed_max"]),
        )

    def look(self, identity: Identity) -> None:
        """Raise `MapDoubted` where the status is nothing this rig can mean; neither feeds the watchdog nor moves."""
        first = self._again(lambda: self._words("status"))
        began_s = self._now_s()
        self._sleep(LOOK_S)
        second = self._again(lambda: self._words("status"))
        whole = all(self.registers.is_whole(words) for words in (first, second))
        if whole:  # else the line garbles, which the reading of samples tells better
            apart_s = self._now_s() - began_s
            doubt_status(self.registers, (first, second), apart_s, identity.capacity_N, identity.travel_mm)

    def environment(self) -> dict[str, float]:
        """Return temperature, humidity and the stage's place, as far as the rig has them."""
        if "environment" not in self.registers.blocks:
            return {}
        block = self.registers.blocks["environment"]
        values = self._again(lambda: self._read("environment"))
        return {f"{r.name}_{r.unit}": float(values[r.name]) for r in block.registers}

    def sample(self) -> Sample:
        """Return one fresh sample and feed the watchdog; raise one of `LOST` where no believable reply came.

        `Restarted` and `TransportError` are not to be gone on from.
        """
        status, feed = self.registers.blocks["status"], self.registers.blocks["feed"]
        self._request = self._request % 0xFFFF + 1
        fed = self.registers.encode("feed", {"feed": self._fresh.last_sequence, "request": self._request})
        # Asked twice within a tick, the controller would have nothing new to say.
        self._sleep(max(0.0, self._asked_s + 2 * self.registers.tick_s - self._now_s()))
        self._asked_s = sent_s = self._now_s()
        try:
            if self.registers.exchange:
                words = self.bus.exchange(status.address, status.words_count, feed.address, fed)
            else:
                self.bus.write(feed.address, fed)
                words = self.bus.read(status.table, status.address, status.words_count)
            found = self._fresh.believe(words, Asked(self._request, sent_s, self._now_s()))
        except LOST as fault:
            self.lost_count += 1
            if isinstance(fault, Stale):
                self.bus.drain()  # another reply is still on its way, and would answer the next request
            raise
        self._number = max(self._number, found.command_id)
        self.hear(found)
        return found

    def fresh_sample(self, patience_s: float | None = None) -> Sample:
        """Return the next believable sample; raise `DeviceTimeout` where none comes for `patience_s`."""
        patience_s = patience_s or 5 * (self.registers.timeout_s + self.registers.response_max_s)
        until_s = self._now_s() + patience_s
        while True:
            try:
                return self.sample()
            except Restarted:
                raise
            except LOST as fault:
                if self._now_s() >= until_s:
                    raise DeviceTimeout(self.bus.url, "a believable status", patience_s, str(fault)) from fault
                self._sleep(self.registers.tick_s)

    # --- settings

    def set_limits(self, limits: Limits) -> None:
        """Write the limits and read them back; only while disarmed. Repeating this is harmless, so it is repeated."""
        values: dict[str, Value] = {
            "force_max": limits.force_max_N,
            "force_min": limits.force_min_N,
            "travel_min": limits.travel_min_mm,
            "travel_max": limits.travel_max_mm,
            "safe_height": limits.safe_height_mm,
            "acceleration": limits.acceleration_mm_s2,
            "watchdog": limits.watchdog_s,
        }
        self._refuse_outside("settings", "limits", values)
        words = self.registers.encode("settings", values)
        block = self.registers.blocks["settings"]
        self._again(lambda: self.bus.write(block.address, words))
        kept = self._again(lambda: self.bus.read(block.table, block.address, block.words_count))
        if kept != words:
            raise ProtocolError(f"{self.bus.url}: limits {words} were written, {kept} read back; nothing was moved")

    # --- commands

    def arm(self) -> None:
        """Let the stage move; raise where the controller does not."""
        self._confirmed("arm", once=False)

    def disarm(self) -> None:
        """Take the stage's permission to move; repeated until confirmed."""
        self._confirmed("disarm", once=False)

    def clear_faults(self) -> None:
        """Ask the controller to forget its latched faults; it keeps those whose cause is still there."""
        self._confirmed("clear", once=False)

    def home(self, speed_mm_s: float) -> int:
        """Begin to drive up to the home switch, where position is 0; return the command's number."""
        return self._confirmed("home", speed=speed_mm_s)

    def move(self, target_mm: float, speed_mm_s: float, guard: Guard = "none", until_N: float = 0.0) -> int:
        """Begin to move to an absolute position; return the command's number.

        With `guard` the controller stops the stage where the gross force is above (below) `until_N`.
        """
        command = {"none": "move", "above": "move_until_above", "below": "move_until_below"}[guard]
        number = self._confirmed(command, target=target_mm, speed=speed_mm_s, until=until_N)
        self._sent_to = (number, target_mm, guard != "none")
        return number

    def move_stage(self, x_mm: float, y_mm: float, speed_mm_s: float) -> int:
        """Begin to move the specimen sideways; the controller allows it only above the safe height."""
        return self._confirmed("move_stage", stage_x=x_mm, stage_y=y_mm, speed=speed_mm_s)

    def stop(self) -> bool:
        """Stop the stage; repeated until the controller says that it stands. False where it never said so."""
        until_s = self._now_s() + 10 * (self.registers.timeout_s + self.registers.response_max_s)
        while self._now_s() < until_s:
            try:
                number = self._send("stop")
            except TransportError:
                return False
            try:
                if self._stands(number):
                    return True
            except TransportError:
                return False
            except Restarted:
                return True  # a controller that was restarted is disarmed
        return False

    def ended(self, sample: Sample, number: int) -> bool:
        """Tell whether command `number` is over; raise where the controller stopped it, or it ended elsewhere."""
        if sample.state == "faulted":
            raise RigFaulted(sample.faults, sample.position_mm, sample.force_N)
        if sample.command_id != number:
            why = f"command {sample.command_id} took its place"
            raise DeviceRefused("rig", f"command {number}", why, "one host only")
        if sample.command_state == "aborted":
            raise DeviceRefused("rig", f"command {number}", f"stopped: {sample.reason}")
        if sample.command_state == "done":
            self._doubt_the_place(sample)
        return sample.command_state == "done"

    def _doubt_the_place(self, sample: Sample) -> None:
        """Raise where a motion is done at another place than it was sent to: position and target count differently."""
        number, target_mm, guarded = self._sent_to
        if (
            sample.command_id != number
            or sample.state == "moving"
            or (guarded and sample.reason != "limit_not_reached")
        ):
            return
        if abs(sample.position_mm - target_mm) > THERE_MM + THERE_RATIO * abs(target_mm):
            raise MapDoubted(
                f"{self.bus.url}: the stage was sent to {target_mm:.3f} mm and says it is done at "
                f"{sample.position_mm:.3f} mm; in map {self.registers.name!r} the scales of status.position and "
                "command.target contradict each other"
            )

    def wait(self, number: int, patience_s: float) -> Sample:
        """Sample until command `number` has ended; return the last sample. Raise where it ended in a fault."""
        until_s = self._now_s() + patience_s
        while True:
            found = self.fresh_sample()
            if self.ended(found, number):
                return found
            if self._now_s() > until_s:
                raise DeviceTimeout(self.bus.url, f"the end of command {number}", patience_s)

    def close(self) -> None:
        """Let go of the bus."""
        self.bus.close()

    # --- inside

    def _confirmed(self, command: str, once: bool = True, **values: float) -> int:
        """Send a command once and return its number when the status shows it; see the head of this file."""
        self._refuse_outside("command", command, values)
        if self._number == 0:
            self.fresh_sample()  # the numbers go on from the controller's last one
        for attempt in range(1 if once else 5):
            refusal: ExceptionReply | None = None
            number = self._number + 1
            try:
                self._send(command, **values)
            except ExceptionReply as fault:
                refusal = fault
            if self._shows(command, number, **values):
                return number
            if once:
                stopped = self.stop()
                if refusal is not None and stopped:
                    raise refusal
                raise MotionUnknown(command, number, stopped)
            self._sleep(self.registers.response_max_s * attempt)
        raise DeviceTimeout(self.bus.url, f"confirmation of {command}", self.registers.timeout_s * 5)

    def _refuse_outside(self, block: str, command: str, values: Mapping[str, Value]) -> None:
        """Raise before anything is sent where the map's own limits forbid a value."""
        if outside := self.registers.outside(block, values):
            raise DeviceRefused("rig", command, "; ".join(outside), "the limits stand in the rig's map")

    def _send(self, command: str, **values: float) -> int:
        """Put the command on the line, once; a lost reply is not an answer either way."""
        self._number += 1
        block = self.registers.blocks["command"]
        body: dict[str, Value] = dict.fromkeys(block.names, 0)
        body |= {"id": self._number, "code": self.registers.commands[command], **values}
        try:
            self.bus.write(block.address, self.registers.encode("command", body))
        except ExceptionReply:
            if command != "stop":
                raise
        except (DeviceTimeout, BadReply):
            pass
        return self._number

    def _shows(self, command: str, number: int, **values: float) -> bool:
        """Tell whether the status shows the command, read back word for word; raise where it was refused."""
        until_s = self._now_s() + 2 * (self.registers.timeout_s + self.registers.response_max_s)
        while True:
            try:
                found = self.sample()
            except Restarted:
                raise
            except LOST:
                found = None
            if found is not None and found.command_id == number:
                break
            if found is not None or self._now_s() > until_s:
                return False
        if found.command_state == "refused":
            raise refused(command, values, found.reason)
        if values:
            self._compare(command, number, values)
        return True

    def _compare(self, command: str, number: int, values: Mapping[str, float]) -> None:
        block = self.registers.blocks["command"]
        kept = self._again(lambda: self._read("command"))
        sent: dict[str, Value] = dict.fromkeys(block.names, 0)
        sent |= {"id": number, "code": self.registers.commands[command], **values}
        if self.registers.encode("command", kept) != self.registers.encode("command", sent):
            stopped = self.stop()
            raise ProtocolError(
                f"{self.bus.url}: {command} reads back as {kept}, sent was {sent}; "
                + ("stopped" if stopped else "the stop was NOT confirmed: press the e-stop")
            )

    def _stands(self, number: int) -> bool:
        until_s = self._now_s() + 4 * (self.registers.timeout_s + self.registers.response_max_s)
        while self._now_s() < until_s:
            try:
                found = self.sample()
            except Restarted:
                raise
            except LOST:
                continue
            if found.command_id < number:
                return False
            if found.state != "moving":
                return True
        return False

    def _words(self, name: str) -> list[int]:
        block = self.registers.blocks[name]
        return self.bus.read(block.table, block.address, block.words_count)

    def _read(self, name: str) -> dict[str, Value]:
        return self.registers.decode(name, self._words(name))

    def _again(self, ask: Callable[[], T]) -> T:
        """Ask up to five times; only for what may be asked twice."""
        for _ in range(4):
            try:
                return ask()
            except LOST:
                continue
        return ask()


def open_indenter(url: str, registers: RegisterMap, hear: Callable[[Sample], None] = lambda _: None) -> Indenter:
    """Open the rig behind `url` and make sure that it is what `registers` describes."""
    bus = open_bus(url, registers.timeout_s, registers.response_max_s)
    rig = Indenter(bus, registers, hear)
    try:
        rig.look(rig.identify())
    except BaseException:  # Ctrl-C too: the line is given back
        bus.close()
        raise
    return rig
