"""What can go wrong while a program is streamed. Each error says which lines may have run."""

from __future__ import annotations

from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout, ProtocolError
from drivers.grbl.meanings import error_meaning

WHO = "the laser"


class LineRefused(DeviceRefused):
    """The board refused a line of a program with `error:n`; the lines already in its buffer still run."""

    def __init__(self, index: int, line: str, code: int, sent_count: int, firmware: str = "grbl") -> None:
        meaning, hint = error_meaning(code, firmware)
        super().__init__(WHO, line, f"error {code}: {meaning}", hint)
        self.index, self.line, self.code, self.sent_count = index, line, code, sent_count

    def __str__(self) -> str:
        after = range(self.index + 1, self.sent_count)
        also = f"; lines {after[0] + 1} to {after[-1] + 1} were sent too and may have run" if after else ""
        return f"line {self.index + 1}: {super().__str__()}{also}"


class BoardRestarted(DeviceError):
    """A banner came in the middle of a program: the job is over, and where the machine stands is not known."""

    def __init__(self, banner: str) -> None:
        super().__init__(banner)
        self.banner = banner

    def __str__(self) -> str:
        return f"{WHO} restarted in mid-job ({self.banner}); position lost; home it and look at the sheet"


class LostOk(ProtocolError):
    """The board stands idle with an empty buffer, yet lines are unanswered: an `ok` got lost on the way."""

    def __init__(self, outstanding_count: int) -> None:
        super().__init__(outstanding_count)
        self.outstanding_count = outstanding_count

    def __str__(self) -> str:
        return (
            f"{WHO} has done everything it was sent, but {self.outstanding_count} of the lines were never answered: "
            "an answer was lost; check the cable"
        )


class DoubledOk(ProtocolError):
    """An `ok` too many: the count of what the board holds cannot be trusted any more."""

    def __init__(self, evidence: str) -> None:
        super().__init__(evidence)
        self.evidence = evidence

    def __str__(self) -> str:
        return f"{WHO} answered a line that was never sent ({self.evidence}); check the cable"


class GarbledLine(ProtocolError):
    """Something came that no board says, where an answer may have been."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text

    def __str__(self) -> str:
        return f"{WHO} sent {self.text!r}, which is no answer: the line is disturbed; check the cable"


class LinkStalled(DeviceTimeout):
    """The board does not answer `?`, which it answers even in the slowest move."""

    def __init__(self, waited_s: float) -> None:
        super().__init__(WHO, "the status request", waited_s, "check cable and power; the board may still be running")
