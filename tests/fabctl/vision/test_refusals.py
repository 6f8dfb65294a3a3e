"""Pictures that cannot be aligned by: each ends with its own message and exit code, and stores no alignment."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fabctl.cli.common import run_guarded
from fabctl.cli.main import cli
from fabctl.config.boards import config_of, write_board
from fabctl.errors import DEVICE, REFUSED
from fabctl.vision.bed import alignment_path, lens_path
from fabctl.vision.boards import MarkSheet
from fabctl.vision.lens import Lens, write_lens
from fabctl.workspace import Workspace
from tests.fabctl.vision.conftest import BED, REGISTRATION

Picture = NDArray[np.uint8]


def half(picture: Picture) -> Picture:
    covered = picture.copy()
    covered[:, 400:] = 90
    return covered


def burnt(picture: Picture) -> Picture:
    return np.clip(picture.astype(np.float64) * 3 + 40, 0, 255).astype(np.uint8)


def as_is(picture: Picture) -> Picture:
    return picture


OTHER = replace(REGISTRATION, name="bed", marks=tuple(replace(m, id=m.id + 20) for m in REGISTRATION.marks))
LARGER = replace(BED, marks=tuple(replace(m, side_mm=13.0) for m in BED.marks))


@pytest.mark.parametrize(
    ("spoil", "sheet", "code"),
    [
        (as_is, OTHER, "MARKS-FEW"),
        (as_is, LARGER, "MARKS-SIZE"),
        (half, BED, "MARKS-FEW"),
        (burnt, BED, "PICTURE-SATURATED"),
        (np.zeros_like, BED, "PICTURE-FLAT"),
        (None, BED, "video77"),
    ],
    ids=["wrong board", "wrong size", "too few markers", "saturated", "empty", "camera unplugged"],
)
def test_a_picture_that_will_not_do_is_refused_with_its_reason_and_nothing_is_stored(
    spoil: Callable[[Picture], Picture] | None,
    sheet: MarkSheet,
    code: str,
    tmp_path: Path,
    lens: Lens,
    bed_picture: Picture,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state = Workspace(tmp_path).bench_state("sim")
    write_lens(lens, lens_path(state))
    write_board(config_of(sheet), tmp_path / "configs" / "boards" / "bed.yaml")
    words = ["camera", "align"]
    if spoil is None:
        bench = Path("configs/benches/sim.yaml").read_text().replace("ready:camera", "/dev/video77")
        (tmp_path / "configs/benches").mkdir(parents=True)
        (tmp_path / "configs/benches/sim.yaml").write_text(bench)
    else:
        cv2.imwrite(str(tmp_path / "bed.png"), spoil(bed_picture))
        words += ["--image", str(tmp_path / "bed.png")]
    monkeypatch.setattr(sys, "argv", ["fabctl", "--home", str(tmp_path), *words])
    ended = run_guarded(cli)
    assert ended == (DEVICE if spoil is None else REFUSED)
    said = capsys.readouterr().err
    assert code in said
    if sheet is OTHER:  # what lies there instead is named
        assert "other markers are there: 0, 1, 2" in said
    assert not alignment_path(state).exists()
