"""Run the main job on simulated devices and say where the report lies. Called by `make demo`."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def fabctl(home: Path, *words: str) -> str:
    """Run the tool in `home`; progress goes to the terminal, the JSON comes back."""
    command = [sys.executable, "-m", "fabctl", "--home", str(home), *words]
    print(f"$ fabctl {' '.join(words)}", file=sys.stderr)
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        command, stdout=subprocess.PIPE, text=True, check=False, env={**os.environ, "PYTHONPATH": path}
    )
    if done.returncode not in (0, 6):  # 6: out of tolerance is a result, and the report says so
        sys.exit(done.returncode)
    return done.stdout


def main() -> None:
    """Start the bench, run the flow, stop the bench, print the report's place."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("spec", nargs="?", default=str(ROOT / "configs/specs/cap.yaml"), help="specification to run")
    parser.add_argument("--home", type=Path, default=ROOT / "demo", help="the lab's folder to make")
    parser.add_argument("--target", help="another target surface than the specification's")
    asked = parser.parse_args()
    began_s = time.monotonic()
    if asked.home.exists():
        fabctl(asked.home, "sim", "down", "--bench", "sim")
        shutil.rmtree(asked.home)
    asked.home.mkdir(parents=True)
    target = ["--target", str(Path(asked.target).resolve())] if asked.target else []
    try:
        fabctl(asked.home, "sim", "up", "--bench", "sim")
        found = json.loads(fabctl(asked.home, "flow", asked.spec, *target, "--bench", "sim", "--yes", "--json"))
    finally:
        fabctl(asked.home, "sim", "down", "--bench", "sim")
    print(f"\n{found['specimen']}: {found['sentence']}")
    print(f"done in {time.monotonic() - began_s:.0f} s; the report: {found['report']}")


if __name__ == "__main__":
    main()
