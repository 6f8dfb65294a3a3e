"""How a long computation tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

Watch = Callable[[str, float], None]  # what is being done, and how much of the whole is done before it


def unwatched(_: str, __: float) -> None:
    """Hear nothing."""
