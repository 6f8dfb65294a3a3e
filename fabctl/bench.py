"""The bench while somebody works at it: locked, with the URL of each device resolved.

Nothing here knows whether a device is simulated. A URL `ready:NAME` means the one that the started process NAME
announced; everything else is taken as written.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from design.findings import Finding
from fabctl.config.bench import BenchConfig
from fabctl.errors import BenchBusy, RefusedError, UsageError
from fabctl.records.folder import RunFolder, person, write_atomically
from fabctl.workspace import Workspace

READY = "ready:"
HELD = "FABCTL_BENCH_HELD"  # the open lock that a flow hands down to its steps, by number


@dataclass(frozen=True)
class Bench:
    """A bench that is ours while the lock holds."""

    config: BenchConfig
    state: Path
    lock: int = -1

    def url(self, device: str) -> str:
        """Return the URL of `laser`, `rig` or `camera`; raise `UsageError` where the bench has none."""
        section = getattr(self.config, device)
        if section is None:
            raise UsageError(f"bench {self.config.name} has no {device}; add one to its file")
        return resolve(str(section.url), self.config.name, self.state)

    @property
    def slot(self) -> Path | None:
        """Return the folder into which a job lays the specimen's two files, or None on a real bench."""
        if self.config.specimen_slot is None:
            return None
        path = Path(self.config.specimen_slot.replace("{state}", str(self.state)))
        path.mkdir(parents=True, exist_ok=True)
        return path

    def lay(self, design: Path) -> None:
        """Lay the specimen made from the folder `design` on the bench, where the bench has a slot."""
        slot = self.slot
        if slot is None:
            return
        for name in ("deployed.ply", "response.csv"):
            if not (design / name).is_file():
                (slot / name).unlink(missing_ok=True)  # a design without a prediction must not inherit the last one's
                continue
            draft = slot / f".{name}.new"
            shutil.copyfile(design / name, draft)
            draft.replace(slot / name)


def resolve(url: str, bench: str, state: Path) -> str:
    """Return `url` with the state folder put in, and `ready:NAME` replaced by what that process announced."""
    if not url.startswith(READY):
        return url.replace("{state}", str(state))
    name = url.removeprefix(READY)
    found = announced(state).get(name)
    if found is None:
        raise UsageError(f"bench {bench}: {name} is not running; start it with `fabctl sim up --bench {bench}`")
    return str(found["url"])


def announced(state: Path) -> dict[str, dict[str, Any]]:
    """Return what the started simulators said of themselves: name -> url, process."""
    path = state / "simulators.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): facts for name, facts in found.items() if {"url", "process", "began"} <= set(facts)}
    except FileNotFoundError:
        return {}
    except (ValueError, TypeError, AttributeError):
        return {}  # damaged: `sim up` writes it anew, and a simulator that still runs keeps its own port


@contextlib.contextmanager
def open_bench(lab: Workspace, config: BenchConfig, purpose: str) -> Iterator[Bench]:
    """Hold the bench for one job; raise `BenchBusy` saying who has it, for what, since when.

    The lock is the operating system's: it ends with the process, however that ends, and counts for everybody on this
    machine who names the same devices. A step of a flow works under the flow's own lock.
    """
    state = lab.bench_state(config.name)
    place = _lock_path(config, state)
    handed = _handed_down(place)
    if handed is not None:
        yield Bench(config, state, handed)
        return
    handle = os.open(place, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(handle, 4096, 0).decode(errors="replace").strip() or "somebody"
            raise BenchBusy(f"bench {config.name} is in use by {holder}; wait, or stop that job first") from None
        since = datetime.now(UTC).astimezone().strftime("%Y-%m-%d %H:%M:%S")
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"{person()} (process {os.getpid()}): {purpose}, since {since}".encode(), 0)
        yield Bench(config, state, handle)
    finally:
        os.close(handle)


def _handed_down(place: Path) -> int | None:
    """Return the open lock of this bench that the process inherited from a flow, or None.

    The number alone proves nothing: it must be this bench's file, and the lock of whoever opened it.
    """
    with contextlib.suppress(ValueError, OSError):
        handle = int(os.environ.get(HELD, ""))
        if os.path.samestat(os.fstat(handle), place.stat()):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return handle
    return None


def _lock_path(config: BenchConfig, state: Path) -> Path:
    devices = [getattr(config, name) for name in ("laser", "rig", "camera")]
    urls = "|".join(str(d.url).replace("{state}", str(state)) for d in devices if d is not None)
    places = str(state) if READY in urls else ""
    key = hashlib.sha256(f"{config.name}|{urls}|{places}".encode()).hexdigest()[:12]
    folder = Path(tempfile.gettempdir()) / "fabctl-locks"
    folder.mkdir(exist_ok=True)
    with contextlib.suppress(PermissionError):  # somebody else made it, for all
        folder.chmod(0o1777)
    return folder / f"{config.name}-{key}.lock"


def deployment_checklist(config: BenchConfig, specimen: str) -> tuple[str, ...]:
    """Return what a person does between the cut and the test."""
    return (
        f"1. Take {specimen} from the bed; check with a light that every slit is through.",
        "2. Pull the border outwards unit by unit until each has snapped open; work from the rim to the middle.",
        "3. Push the surface to its side (the engraved id reads from outside).",
        "4. Let it rest as long as the method asks; note thickness and batch: "
        f"fabctl specimen note {specimen} thickness_mm=2.3 batch=…",
        f"5. Clamp the rim in the rig's ring, the apex under the indenter. Then: fabctl flow --continue {specimen} "
        f"--bench {config.name}",
    )


def refuse_without(config: BenchConfig, *devices: str) -> None:
    """Raise `RefusedError` naming every device of `devices` that the bench lacks."""
    missing = [
        Finding("BENCH-DEVICE", f"no {name} in the bench file", where=config.name, hint=f"add a {name}: section")
        for name in devices
        if getattr(config, name) is None
    ]
    if missing:
        raise RefusedError(f"bench {config.name} cannot do this job", missing)


def begun_elsewhere(before: RunFolder, bench: BenchConfig) -> list[Finding]:
    """Return what speaks against going on with a run on this bench: that it was begun on another one."""
    there = (before.manifest().get("config", {}).get("bench") or {}).get("name")
    if there in (None, bench.name):
        return []
    text = f"{before.run_id} was begun on bench {there}, this is {bench.name}"
    return [Finding("RESUME-BENCH", text, hint=f"go on there: --bench {there}")]


def remember(state: Path, found: dict[str, dict[str, Any]]) -> None:
    """Write down which simulators run, atomically."""
    write_atomically(state / "simulators.json", json.dumps(found, indent=1) + "\n")
