"""A host that loads a specimen and says on its standard output which rows the disk has: made to be killed.

python -m benchmarks._rig_host URL FOLDER
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from drivers.clock import WallClock
from drivers.rig.indenter import open_indenter
from fabctl.config.method import Approach, LimitsConfig, Load, MethodConfig, Tare
from fabctl.config.rig import load_rig
from fabctl.events import Event
from fabctl.indent.method import actions
from fabctl.indent.recorder import Recorder
from fabctl.indent.run import Runner

ROOT = Path(__file__).resolve().parents[1]
SPEED_MM_S, WATCHDOG_S = 2.0, 0.2
METHOD = MethodConfig(
    name="killed",
    safe_height_mm=0.2,
    limits=LimitsConfig(force_N=15.0, travel_mm=50.0, watchdog_s=WATCHDOG_S),
    steps=(
        Tare(step="tare", time_s=0.2),
        Approach(step="approach", speed_mm_s=5.0, trigger_N=0.05, clearance_mm=0.3),
        Load(step="load", depth_mm=20.0, speed_mm_s=SPEED_MM_S),
    ),
)


def main(url: str, folder: str) -> None:
    """Load until somebody kills this process."""
    recorder: list[Recorder] = []

    def sync(handle: int) -> None:
        # What was acknowledged before is told before the next wait begins: never more than the disk has.
        os.write(1, f"ack {recorder[0].acknowledged_count if recorder else 0}\n".encode())
        os.fdatasync(handle)

    def listen(event: Event) -> None:
        if event.kind == "state" and event.message.startswith("load"):
            os.write(1, b"loading\n")

    recorder.append(Recorder(Path(folder) / "samples.csv", sync))
    rig = open_indenter(url, load_rig("reference", ROOT))
    Runner(rig, METHOD, actions(METHOD), recorder[0], WallClock(), 100.0, listen).execute()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
