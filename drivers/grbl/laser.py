"""A GRBL laser: connect, ask, home, jog, hold, resume, and off. **W**

`off` is real-time and never a queued line: feed hold, wait for standstill at most a second, reset. Leaving the `with`
block switches off whatever happened. Nothing that moves or burns is ever sent twice; hold and reset are repeated until
the board confirms them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType

from drivers.clock import Clock, WallClock
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout, ProtocolError, TransportError
from drivers.grbl.faults import WHO, BoardRestarted
from drivers.grbl.link import ANSWER_S, DOOR, HOLD, JOG_CANCEL, RESET, START, STATUS, Link, alarm
from drivers.grbl.messages import Alarm, Banner, Message, Report, Vector
from drivers.grbl.overrides import Override, override_bytes
from drivers.grbl.settings import Identity, identify
from drivers.grbl.stream import bare
from drivers.transport import Transport

WAKE_S = 4.0  # a board that restarts when its port is opened needs up to two seconds
HOLD_S = 1.0
BRAKE_S = 10.0  # a heavy machine found in motion may take so long, once it obeys
BANNER_S = 2.0
BANNER_OFF_S = 1.0  # a reset in motion speaks after half a second
SETTLE_S = 0.15
REPEAT_S = 0.2
RESETS_COUNT = 3
STEP_WAIT_S = 0.06
HOME_S = 300.0


@dataclass(frozen=True, slots=True)
class Leaving:
    """How the laser was left: whether the board confirmed, where it stood, and whether that place can be trusted."""

    confirmed: bool
    position_known: bool
    machine_mm: Vector | None
    reason: str = ""


class Laser:
    """One GRBL board on an open line. Make it by `Laser(open_transport(url))`, then `connect`."""

    def __init__(self, transport: Transport, clock: Clock | None = None) -> None:
        self.clock = clock or WallClock()
        self.link = Link(transport, self.clock)
        self.identity: Identity | None = None
        self.left: Leaving | None = None
        self.hurried = False  # the operator has asked twice: `off` waits for no standstill
        self._quiet = False  # the board is idle, dark and empty: closing the line is enough

    def __enter__(self) -> Laser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if not self._quiet:
                self.off()
        finally:
            self.link.transport.close()

    def connect(self) -> Identity:
        """Bring the board to a known, dark, empty state and learn who it is.

        `?` first; if it moves, hold it to standstill; then reset, because half a line of a dead sender may wait in its
        buffer; only then lines. Raise `ProtocolError` where what answers is not a GRBL board.
        """
        self._quiet = False
        self.link.unit_mm = 1.0  # until it is known: `_identify` reads the board's own words
        self._wake()
        if not self._stand_still():
            self.link.garbled.append("(still moving)")
        banner = self._reset()
        if banner is None:
            said = f"; it said {self.link.garbled[-1]!r}" if self.link.garbled else ""
            raise ProtocolError(
                f"{self.link.transport.url}: nothing there answers as a GRBL board does{said}; check URL and baud rate"
            )
        self.link.wait_for(lambda _: False, SETTLE_S)
        self.identity = self._identify(banner)
        self.link.firmware = self.identity.firmware
        self.link.unit_mm, self.link.offset_mm = self.identity.unit_mm, self.identity.work_offset_mm()
        self._quiet = True
        return self.identity

    def _wake(self) -> None:
        """Ask `?` until a report comes; a board locked by a soft limit gives none, and is reset all the same.

        What lay in the line from before is thrown away first: an old banner says nothing about now.
        """
        self.link.drain()
        end_s = self.clock.now_s() + WAKE_S
        while self.clock.now_s() < end_s:
            self.link.send(STATUS)
            came, _ = self.link.wait_for(lambda m: isinstance(m, Report), REPEAT_S)
            if came:
                return

    def _stand_still(self) -> bool:
        """Hold a moving board until it stands; return whether it does. One that has not obeyed by `HOLD_S` is left."""
        report = self.link.report
        begun_s = self.clock.now_s()
        while report is not None and report.moving:
            obeys = report.state in ("Hold", "Door", "Jog")
            if self.clock.now_s() - begun_s > (BRAKE_S if obeys else HOLD_S):
                break
            self.link.send(HOLD + STATUS)
            self.link.wait_for(lambda m: isinstance(m, Report), STEP_WAIT_S)
            report = self.link.report
        return report is None or not report.moving

    def _reset(self) -> Banner | None:
        """Reset until the banner comes; return it, or None where it never does."""
        for _ in range(RESETS_COUNT):
            self.link.listener.clear()
            self.link.send(RESET)
            _, seen = self.link.wait_for(lambda m: isinstance(m, Banner), BANNER_S)
            for message in seen:
                if isinstance(message, Banner):
                    return message
        return None

    def _identify(self, banner: Banner) -> Identity:
        messages: list[Message] = [banner]
        report = self.link.status()
        for question in ("$I", "$$", "$#", "$G", "$N"):
            with contextlib.suppress(DeviceRefused):  # not every dialect answers every question in every state
                messages += self.link.ask(question)
        return identify(messages, report)

    def report(self) -> Report:
        """Return a fresh status report; raise `DeviceTimeout` where there is none within a second."""
        report = self.link.status()
        if report is None:
            raise DeviceTimeout(WHO, "the status request", 1.0, "is it homing, or locked after a soft limit?")
        return report

    def ask(self, line: str, timeout_s: float = ANSWER_S) -> list[Message]:
        """Send one line alone and wait for its answer; see `Link.ask`."""
        self._quiet = False
        return self.link.ask(bare(line), timeout_s)

    def begin(self) -> None:
        """Note that a program begins: from now on, leaving means `off`."""
        self._quiet = False

    def end(self) -> None:
        """Note that a program ended by itself, dark and standing."""
        self._quiet = True

    def run_quietly(self, line: str, timeout_s: float) -> list[Message]:
        """Send a line that leaves the board dark and idle, such as `M5` or a `$` question."""
        found = self.ask(line, timeout_s)
        self._quiet = True
        return found

    def home(self) -> Report:
        """Find the limit switches; afterwards the position is known. Raise `DeviceAlarm` where it fails."""
        self.ask("$H", HOME_S)
        self._quiet = True
        return self.report()

    def unlock(self) -> Report:
        """Clear an alarm without homing: the position is whatever the board believes."""
        self.run_quietly("$X", ANSWER_S)
        return self.report()

    def hold(self) -> Report:
        """Stop with the beam off and the position kept; return once it stands. Repeats `!` until it is obeyed."""
        end_s = self.clock.now_s() + HOLD_S
        while self.clock.now_s() < end_s:
            self.link.send(HOLD + STATUS)
            self.link.wait_for(lambda m: isinstance(m, Report), STEP_WAIT_S)
            if self.link.report is not None and self.link.report.standing:
                return self.link.report
        raise DeviceTimeout(WHO, "the feed hold", HOLD_S, "it will be reset")

    def resume(self) -> None:
        """Go on after a hold that is complete; before `Hold:0` the board would ignore it."""
        report = self.report()
        if report.state == "Hold" and report.substate != 0:
            report = self.hold()
        if report.state in ("Hold", "Door"):
            self._quiet = False
            self.link.send(START)

    def open_door(self) -> None:
        """Do what an opening door does: hold, and switch beam and air off; `resume` goes on once it is closed."""
        self._quiet = False
        self.link.send(DOOR)

    def override(self, which: Override, percent: int) -> Report:
        """Set the feed, rapid or power override and return the report that shows it."""
        for code in override_bytes(which, percent):
            self.link.send(code)
            self.report()  # the board takes one step of a kind at a time
        return self.report()

    def jog(self, x_mm: float, y_mm: float, feed_mm_s: float) -> None:
        """Move by so much, beam off, at most; returns when it stands there. Ctrl-C cancels the jog."""
        self._quiet = False
        try:
            self.link.ask(f"$J=G91G21X{x_mm:.3f}Y{y_mm:.3f}F{60 * feed_mm_s:.1f}")
            self.wait_until_idle(60.0 + 4 * (abs(x_mm) + abs(y_mm)) / feed_mm_s)
        except BaseException:  # Ctrl-C too: the head must not go on alone
            self.cancel_jog()
            raise
        self._quiet = True

    def cancel_jog(self) -> None:
        """Stop a jog; what is left of it is dropped."""
        with contextlib.suppress(TransportError):
            self.link.send(JOG_CANCEL + HOLD)

    def wait_until_idle(self, timeout_s: float) -> Report:
        """Return once the board says Idle; raise `DeviceAlarm` on an alarm, `DeviceTimeout` when time is up."""
        end_s = self.clock.now_s() + timeout_s
        while self.clock.now_s() < end_s:
            self.link.send(STATUS)
            _, seen = self.link.wait_for(lambda m: isinstance(m, Report), 0.5)
            for message in seen:
                if isinstance(message, Alarm):
                    raise alarm(message.code, self.link.firmware)
                if isinstance(message, Banner):
                    raise BoardRestarted(message.text)
            if self.link.report is not None and self.link.report.state == "Idle":
                return self.link.report
            self.clock.sleep(0.02)
        raise DeviceTimeout(WHO, "by becoming idle", timeout_s)

    def off(self) -> Leaving:
        """Switch the beam off now and leave the board reset: `!`, standstill within a second, `0x18`.

        Never raises: what the board did not confirm is said in the answer. A reset at standstill keeps the position;
        one in motion loses it.
        """
        try:
            try:
                stands = self._hold_hard()
            except KeyboardInterrupt:  # the second Ctrl-C: no more waiting for standstill
                stands = False
            where = self.link.report.machine_mm if self.link.report is not None else None
            alarms: list[Message] = []
            banner = None
            for _ in range(RESETS_COUNT):
                self.link.send(RESET)
                _, seen = self.link.wait_for(lambda m: isinstance(m, Banner), BANNER_OFF_S)
                alarms += [m for m in seen if isinstance(m, Alarm)]
                banner = next((m for m in seen if isinstance(m, Banner)), None)
                if banner is not None:
                    break
            known = stands and banner is not None and not alarms
            self.left = Leaving(
                banner is not None, known, where, "" if banner else "the board did not answer the reset"
            )
        except DeviceError as fault:
            self.left = Leaving(False, False, None, str(fault))
        self._quiet = True
        return self.left

    def _hold_hard(self) -> bool:
        """Ask for a hold until the board stands or time is up; return whether it stands."""
        end_s = self.clock.now_s() + HOLD_S
        while self.clock.now_s() < end_s and not self.hurried:
            self.link.send(HOLD + STATUS)
            came, _ = self.link.wait_for(lambda m: isinstance(m, Report), STEP_WAIT_S)
            report = self.link.report
            if came and report is not None and report.standing and report.state != "Alarm":
                return True
            if came and report is not None and report.state in ("Alarm", "Home"):
                return False
        return False

    def check(self, lines: Sequence[str], rx_bytes: int | None = None) -> list[tuple[int, int]]:
        """Send the program through the board's own check mode; return (line index, error number) of what it refuses.

        Nothing moves. Leaving check mode restarts the board: modal state and G92 are gone afterwards.
        """
        from drivers.grbl.check import check_program

        found = check_program(self.link, lines, rx_bytes or (self.identity.rx_bytes if self.identity else 128))
        self._quiet = True
        return found
