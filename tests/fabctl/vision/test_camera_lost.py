"""The camera goes in the middle of a job, or shows what was: said, and nothing is cut by it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import Frame
from fabctl.config.boards import config_of, with_offset, write_board
from fabctl.cut.by_camera import BedEye
from fabctl.errors import DEVICE, REFUSED, RefusedError
from fabctl.testing import SimulatedBench, _bench
from fabctl.vision.align import align, write_alignment
from fabctl.vision.bed import alignment_path
from fabctl.vision.lens import Lens
from simulators.camera.burn import read_trace
from simulators.camera.picture import Studio
from tests.fabctl.vision.conftest import BED, REGISTRATION, WebCamera
from tests.fabctl.vision.test_live_loop import cut_words, write_design

Picture = NDArray[np.uint8]


@pytest.fixture
def bench(tmp_path: Path, lens: Lens, bed_picture: Picture, web_camera: WebCamera) -> Iterator[SimulatedBench]:
    for made in _bench(tmp_path, ("laser",)):
        state = made.lab.bench_state("sim")
        now = datetime.now(UTC).isoformat()
        write_alignment(align(bed_picture, "bed", with_offset(BED, -300, -200), lens, now), alignment_path(state))
        write_board(config_of(REGISTRATION), tmp_path / "configs" / "boards" / "registration.yaml")
        web_camera.use_on(tmp_path)
        yield made


@pytest.mark.slow
def test_unplugged_or_frozen_before_the_yes_cuts_nothing_and_unplugged_afterwards_harms_no_cut(
    bench: SimulatedBench, bed: Studio, web_camera: WebCamera
) -> None:
    root = bench.lab.root
    design = write_design(root / "design")
    trace = bench.lab.bench_state("sim") / "laser-trace.csv"

    def burnt() -> bool:
        return bool((read_trace(trace)[:, 3] > 0).any())

    web_camera.pictures = []
    bench.fabctl(*cut_words(design), expect=DEVICE)
    web_camera.pictures = [bed.frame(1)]  # the look that plans the job, and none after the yes
    bench.fabctl(*cut_words(design), expect=DEVICE)
    assert (bench.lab.bench_state("sim") / "camera" / "job-on-bed.png").is_file()  # drawn before the question
    web_camera.pictures = [bed.frame(2)] * 9
    bench.fabctl(*cut_words(design), expect=REFUSED)
    assert not burnt()
    ended = [json.loads(file.read_text())["status"] for file in (root / "runs").glob("*-cut-*/outcome.json")]
    assert set(ended) <= {"failed", "refused"}  # each attempt leaves its reason, and nothing else
    assert not list((root / "specimens").glob("S-*"))

    web_camera.pictures = [bed.frame(3), bed.frame(4)]
    done = bench.fabctl(*cut_words(design))
    assert web_camera.pictures == []
    assert burnt()
    bench.fabctl("cut", "inspect", done["specimen"], expect=DEVICE)


def test_the_same_picture_twice_is_no_second_look(
    tmp_path: Path, lens: Lens, bed_picture: Picture, bed: Studio
) -> None:
    now = datetime.now(UTC).isoformat()
    write_alignment(align(bed_picture, "bed", BED, lens, now), alignment_path(tmp_path))
    pictures = [bed_picture, bed_picture, bed.frame(7)]

    def take() -> Frame:
        return Frame(pictures.pop(0), "camera", datetime.now(UTC).isoformat())

    eye = BedEye(tmp_path, REGISTRATION, 2.3, take)
    assert eye.found.registration.marks_count == len(REGISTRATION.marks)
    with pytest.raises(RefusedError, match="PICTURE-SAME"):
        eye.look_again()
    eye.look_again()
