"""`fabctl doctor` tells each check as soon as it is known."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from fabctl.cli.doctor import command
from fabctl.health import Check


def test_a_check_is_told_before_the_next_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def checks(_lab: object) -> Iterator[Check]:
        yield Check("numpy", True, "numpy imports")
        raise RuntimeError("the next check")

    monkeypatch.setattr("fabctl.health.machine_checks", checks)
    done = CliRunner().invoke(command, [])
    assert str(done.exception) == "the next check"
    assert "numpy imports" in done.output
