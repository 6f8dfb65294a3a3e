"""A fault found in input. Findings are collected, so that a person hears of all of them at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

Level = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that speaks against (error), casts doubt on (warning) or explains (info) an input.

    `code` is stable and greppable (`MESH-NAN`), `where` names file, face or key, `hint` says what to do.
    """

    code: str
    message: str
    level: Level = "error"
    where: str = ""
    hint: str = ""

    def __str__(self) -> str:
        where = f"{self.where}: " if self.where else ""
        hint = f" ({self.hint})" if self.hint else ""
        return f"{self.level} {self.code}: {where}{self.message}{hint}"

    def as_dict(self) -> dict[str, str]:
        """Return the finding as plain JSON."""
        return asdict(self)


def errors(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that forbid going on."""
    return [finding for finding in findings if finding.level == "error"]
