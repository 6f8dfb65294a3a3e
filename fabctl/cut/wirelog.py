"""The run's `wire.log`: every byte with its time, also those from before the run folder existed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO

from fabctl.errors import RecordError


class WireLog:
    """A listener for `drivers.transport.tap.Tap`. Each row is with the operating system before `note` returns."""

    def __init__(self) -> None:
        self._early: list[str] = []
        self._stream: IO[bytes] | None = None
        self._path = Path()

    def note(self, row: str) -> None:
        """Keep one row; raise `RecordError` where the disk takes it not, so that nothing unrecorded is ever sent."""
        if self._stream is None:
            self._early.append(row)
            return
        data = row.encode("ascii") + b"\n"
        try:
            if self._stream.write(data) != len(data):
                raise OSError(28, "the disk took only part of the row")
        except OSError as fault:
            raise RecordError(
                f"{self._path}: {fault.strerror or fault}; the run was stopped, make room first"
            ) from fault

    def mark(self, remark: str, t_s: float) -> None:
        """Keep a remark among the bytes, such as where the program begins."""
        self.note(json.dumps({"t_s": round(t_s, 6), "dir": "#", "bytes": remark}))

    def write_to(self, path: Path) -> None:
        """From now on, write to `path`; what came before goes first."""
        try:
            self._stream = path.open("ab", buffering=0)
        except OSError as fault:
            raise RecordError(f"{path}: cannot be opened: {fault.strerror or fault}") from fault
        self._path = path
        early, self._early = self._early, []
        for row in early:
            self.note(row)

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
