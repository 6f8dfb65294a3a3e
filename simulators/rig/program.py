"""`python -m simulators rig`: a virtual indentation rig behind Modbus TCP or RTU."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from simulators.rig.controller import APEX, Controller, Machine
from simulators.rig.faults import ENDINGS, KINDS, FaultyLine
from simulators.rig.grams import Grams
from simulators.rig.server import Pace, Server
from simulators.specimens.analytic import BY_NAME
from simulators.specimens.curve import Curves, Place, Specimen
from simulators.specimens.relief import ReliefError, read_relief
from simulators.specimens.slot import SlotError, read_mass_kg, read_response

GRAVITY_N_KG = 9.80665
MAKERS: dict[str, type[Controller]] = {"reference": Controller, "grams": Grams}


class Truth:
    """The answer key: what was drawn, and what happened when. Only tests open it."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._events = None
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            self._events = (folder / "rig-events.jsonl").open("a", buffering=1)

    def event(self, tick: int, kind: str, facts: dict[str, Any]) -> None:
        """Write one line."""
        if self._events is not None:
            self._events.write(json.dumps({"tick": tick, "event": kind, **facts}) + "\n")

    def key(self, facts: dict[str, Any]) -> None:
        """Write what was drawn for the specimen that lies there now."""
        if self._folder is not None:
            draft = self._folder / ".rig-truth.json"
            draft.write_text(json.dumps(facts, indent=1))
            draft.replace(self._folder / "rig-truth.json")


class Slot:
    """The folder in which a job lays a specimen; looked at whenever the rig is armed."""

    def __init__(self, folder: Path | None, words: argparse.Namespace, truth: Truth) -> None:
        self._folder, self._words, self._truth = folder, words, truth
        self._seen: object = None

    def look(self, device: Controller) -> None:
        """Put what lies in the slot on the rig, where it is something new."""
        self.weigh(device)
        response = self._path("response.csv")
        stat = response.stat() if response is not None else None
        seen = (stat.st_mtime_ns, stat.st_size, stat.st_ino) if stat else "none"
        if seen == self._seen:
            return
        self._seen = seen
        try:
            curves = read_response(response) if response is not None else None
        except (SlotError, OSError) as fault:
            print(f"rig: {fault}", file=sys.stderr, flush=True)
            curves = None
        if curves is None and self._words.specimen:
            curves = BY_NAME[self._words.specimen]()
        device.specimen = specimen_of(curves, self._words) if curves else None
        device.place = self._relief(response)
        device.look_under()
        self._truth.key(answer_key(device, curves, str(response or self._words.specimen), self._words.loss))

    def _relief(self, response: Path | None) -> Callable[[float, float], Place | None]:
        """Return how the surface lies at other places; flat where the slot holds no mesh that can be read."""
        mesh = self._path("deployed.ply")
        if mesh is None or response is None:
            return lambda _x, _y: APEX
        try:
            return read_relief(mesh, response).at
        except ReliefError as fault:
            print(f"rig: {fault}; every place answers as the apex", file=sys.stderr, flush=True)
            return lambda _x, _y: APEX

    def weigh(self, device: Controller) -> None:
        """Put the mass that lies in the slot on the load cell; a file `estop` there is the button, pressed."""
        mass = self._path("mass_kg.txt")
        device.hung_N = read_mass_kg(mass) * GRAVITY_N_KG if mass is not None else 0.0
        device.estop_open = self._path("estop") is not None

    def _path(self, name: str) -> Path | None:
        return self._folder / name if self._folder is not None and (self._folder / name).is_file() else None


def specimen_of(curves: Curves, words: argparse.Namespace) -> Specimen:
    """Return a fresh specimen with the rubber's history effects asked for."""
    unload = [(1 - words.loss) * force for force in curves.unload_N] if words.loss else curves.unload_N
    curves = Curves(curves.step_mm, curves.load_N, unload)
    return Specimen(curves, virgin_ratio=words.virgin, creep_ratio=words.creep, creep_s=words.creep_s)


def answer_key(device: Controller, curves: Curves | None, source: str, loss_ratio: float) -> dict[str, Any]:
    """Return the true values behind what the rig will show."""
    m = device.machine
    return {
        "source": source,
        "seed": device.seed,
        "contact_mm": m.contact_mm,
        "compliance_mm_N": m.compliance_mm_N,
        "gain_ratio": m.gain_ratio,
        "zero_N": m.zero_N,
        "noise_N": m.noise_N,
        "drift_N_s": m.drift_N_s,
        "backlash_mm": m.backlash_mm,
        "loss_ratio": loss_ratio,
        "secant_2mm_N_mm": curves.load_N[round(2 / curves.step_mm)] / 2 if curves and curves.depth_max_mm > 2 else None,
    }


