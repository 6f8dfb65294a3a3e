"""What is no number, and what is no picture, is refused before anything is computed or made."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from fabctl.cli.main import cli


@pytest.mark.parametrize(
    "words",
    [
        ("library", "cell", "--t-mm", "nan", "--theta-deg", "3"),
        ("library", "cell", "--t-mm", "1.2", "--theta-deg", "inf"),
        ("scan", "run", "--tolerance-frac", "nan", "--target", "x.obj", "y.ply"),
        ("design", "coupon", "-o", "new", "--expansion", "nan"),
        ("design", "coupon", "-o", "new", "--hinges-mm", "nan,0.3"),
        ("design", "build", "cap", "--cell-mm", "nan", "-o", "new"),
        ("rig", "tare", "--time-s", "nan"),
        ("rig", "jog", "nan", "--yes"),
        ("library", "plot", "-o", "maps.bogus"),
        ("library", "cell", "--t-mm", "1.2", "--theta-deg", "3", "-o", "states"),
    ],
)
def test_what_is_no_measure_and_no_picture_is_refused_and_leaves_nothing(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli, ["--home", str(tmp_path), *words])
    assert done.exit_code == 2
    assert any(words in done.output for words in ("finite number", "not in the range", "a picture ends in"))
    assert not list(tmp_path.iterdir())
