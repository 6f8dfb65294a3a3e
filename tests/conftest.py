"""What every test may ask for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of published data and recorded dialogues, which is not part of the project."""
    path = Path(os.environ.get("FABCTL_SHARED", ROOT.parent / "shared"))
    if not path.is_dir():
        pytest.skip(f"the shared data are not beside the project ({path}); set FABCTL_SHARED")
    return path
