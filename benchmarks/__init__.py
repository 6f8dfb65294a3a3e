"""Figures the project is measured by: `python -m benchmarks NAME [--json]`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure. `target` is worded as asked; `met` is None where nothing was asked."""

    name: str
    value: Any
    unit: str
    target: str
    met: bool | None
    n: int

    def as_dict(self) -> dict[str, Any]:
        """Return the figure as plain JSON."""
        return asdict(self)


Measure = Callable[[list[str]], list[Figure]]