def parse(words: list[str]) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(prog="python -m simulators rig", description=__doc__)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--tcp", type=int, metavar="PORT", help="listen on 127.0.0.1:PORT (0: a free one)")
    where.add_argument("--rtu", metavar="PTY", help="make a pseudo-terminal and link PTY to it")
    parser.add_argument("--slot", type=Path, metavar="DIR", help="folder of the specimen, read when the rig is armed")
    parser.add_argument("--truth", type=Path, metavar="DIR", help="folder for the answer key")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--specimen", choices=sorted(BY_NAME), help="what lies there while the slot is empty")
    parser.add_argument("--unit", type=int, default=1)
    parser.add_argument("--registers", choices=sorted(MAKERS), default="reference", help="whose register map")
    parser.add_argument("--baud", type=int, default=115200, help="pace of the serial line; 0: as fast as it goes")
    parser.add_argument("--turnaround-ms", type=float, default=1.0)
    parser.add_argument("--noise-N", type=float, default=3e-4, help="of one conversion, a thousand a second")
    parser.add_argument("--drift-N-s", type=float, help="[drawn from the seed, up to 5 µN/s]")
    parser.add_argument("--zero-N", type=float, help="[drawn, up to 20 mN]")
    parser.add_argument("--capacity-N", type=float, default=20.0)
    parser.add_argument("--gain", type=float, help="[drawn, within 0.5 %%]")
    parser.add_argument("--contact-mm", type=float, help="[drawn, 5 to 7 mm below home]")
    parser.add_argument("--compliance-mm-N", type=float, default=0.02)
    parser.add_argument("--backlash-mm", type=float, default=0.004)
    parser.add_argument(
        "--loss", type=float, default=0.06, help="share of the force that the rubber keeps on the way out"
    )
    parser.add_argument("--virgin", type=float, default=0.0, help="what a first loading costs more, as a share")
    parser.add_argument("--creep", type=float, default=0.0, help="share of the force that relaxes")
    parser.add_argument("--creep-s", type=float, default=5.0)
    parser.add_argument("--fault-rate", type=float, default=0.0, help="share of the replies that go wrong")
    parser.add_argument("--faults", default=",".join(KINDS), help="kinds of faults: " + ", ".join((*KINDS, *ENDINGS)))
    parser.add_argument("--late-ms", type=float, nargs=2, default=(120.0, 140.0), metavar=("LEAST", "MOST"))
    return parser.parse_args(words)


def drawn(words: argparse.Namespace) -> Machine:
    """Return the machine, with what was not given drawn from the seed."""
    rng = random.Random(words.seed)
    given = {
        "drift_N_s": words.drift_N_s,
        "zero_N": words.zero_N,
        "gain_ratio": words.gain,
        "contact_mm": words.contact_mm,
    }
    machine = Machine(
        noise_N=words.noise_N,
        capacity_N=words.capacity_N,
        compliance_mm_N=words.compliance_mm_N,
        backlash_mm=words.backlash_mm,
        drift_N_s=rng.uniform(-5e-6, 5e-6),
        zero_N=rng.uniform(-0.02, 0.02),
        gain_ratio=rng.uniform(0.995, 1.005),
        contact_mm=rng.uniform(5.0, 7.0),
    )
    return replace(machine, **{name: value for name, value in given.items() if value is not None})


def hurry() -> None:
    """Ask for the priority of a controller that has a processor of its own; without leave it goes on as it is."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def main(words: list[str]) -> int:
    """Serve until SIGTERM."""
    options = parse(words)
    hurry()
    truth = Truth(options.truth)
    device = MAKERS[options.registers](drawn(options), seed=options.seed)
    device.tell = lambda kind, facts: truth.event(device.tick_count, kind, facts)
    slot = Slot(options.slot, options, truth)
    device.on_arm = slot.look
    line = FaultyLine(
        options.fault_rate,
        [kind for kind in options.faults.split(",") if kind],
        options.seed,
        (options.late_ms[0] / 1e3, options.late_ms[1] / 1e3),
        device.tell,
    )
    pace = Pace(options.baud if options.rtu else 0, 11, options.turnaround_ms / 1e3 if options.rtu else 0.0)
    weighed_s = [0.0]

    def now_and_then() -> None:
        if time.monotonic() - weighed_s[0] > 0.1:
            weighed_s[0] = time.monotonic()
            slot.weigh(device)

    server = Server(device, line, pace, options.unit, each_turn=now_and_then)
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _frame: stopped.append(got))
    url = server.listen_tcp(options.tcp) if options.rtu is None else server.listen_rtu(options.rtu)
    print(f"ready {url}", flush=True)
    try:
        server.run(lambda: not stopped)
    finally:
        server.close()
    return 0
