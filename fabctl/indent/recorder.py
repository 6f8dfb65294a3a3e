"""Samples to disk: durable within 50 ms of their coming, whatever the line or the disk does.

A writer of its own waits for the disk, so that neither a slow `fdatasync` delays the next sample nor a silent line
holds back the last ones.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fabctl.errors import RecordError
from fabctl.records.folder import DurableLog

BATCH_S = 0.02  # half of what is promised; the rest is for the disk
COLUMNS = (
    "time_s",
    "sequence",
    "position_mm",
    "force_gross_N",
    "force_N",
    "step",
    "point",
    "curve",
    "state",
    "faults",
)


class Log(Protocol):
    """What takes lines and returns when they are durable."""

    def append(self, lines: list[str]) -> None:
        """Write and wait."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


@dataclass(frozen=True, slots=True)
class Row:
    """One line of `samples.csv`. `force_N` is net of the tare; `step` is what the stage was doing."""

    time_s: float
    sequence: int
    position_mm: float
    force_gross_N: float
    force_N: float
    step: str
    point: int
    curve: int
    state: str
    faults: str

    def text(self) -> str:
        """Return the line."""
        return (
            f"{self.time_s:.4f},{self.sequence},{self.position_mm:.4f},{self.force_gross_N:.5f},{self.force_N:.5f},"
            f"{self.step},{self.point},{self.curve},{self.state},{self.faults}"
        )


class Recorder:
    """Takes rows at once and makes them durable soon; `acknowledged_count` counts those that are."""

    def __init__(self, path: Path, sync: Callable[[int], None] | None = None) -> None:
        header = ",".join(COLUMNS)
        self._log = DurableLog(path, header) if sync is None else DurableLog(path, header, sync)
        self._rows: list[str] = []
        self._fault: RecordError | None = None
        self._closing = False
        self._something = threading.Condition()
        self.acknowledged_count = 0
        self._writer = threading.Thread(target=self._write, name="samples", daemon=True)
        self._writer.start()

    def take(self, row: Row) -> None:
        """Hand over one row; raise `RecordError` where the disk has failed before."""
        with self._something:
            if self._fault is not None:
                raise self._fault
            self._rows.append(row.text())
            self._something.notify()

    def close(self) -> None:
        """Write what is left and close; raise `RecordError` where it could not be kept."""
        with self._something:
            self._closing = True
            self._something.notify()
        self._writer.join()
        self._log.close()
        if self._fault is not None:
            raise self._fault

    def _write(self) -> None:
        while True:
            with self._something:
                self._something.wait_for(lambda: self._rows or self._closing)
                if not self._closing:
                    self._something.wait(BATCH_S)  # let a few more come; a batch costs one wait for the disk
                rows, self._rows = self._rows, []
                closing = self._closing
            if rows and not self._keep(rows):
                return
            if closing and not self._rows:
                return

    def _keep(self, rows: list[str]) -> bool:
        try:
            self._log.append(rows)
        except RecordError as fault:
            with self._something:
                self._fault = fault
            return False
        self.acknowledged_count += len(rows)
        return True
