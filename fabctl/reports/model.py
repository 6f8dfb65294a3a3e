"""What a report says, before it is drawn: plain values taken from records, nothing computed twice."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Word = Literal["pass", "fail", "incomplete"]


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture or a live view, as HTML that needs nothing from outside the page."""

    markup: str
    caption: str
    wide: bool = False


@dataclass(frozen=True, slots=True)
class Fact:
    """One line of a table; `note` is shown small beside the value."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True, slots=True)
class Step:
    """One room's part of the page."""

    title: str
    status: str
    summary: str
    facts: tuple[Fact, ...] = ()
    figures: tuple[Figure, ...] = ()
    notes: tuple[str, ...] = ()
    simulated: bool = False  # no real device did it


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where one file or run came from."""

    what: str
    name: str
    when: str
    sha256: str
    detail: str


@dataclass(frozen=True, slots=True)
class Report:
    """A page: the verdict first, then the steps in the order of the work, then where everything came from."""

    title: str
    subtitle: str
    word: Word
    sentence: str
    reasons: tuple[str, ...]
    key_facts: tuple[Fact, ...]
    steps: tuple[Step, ...]
    provenance: tuple[Provenance, ...]
    versions: tuple[Fact, ...]
    made: str  # when, on the clock of whoever made it
    head: str = ""  # scripts that live views share, once a page


def picture(path: Path, caption: str, wide: bool = False) -> Figure:
    """Return a PNG or SVG file as a figure that carries its own bytes."""
    kind = "svg+xml" if path.suffix == ".svg" else "png"
    data = base64.b64encode(path.read_bytes()).decode()
    alt = html.escape(caption, quote=True)
    return Figure(f'<img src="data:image/{kind};base64,{data}" alt="{alt}">', caption, wide)
