"""The run folder: what was asked, what happened, what came out. Written so that nothing acknowledged is lost.

`manifest.json` is there before anything moves, `outcome.json` comes last and atomically; a run without it was
interrupted, and is still readable.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import platform
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import IO, Any

from fabctl.errors import RecordError
from fabctl.events import Event
from fabctl.records.ending import undisturbed

FORMAT = 1
ENDS = ("done", "stopped", "failed", "refused")
LIBRARIES = ("numpy", "scipy", "libigl", "pyserial", "pymodbus", "opencv-contrib-python-headless", "open3d", "ezdxf")


def sha256(path: Path) -> str:
    """Return the file's hash, hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text or bytes so that after a crash the file is either absent (or as before) or whole."""
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with draft.open("wb") as stream:
            stream.write(content.encode() if isinstance(content, str) else content)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
        sync_folder(path.parent)
    except OSError as fault:
        draft.unlink(missing_ok=True)
        raise RecordError(f"{path}: cannot be written: {fault.strerror or fault}") from fault


def sync_folder(folder: Path) -> None:
    """Make a new name in `folder` durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def as_json(data: Any) -> str:
    """Return `data` as the JSON text that every record uses: sorted, one space deep, no NaN."""
    return json.dumps(data, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False, default=str) + "\n"


def versions() -> dict[str, str]:
    """Return the versions a result may depend on."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("fabctl", *LIBRARIES):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


class DurableLog:
    """An append-only text file whose `append` returns only when the lines are on the disk.

    `sync` is the place a test listens at: acknowledgement must follow it.
    """

    def __init__(self, path: Path, header: str = "", sync: Callable[[int], None] = os.fdatasync) -> None:
        self._sync = sync
        self.path = path
        try:
            self._stream: IO[bytes] = path.open("ab", buffering=0)
            if header and self._stream.tell() == 0:
                self.append([header])
        except OSError as fault:
            raise RecordError(f"{path}: cannot be opened: {fault.strerror or fault}") from fault

    def append(self, lines: Sequence[str]) -> None:
        """Write whole lines and wait until they are durable."""
        payload = "".join(line + "\n" for line in lines).encode()
        try:
            written = self._stream.write(payload)
            if written != len(payload):
                raise OSError(28, "the disk took only part of the rows")
            self._sync(self._stream.fileno())
        except OSError as fault:
            raise RecordError(
                f"{self.path}: {fault.strerror or fault}; what was acknowledged before is kept"
            ) from fault

    def close(self) -> None:
        """Close the file; further appends fail."""
        self._stream.close()


@dataclass(frozen=True)
class RunFolder:
    """One run on disk. Made by `start_run`; never overwritten."""

    path: Path

    @property
    def run_id(self) -> str:
        """Return the folder's name, which is the run's id."""
        return self.path.name

    def artefact(self, name: str) -> Path:
        """Return the path of a file the run made or used; the folder exists."""
        (self.path / "artefacts").mkdir(exist_ok=True)
        return self.path / "artefacts" / name

    def manifest(self) -> dict[str, Any]:
        """Return what was asked."""
        return _read(self.path / "manifest.json")

    def result(self) -> dict[str, Any] | None:
        """Return what came out, or None while there is nothing."""
        return _read(self.path / "result.json") if (self.path / "result.json").exists() else None

    def outcome(self) -> dict[str, Any] | None:
        """Return how it ended, or None for a run that is going on or was interrupted."""
        path = self.path / "outcome.json"
        found = _read(path) if path.exists() else None
        if found is not None and found.get("status") not in ENDS:
            raise RecordError(f"{path}: not how a run ended; put that file away, and the run counts as interrupted")
        return found

    def log_events(self) -> Callable[[Event], None]:
        """Return a listener that writes events to `events.jsonl`, with the time they came."""
        path = self.path / "events.jsonl"

        def listen(event: Event) -> None:
            row: dict[str, Any] = {
                "utc": _utc().isoformat(),
                "kind": event.kind,
                "message": event.message,
                "data": event.data,
            }
            if event.done_frac is not None:
                row["done_frac"] = event.done_frac
            with path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row, default=str) + "\n")

        return listen

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Write what came out, atomically; may be called again with more."""
        write_atomically(self.path / "result.json", as_json(dict(result)))

    def finish(self, status: str, message: str = "", **details: Any) -> None:
        """Close the run: `status` is done, stopped, failed or refused. An interrupt meanwhile comes afterwards."""
        body = {"status": status, "message": message, "finished_utc": _utc().isoformat(), **details}
        with undisturbed():
            write_atomically(self.path / "outcome.json", as_json(body))


def start_run(
    runs: Path,
    kind: str,
    *,
    specimen: str | None = None,
    inputs: Sequence[Path] = (),
    config: Mapping[str, Any] | None = None,
    seed: int | None = None,
    operator: str | None = None,
) -> RunFolder:
    """Make a new run folder with its manifest, durable before this returns."""
    missing = [str(path) for path in inputs if not path.is_file()]
    if missing:
        raise RecordError(f"inputs missing: {', '.join(missing)}")
    stamp = _utc().strftime("%Y-%m-%dT%H%M%SZ")
    path = runs / f"{stamp}-{kind}-{secrets.token_hex(2)}"
    try:
        path.mkdir(parents=True, exist_ok=False)
    except OSError as fault:
        raise RecordError(f"{path}: cannot be made: {fault.strerror or fault}") from fault
    body = {
        "format": FORMAT,
        "kind": kind,
        "specimen": specimen,
        "started_utc": _utc().isoformat(),
        "process": os.getpid(),
        "operator": operator or person(),
        "inputs": [{"path": str(p), "sha256": sha256(p), "bytes": p.stat().st_size} for p in inputs],
        "config": dict(config or {}),
        "seed": seed,
        "versions": versions(),
    }
    write_atomically(path / "manifest.json", as_json(body))
    sync_folder(runs)
    return RunFolder(path)


def open_run(path: Path) -> RunFolder:
    """Return an existing run; raise `RecordError` where there is none or it is half written."""
    if not (path / "manifest.json").is_file():
        raise RecordError(f"{path}: no run here (manifest.json is missing)")
    if "started_utc" not in _read(path / "manifest.json"):
        raise RecordError(f"{path}: no run here (its manifest.json is not that of a run)")
    return RunFolder(path)


def status_of(run: RunFolder) -> str:
    """Return done, stopped, failed, refused, running, or interrupted where nothing says how it ended."""
    outcome = run.outcome()
    if outcome is not None:
        return str(outcome["status"])
    return "running" if _alive(run.manifest()) else "interrupted"


def _alive(manifest: Mapping[str, Any]) -> bool:
    process = manifest.get("process")
    if not isinstance(process, int):
        return False
    stat = Path(f"/proc/{process}/stat")
    if not stat.exists():
        return False
    # A process id is used again: only one that began before the run did can be its writer.
    ticks = float(stat.read_text().rsplit(") ", 1)[1].split()[19])
    booted_s = float(Path("/proc/uptime").read_text().split()[0])
    began = _utc().timestamp() - booted_s + ticks / os.sysconf("SC_CLK_TCK")
    return began <= datetime.fromisoformat(manifest["started_utc"]).timestamp() + 1.0


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as fault:
        raise RecordError(f"{path}: cannot be read: {fault}") from fault
    if not isinstance(found, dict):
        raise RecordError(f"{path}: not a record")
    return found


def person() -> str:
    """Return the name of whoever runs this, as the system knows it."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"user {os.getuid()}"


def _utc() -> datetime:
    return datetime.now(UTC)
