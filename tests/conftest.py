"""What every test may ask for."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

# What is drawn must hold, however long a busy machine takes over it.
hypothesis.settings.register_profile("patient", deadline=None)
hypothesis.settings.load_profile("patient")

pytest_plugins = ["fabctl.testing"]  # what a lab's own tests get by installing the package
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of published data and recorded dialogues, which is not part of the project."""
    path = Path(os.environ.get("FABCTL_SHARED", ROOT.parent / "shared"))
    if not path.is_dir():
        pytest.skip(f"the shared data are not beside the project ({path}); set FABCTL_SHARED")
    return path


def pytest_addoption(parser: pytest.Parser) -> None:
    """Offer the options of `tests/hardware`: real devices by URL, and what they may do."""
    group = parser.getgroup("hardware", "real devices (tests/hardware)")
    group.addoption("--laser-url", help="a GRBL laser: serial:///dev/ttyUSB0?baud=115200, a pty, or tcp://host:port")
    group.addoption("--rig-url", help="an indentation rig: modbus-tcp://host:502?unit=1 or modbus-rtu:///dev/…")
    group.addoption("--allow-motion", action="store_true", help="the devices may move")
    group.addoption("--allow-beam", action="store_true", help="the laser may burn, at low power; needs --allow-motion")
