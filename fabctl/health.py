"""Look at a machine and a bench without moving anything."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

from fabctl.bench import open_bench
from fabctl.config.bench import BenchConfig, load_bench
from fabctl.errors import FabctlError
from fabctl.workspace import Workspace

IMPORTS = (
    ("numpy", "numpy"),
    ("scipy", "scipy.sparse.linalg"),
    ("libigl", "igl"),
    ("pyserial", "serial"),
    ("pymodbus", "pymodbus.client"),
    ("opencv", "cv2"),
    ("open3d", "open3d"),
    ("ezdxf", "ezdxf"),
    ("pyyaml", "yaml"),
)
OPEN3D_HINT = "sudo apt-get install -y libegl1 libgl1 libx11-6 libusb-1.0-0 libgomp1"
LOOK_S = 0.5
ROOM_BYTES = 500e6  # a run with its wire log, a scan of millions of points and an export


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at."""

    what: str
    works: bool
    detail: str
    hint: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the check as plain JSON."""
        return asdict(self)


def machine_checks(lab: Workspace) -> Iterator[Check]:
    """Yield what speaks for and against this machine, each as soon as it is known."""
    good = (3, 11) <= sys.version_info[:2] <= (3, 13)
    yield Check("python", good, platform.python_version(), "" if good else "3.11, 3.12 or 3.13 is needed")
    for name, module in IMPORTS:
        yield _import(name, module)
    yield _folder(lab)
    yield _library()


def bench_checks(lab: Workspace, name: str) -> Iterator[Check]:
    """Yield what the devices of a bench say of themselves; nothing is moved and no setting is written."""
    config = load_bench(name, lab.root)
    try:
        with open_bench(lab, config, "doctor") as bench:
            yield Check("bench", True, f"{config.name}, free")
            if config.laser is not None:
                yield _device("laser", lambda: _ask_laser(bench.url("laser")))
            if config.rig is not None:
                rig_map = config.rig.map
                yield _device("rig", lambda: _ask_rig(bench.url("rig"), rig_map, lab))
            if config.camera is not None:
                yield _device("camera", lambda: _ask_camera(bench.url("camera")))
    except FabctlError as fault:
        yield Check("bench", False, str(fault))
        return
    if config.scan is not None:
        yield _scan_source(config, lab)


def _import(name: str, module: str) -> Check:
    # In a process of its own: a library that crashes at import must not take the doctor along.
    done = subprocess.run(
        [sys.executable, "-c", f"import {module}"], capture_output=True, text=True, check=False, timeout=120
    )
    if done.returncode == 0:
        return Check(name, True, f"{module} imports")
    last = done.stderr.strip().splitlines()[-1:] or [f"exit {done.returncode}"]
    return Check(name, False, last[0], OPEN3D_HINT if name == "open3d" and ".so" in last[0] else "make setup")


def _folder(lab: Workspace) -> Check:
    root = lab.root
    if not root.exists() and os.access(root.parent, os.W_OK):
        return Check("lab folder", True, f"{root} is not there yet; the first run makes it")
    if not root.is_dir() or not os.access(root, os.W_OK):
        return Check("lab folder", False, f"{root} cannot be written", "name another with --home or $FABCTL_HOME")
    free = shutil.disk_usage(root).free
    text = f"{root}, {free / 1e9:.1f} GB free"
    return Check("lab folder", free > ROOM_BYTES, text, "" if free > ROOM_BYTES else "make room before a run")


def _library() -> Check:
    from design.cells.library import load_library
    from design.errors import DesignError

    try:
        library = load_library()
    except (DesignError, OSError, ValueError) as fault:
        return Check("cell library", False, str(fault), "fabctl library build")
    low, high = library.range_ratio()
    return Check("cell library", True, f"{len(library.t_mm)} cells, expansion {low:.3f} to {high:.3f}")


def _device(name: str, ask: Callable[[], str]) -> Check:
    from drivers.errors import DeviceError

    try:
        return Check(name, True, ask())
    except (DeviceError, FabctlError, OSError) as fault:
        return Check(name, False, str(fault))


def _ask_laser(url: str) -> str:
    from drivers.grbl.laser import Laser
    from drivers.grbl.messages import Listener, Report
    from drivers.transport import open_transport

    transport = open_transport(url)
    try:
        # Connecting resets the board, which would end a job that another program runs: look first.
        transport.write(b"?")
        listener, until_s = Listener(), time.monotonic() + LOOK_S
        while time.monotonic() < until_s:
            for message in listener.feed(transport.read(0.1)):
                if isinstance(message, Report) and message.moving:
                    return f"busy: it reports {message.state}; left alone"
        laser = Laser(transport)
        identity = laser.connect()
        travel = "x".join(f"{identity.setting(number) or 0:g}" for number in (130, 131))
        mode = "on" if identity.is_on(32) else "OFF: the cut will be refused"
        return f"{identity.firmware} {identity.version}, travel {travel} mm, laser mode {mode}"
    finally:
        transport.close()


def _ask_rig(url: str, rig_map: str, lab: Workspace) -> str:
    from drivers.rig.bus import open_bus
    from drivers.rig.indenter import Indenter
    from fabctl.config.rig import load_rig

    registers = load_rig(rig_map, lab.root)
    bus = open_bus(url, registers.timeout_s, registers.response_max_s)
    try:
        found = Indenter(bus, registers).identify()
    finally:
        bus.close()
    return (
        f"{found.model} no. {found.serial}, {found.capacity_N:g} N, {found.travel_mm:g} mm, firmware {found.firmware}"
    )


def _ask_camera(url: str) -> str:
    from drivers.camera import snapshot

    height, width = snapshot(url).image.shape[:2]
    return f"{width}x{height} pixels"


def _scan_source(config: BenchConfig, lab: Workspace) -> Check:
    assert config.scan is not None
    if config.scan.inbox is not None:
        path = lab.root / config.scan.inbox
        return Check("scan inbox", path.is_dir(), str(path), "" if path.is_dir() else f"mkdir {path}")
    program = (config.scan.command or "").split()[0]
    there = shutil.which(program) is not None
    return Check("scan command", there, config.scan.command or "", "" if there else f"{program} is not on the PATH")
