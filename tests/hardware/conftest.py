"""Real devices by URL. Nothing moves without `--allow-motion`; the beam stays at S0 without `--allow-beam`."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.grbl.laser import Laser
from drivers.transport import open_transport


@pytest.fixture
def laser_url(request: pytest.FixtureRequest) -> str:
    """Return the laser's URL, or skip."""
    url = request.config.getoption("--laser-url")
    if not url:
        pytest.skip("no laser: give --laser-url")
    return str(url)


@pytest.fixture
def rig_url(request: pytest.FixtureRequest) -> str:
    """Return the rig's URL, or skip."""
    url = request.config.getoption("--rig-url")
    if not url:
        pytest.skip("no rig: give --rig-url")
    return str(url)


@pytest.fixture
def may_move(request: pytest.FixtureRequest) -> None:
    """Skip unless devices may move."""
    if not request.config.getoption("--allow-motion"):
        pytest.skip("nothing may move: give --allow-motion")


@pytest.fixture
def beam_s_count(request: pytest.FixtureRequest) -> int:
    """Return the S word that tests may use: 0, or 1 % of full power where the beam is allowed."""
    return 10 if request.config.getoption("--allow-beam") else 0


@pytest.fixture
def laser(laser_url: str) -> Iterator[Laser]:
    """Return the laser, connected, idle or locked, and dark; off again afterwards."""
    with Laser(open_transport(laser_url)) as found:
        found.connect()
        yield found
