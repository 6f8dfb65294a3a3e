"""A rig at any URL: `pytest tests/hardware --rig-url modbus-tcp://192.0.2.10:502?unit=1 [--allow-motion]`."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.rig.indenter import Indenter, Limits, open_indenter
from fabctl.config.rig import load_rig

pytestmark = pytest.mark.hardware


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Indenter]:
    url = request.config.getoption("--rig-url", default=None)
    if not url:
        pytest.skip("no --rig-url given")
    # A rig with another register map: name its file in RIG_MAP.
    registers = load_rig(os.environ.get("RIG_MAP", "reference"), Path.cwd())
    with contextlib.closing(open_indenter(url, registers)) as found:
        yield found


def test_it_says_what_the_map_describes(rig: Indenter) -> None:
    identity = rig.identify()
    assert identity.capacity_N > 0
    assert identity.travel_mm > 0


def test_every_sample_is_newer_than_the_last(rig: Indenter) -> None:
    found = [rig.fresh_sample() for _ in range(50)]
    assert all(b.sequence > a.sequence for a, b in pairwise(found))


def test_limits_are_read_back_and_two_millimetres_are_two_millimetres(
    rig: Indenter, request: pytest.FixtureRequest
) -> None:
    if not request.config.getoption("--allow-motion"):
        pytest.skip("motion is not allowed (--allow-motion)")
    identity = rig.identify()
    rig.clear_faults()
    rig.set_limits(Limits(0.1 * identity.capacity_N, -0.1 * identity.capacity_N, 0.0, 5.0, 0.5, 20.0, 0.5))
    rig.arm()
    try:
        rig.wait(rig.home(2.0), 120.0)
        assert rig.wait(rig.move(2.0, 1.0), 30.0).position_mm == pytest.approx(2.0, abs=0.02)
        assert rig.wait(rig.move(0.0, 1.0), 30.0).position_mm == pytest.approx(0.0, abs=0.02)
    finally:
        assert rig.stop()
        rig.disarm()
