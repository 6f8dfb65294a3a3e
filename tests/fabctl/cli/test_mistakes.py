"""Plausible mistakes of an operator: each is told with what is wrong and what there is instead."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from fabctl.cli.common import json_asked
from fabctl.cli.main import cli
from fabctl.cli.refusal import exit_code_of, sentence_of


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "manifest.json").write_text('{"format": 1, "files": {}}')
    os.mkfifo(tmp_path / "folder" / "pipe.png")
    (tmp_path / "form.csv").write_text("patch\n")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ("run show FOLDER", 2, "not that of a run"),
        ("specimen read FOLDER/pipe.png", 2, "is no regular file"),
        ("run list --kind cutt", 2, "'kerf-coupon'"),
        ("run list --status dne", 2, "'interrupted'"),
        ("design check nowhere", 2, "double-bump"),
        ("design coupon-read FORM", 2, "--specimen"),
        ("deploy FOLDER --friction 2", 2, "give --gravity too"),
        ("deploy FOLDER --level-floor --support held", 2, "--support, --level-floor says"),
        ("deploy FOLDER --gravity --friction 2", 2, "this rim is no-slip"),
        ("flow cap --tolerance-frac 0.02 --tolerance-frac=0.05", 2, "--tolerance-frac is given 2 times"),
        ("design build cap -o a -o b", 2, "-o is given 2 times"),
    ],
)
def test_a_mistake_is_told_with_what_there_is_instead(words: str, code: int, told: str, home: Path) -> None:
    line = words.replace("FOLDER", str(home / "folder")).replace("FORM", str(home / "form.csv")).split()
    done = CliRunner().invoke(cli, ["--home", str(home), *line], standalone_mode=False)
    assert done.exception is not None
    assert (exit_code_of(done.exception), told in sentence_of(done.exception)) == (code, True), done.exception


def test_what_may_be_given_again_may_be_given_again(home: Path) -> None:
    line = ["deploy", str(home / "folder"), "--hint", "0", "0", "up", "--hint", "1", "0", "sideways"]
    done = CliRunner().invoke(cli, ["--home", str(home), *line], standalone_mode=False)
    assert "sideways" in sentence_of(done.exception or Exception())


def test_a_cell_that_is_not_bistable_is_refused_with_its_numbers(home: Path) -> None:
    line = ["library", "cell", "--t-mm", "3", "--theta-deg", "80", "--json"]
    assert json_asked(line)
    done = CliRunner().invoke(cli, ["--home", str(home), *line])
    told = json.loads(done.stdout)
    assert (done.exit_code, told["exit_code"], told["verdict"]) == (3, 3, "invalid")
    assert told["error"].endswith(told["reason"]) and told["findings"]
