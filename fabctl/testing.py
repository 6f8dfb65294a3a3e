"""pytest fixtures for a lab's own tests: a simulated laser, rig or whole bench, as processes behind real ports.

They come with the package (`pip install fabctl` is enough; pytest finds them by entry point):

    def test_our_dome(simulated_bench):
        run = simulated_bench.fabctl("flow", "dome.yaml", "--json")
        assert run["scan"]["passed"]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fabctl.config.bench import load_bench
from fabctl.simulated import start, stop
from fabctl.workspace import Workspace


@dataclass(frozen=True)
class SimulatedBench:
    """A lab's folder with a running simulated bench in it."""

    lab: Workspace
    urls: dict[str, str]

    def fabctl(self, *words: str, expect: int = 0, timeout_s: float = 600.0) -> dict[str, Any]:
        """Run the command line in this lab with `--json`; return its object, or fail with what it said."""
        command = [sys.executable, "-m", "fabctl", "--home", str(self.lab.root), *words, "--json"]
        path = os.pathsep.join(filter(None, [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH")]))
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            cwd=self.lab.root,
            env={**os.environ, "PYTHONPATH": path},
        )
        if done.returncode != expect:
            pytest.fail(
                f"{' '.join(words)}: exit {done.returncode}, not {expect}\n{done.stderr[-4000:]}", pytrace=False
            )
        found: dict[str, Any] = json.loads(done.stdout) if done.stdout.strip() else {}
        return found


def _bench(root: Path, only: tuple[str, ...] = ()) -> Iterator[SimulatedBench]:
    lab = Workspace(root)
    config = load_bench("sim", lab.root)
    state = lab.bench_state(config.name)
    try:
        found = start(config, state, only)
        yield SimulatedBench(lab, {name: str(facts["url"]) for name, facts in found.items()})
    finally:
        stop(state)


@pytest.fixture
def simulated_bench(tmp_path: Path) -> Iterator[SimulatedBench]:
    """Return a lab in a temporary folder with every simulator of the bench `sim` running."""
    yield from _bench(tmp_path)


@pytest.fixture
def simulated_laser(tmp_path: Path) -> Iterator[str]:
    """Return the URL of a running simulated GRBL laser."""
    for bench in _bench(tmp_path, ("laser",)):
        yield bench.urls["laser"]


@pytest.fixture
def simulated_rig(tmp_path: Path) -> Iterator[str]:
    """Return the URL of a running simulated indentation rig."""
    for bench in _bench(tmp_path, ("rig",)):
        yield bench.urls["rig"]
