"""`python -m simulators DEVICE [options]`: each device is imported only when it is asked for."""

from __future__ import annotations

import importlib
import sys

# word -> module with main(words) -> exit code
DEVICES = {
    "grbl": "simulators.grbl.main",
    "rig": "simulators.rig.program",
    "scanner": "simulators.scanner",
    "camera": "simulators.camera.main",
}


def main(words: list[str]) -> int:
    """Run one virtual device."""
    if not words or words[0] not in DEVICES:
        print(f"usage: python -m simulators {{{'|'.join(DEVICES)}}} [--help]", file=sys.stderr)
        return 2
    code: int = importlib.import_module(DEVICES[words[0]]).main(words[1:])
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
