"""A dry run in the board's check mode (`$C`): syntax and modes, not travel."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.errors import DeviceRefused, ProtocolError
from drivers.grbl.faults import BoardRestarted, LinkStalled
from drivers.grbl.link import Link, alarm
from drivers.grbl.messages import Alarm, Banner, Error, Info, Ok
from drivers.grbl.stream import Stream

SILENCE_S = 2.0
BANNER_S = 3.0


def check_program(link: Link, lines: Sequence[str], rx_bytes: int) -> list[tuple[int, int]]:
    """Return (line index, error number) of every line that the board refuses; it moves nothing meanwhile."""
    _enter(link)
    stream = Stream(lines, rx_bytes)
    refused: list[tuple[int, int]] = []
    heard_s = link.clock.now_s()
    while not stream.done:
        data = stream.take()
        if data:
            link.send(data)
        found = link.receive(0.05)
        if found:
            heard_s = link.clock.now_s()
        elif link.clock.now_s() - heard_s > SILENCE_S:
            raise LinkStalled(SILENCE_S)
        for message in found:
            if isinstance(message, Ok):
                stream.answered()
            elif isinstance(message, Error):
                refused.append((stream.answered(), message.code))
            elif isinstance(message, Alarm):
                raise alarm(message.code, link.firmware)
            elif isinstance(message, Banner):
                raise BoardRestarted(message.text)
    _leave(link)
    return refused


def _enter(link: Link) -> None:
    answer = link.ask("$C")
    if not any(isinstance(m, Info) and m.text == "Enabled" for m in answer):
        link.ask("$C")  # it was on already, and is off now
        raise ProtocolError("the board would not enter check mode; reset it and try again")


def _leave(link: Link) -> None:
    """Leave check mode; the board restarts, and says so by its banner."""
    link.send(b"$C\n")
    came, seen = link.wait_for(lambda m: isinstance(m, Banner), BANNER_S)
    if not came:
        error = next((m for m in seen if isinstance(m, Error)), None)
        if error is not None:
            raise DeviceRefused("the laser", "$C", f"error {error.code}")
        raise ProtocolError("the board did not restart on leaving check mode; reset it and try again")
    link.wait_for(lambda _: False, 0.1)
