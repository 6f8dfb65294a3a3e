"""Options of a cut that would change nothing are refused, all at once; `--resume` takes the record's own material."""

from __future__ import annotations

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from fabctl.cli.main import cli
from fabctl.config.material import load_material
from fabctl.cut.resume import material_of
from fabctl.errors import UsageError
from fabctl.records.folder import start_run
from fabctl.workspace import Workspace


def run(lab: Path, *words: str) -> Result:
    (lab / "design").mkdir(exist_ok=True)
    (lab / "bed.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    return CliRunner().invoke(cli, ["--home", str(lab), "cut", "run", str(lab / "design"), *words])


def test_options_that_would_change_nothing_are_refused_together(tmp_path: Path) -> None:
    words = ["--at-mm", "1", "2", "--image", str(tmp_path / "bed.png"), "--sheet", "2"]
    before = start_run(Workspace(tmp_path).runs, "cut")
    said = run(tmp_path, *words, "--resume", before.run_id).output
    for name in ("--at-mm", "--image"):
        assert f"{name} needs --origin camera" in said
    assert "--sheet means nothing with --resume" in said
    assert "--camera-file" not in said


@pytest.mark.parametrize("words", [[], ["--origin", "camera", "--at-mm", "1", "2"], ["--sheet", "2"]])
def test_options_that_mean_something_are_not(tmp_path: Path, words: list[str]) -> None:
    found = run(tmp_path, *words)
    assert not isinstance(found.exception, click.UsageError)
    assert "needs --origin" not in found.output  # the folder holds no design, and that is what is said


def test_a_resumed_cut_is_of_the_material_it_began_with(tmp_path: Path) -> None:
    material = load_material("natural-rubber-2.3", tmp_path)
    lab = Workspace(tmp_path)
    begun = start_run(lab.runs, "cut", config={"material": json.loads(material.model_dump_json())})
    assert material_of(begun) == material
    with pytest.raises(UsageError, match="not a cut that began"):
        material_of(start_run(lab.runs, "indent"))
