"""What a job says while it works: one stream, heard by the progress bar and by `events.jsonl`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Event:
    """One step of a job.

    `kind` is a stable word (`stage`, `progress`, `finding`, `sample`, `state`, `warning`); `done_frac` is 0 to 1
    where the job knows how far it is; `data` is plain JSON.
    """

    kind: str
    message: str = ""
    done_frac: float | None = None
    data: dict[str, Any] = field(default_factory=dict)


Emit = Callable[[Event], None]


def silent(_: Event) -> None:
    """Hear nothing."""
