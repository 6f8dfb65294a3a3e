"""A fault found in input. Findings are collected, so that a person hears of all of them at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Level = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that speaks against (error), casts doubt on (warning) or explains (info) an input.

    `code` is stable and greppable (`MESH-NAN`), `where` names file, face or key, `hint` says what to do. One about a
    measure also carries it for programs: `value` against `limit`, both in `unit`; a pair is the two ends of a range.
    """

    code: str
    message: str
    level: Level = "error"
    where: str = ""
    hint: str = ""
    value: float | tuple[float, ...] | None = None
    unit: str = ""
    limit: float | tuple[float, ...] | None = None

    def __str__(self) -> str:
        where = f"{self.where}: " if self.where else ""
        hint = f" ({self.hint})" if self.hint else ""
        return f"{self.level} {self.code}: {where}{self.message}{hint}"

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as plain JSON; the measure only where there is one."""
        found = asdict(self)
        if self.value is None and self.limit is None:
            return {name: found[name] for name in ("code", "message", "level", "where", "hint")}
        return found


def errors(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that forbid going on."""
    return [finding for finding in findings if finding.level == "error"]
