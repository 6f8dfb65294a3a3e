"""What a frame calibration refuses to be: readings of a specimen, or of a block said to give more than everything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fabctl.indent.calibrate import CalibrationRefused, frame_result
from fabctl.indent.recorder import COLUMNS, Row


def pressed(path: Path, compliance_mm_N: float) -> Path:
    """Record three loadings of a block to 8 N on a frame that gives."""
    rows, k = [",".join(COLUMNS)], 0
    for number in (1, 2, 3):
        for force_N in np.linspace(0, 8, 60):
            k += 1
            at_mm = 20 + compliance_mm_N * force_N
            rows.append(Row(k / 100, k, at_mm, force_N, force_N, "load", 0, number, "moving", "").text())
    path.write_text("\n".join(rows) + "\n")
    return path


def test_the_blocks_own_give_is_taken_off(tmp_path: Path) -> None:
    found = frame_result(pressed(tmp_path / "samples.csv", 0.05), 1.0, 0.01)
    assert found["compliance_mm_N"] == pytest.approx(0.04, abs=1e-4)


@pytest.mark.parametrize(("gives", "block", "said"), [(0.05, 0.06, "check --block-mm-N"), (0.5, 0.0, "rigid block")])
def test_no_block_gives_more_than_everything_and_no_frame_millimetres(
    tmp_path: Path, gives: float, block: float, said: str
) -> None:
    with pytest.raises(CalibrationRefused, match=said):
        frame_result(pressed(tmp_path / "samples.csv", gives), 1.0, block)
