"""How long the command line takes to say what it can do: `python -m benchmarks cli`."""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

from benchmarks import Figure

RUNS_COUNT = 15
LIMIT_S = 0.2
HEAVY = ("numpy", "scipy", "open3d", "cv2", "ezdxf", "igl", "matplotlib", "pydantic", "yaml", "serial", "pymodbus")


def measure(_: list[str]) -> list[Figure]:
    """Return the start-up figures: wall and processor time of `fabctl --help`, and what it imports."""
    wall_s, cpu_s = zip(*(_one(["--help"]) for _ in range(RUNS_COUNT)), strict=True)
    empty_s = statistics.median(_one_empty() for _ in range(RUNS_COUNT))
    middle_s = statistics.median(wall_s)
    return [
        Figure("fabctl --help, wall, median", round(middle_s, 3), "s", "under 0.2 s", middle_s < LIMIT_S, RUNS_COUNT),
        Figure("fabctl --help, processor, median", round(statistics.median(cpu_s), 3), "s", "", None, RUNS_COUNT),
        Figure("against an empty interpreter", round(middle_s / empty_s, 2), "times", "", None, RUNS_COUNT),
        Figure("heavy packages imported by --help", len(_imported()), "packages", "", None, 1),
    ]


def _one(words: list[str]) -> tuple[float, float]:
    root = Path(__file__).resolve().parents[1]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began_s = time.perf_counter()
    subprocess.run([sys.executable, "-m", "fabctl", *words], cwd=root, capture_output=True, check=True)
    wall_s = time.perf_counter() - began_s
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _one_empty() -> float:
    began_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", "pass"], check=True)
    return time.perf_counter() - began_s


def _imported() -> list[str]:
    root = Path(__file__).resolve().parents[1]
    command = [sys.executable, "-X", "importtime", "-m", "fabctl", "--help"]
    said = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stderr
    names = {
        line.rsplit("|", 1)[-1].strip().split(".")[0] for line in said.splitlines() if line.startswith("import time")
    }
    return [name for name in HEAVY if name in names]
