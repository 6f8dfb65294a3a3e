"""`fabctl scan` before anything is computed."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from fabctl.cli.main import cli
from fabctl.errors import UsageError
from fabctl.workspace import Workspace


def test_a_specimen_without_a_target_surface_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "design").mkdir()
    (tmp_path / "design" / "coupon.json").write_text("{}")
    name = Workspace(tmp_path).new_specimen(tmp_path / "design").name
    with pytest.raises(UsageError, match=f"{name} was cut without a target surface"):
        CliRunner().invoke(cli, ["--home", str(tmp_path), "scan", "run", name], catch_exceptions=False)
