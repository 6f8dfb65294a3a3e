"""Kill the host while it loads, and see what the controller and the disk make of it."""

from __future__ import annotations

import contextlib
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks._rig_host import SPEED_MM_S, WATCHDOG_S
from drivers.rig.indenter import Limits, open_indenter
from drivers.rig.samples import Sample
from fabctl.config.rig import load_rig
from fabctl.indent.analysis import read_samples

ROOT = Path(__file__).resolve().parents[1]
STIFFNESS_N_MM = 0.5
WATCHDOG_BIT = 2
LIMITS = Limits(15.0, -2.0, 0.0, 50.0, 0.2, 50.0, 0.5)


@dataclass
class Kills:
    """What fifty kills showed."""

    kills_count: int = 0
    stop_ms: list[float] = field(default_factory=list)  # from the last feed to the watchdog's stop
    overshoot_N: list[float] = field(default_factory=list)
    overshoot_allowed_N: float = SPEED_MM_S * STIFFNESS_N_MM * (WATCHDOG_S + 0.05)
    rows_lost_count: int = 0
    not_stopped_count: int = 0


@contextlib.contextmanager
def rig_process(truth: Path, *words: str) -> Iterator[str]:
    """Run the simulator; yield its URL."""
    command = [sys.executable, "-m", "simulators", "rig", "--tcp", "0", "--truth", str(truth), *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().split()[1]
    finally:
        process.terminate()
        process.wait(timeout=10)
        process.stdout.close()


def kill_while_loading(folder: Path, kills_count: int, seed: int = 1) -> Kills:
    """Kill a loading host `kills_count` times with SIGKILL."""
    found, rng = Kills(), random.Random(seed)
    truth = folder / "truth"
    spring = ("--specimen", "linear", "--contact-mm", "4", "--noise-N", "0", "--loss", "0", "--compliance-mm-N", "0")
    with rig_process(truth, *spring, "--gain", "1") as url:
        for k in range(kills_count):
            own = folder / f"host-{k}"
            own.mkdir()
            acknowledged = _load_and_kill(url, own, rng.uniform(0.2, 1.2))
            kept = read_samples(own / "samples.csv")
            found.rows_lost_count += max(0, acknowledged - len(kept.time_s))
            after = _after(url)
            found.not_stopped_count += "watchdog" not in after.faults
            found.overshoot_N.append(after.force_N - float(kept.force_N[-1]) - float(_tare_N(own)))
            found.kills_count += 1
    for line in (truth / "rig-events.jsonl").read_text().splitlines():
        event = json.loads(line)
        if event["event"] == "fault" and event["bit"] == WATCHDOG_BIT:
            found.stop_ms.append(float(event["tick"] - event["last_feed"]))
    return found


def _load_and_kill(url: str, folder: Path, after_s: float) -> int:
    """Start a host, kill it `after_s` into its loading; return how many rows it had acknowledged."""
    command = [sys.executable, "-m", "benchmarks._rig_host", url, str(folder)]
    host = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env={**os.environ})
    assert host.stdout is not None
    said = []
    for line in host.stdout:
        said.append(line)
        if line.startswith("loading"):
            break
    time.sleep(after_s)
    host.kill()
    said += host.stdout.read().splitlines()
    host.wait()
    host.stdout.close()
    return max((int(line.split()[1]) for line in said if line.startswith("ack ")), default=0)


def _after(url: str) -> Sample:
    """Wait until the watchdog must have bitten; return what the controller shows, and bring the stage up again."""
    time.sleep(WATCHDOG_S + 0.3)
    rig = open_indenter(url, load_rig("reference", ROOT))
    with contextlib.closing(rig):
        now = rig.fresh_sample()
        rig.clear_faults()
        rig.set_limits(LIMITS)
        rig.arm()
        rig.wait(rig.move(0.5, 20.0), 20.0)
        rig.disarm()
    return now


def _tare_N(folder: Path) -> float:
    """Return the tare that was taken off, from the last row's gross and net force."""
    last = (folder / "samples.csv").read_text().rstrip("\n").splitlines()[-1].split(",")
    return float(last[3]) - float(last[4])
