"""Where the lab's files live: runs, specimens, and the state of each bench.

The folder is `$FABCTL_HOME`, or the current one. A specimen's id is the thread through all its runs: it is given once,
at the cut, and never again.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fabctl.errors import RecordError, UsageError
from fabctl.files import json_of
from fabctl.records.folder import RunFolder, as_json, open_run, write_atomically

SPECIMEN = re.compile(r"S-\d{4,}")


@dataclass(frozen=True)
class Workspace:
    """A lab's folder."""

    root: Path

    @property
    def runs(self) -> Path:
        """Return the folder of all runs."""
        return self.root / "runs"

    @property
    def specimens(self) -> Path:
        """Return the folder of all specimens."""
        return self.root / "specimens"

    def bench_state(self, bench: str) -> Path:
        """Return the folder in which a bench keeps its sockets, logs and slot; it exists."""
        path = self.root / "bench-state" / bench
        path.mkdir(parents=True, exist_ok=True)
        return path

    def next_id(self) -> str:
        """Return the id that the next specimen will have, if nobody else is given it first."""
        names = [p.name for p in self.specimens.iterdir()] if self.specimens.is_dir() else []
        return f"S-{max((int(name[2:]) for name in names if SPECIMEN.fullmatch(name)), default=0) + 1:04d}"

    def new_specimen(self, design: Path) -> Specimen:
        """Give out the next id, with a copy of the design (a folder, or one file); safe against two cuts at once."""
        self.specimens.mkdir(parents=True, exist_ok=True)
        while True:
            path = self.specimens / self.next_id()
            try:
                path.mkdir()
                break
            except FileExistsError:
                continue
        try:
            if design.is_dir():
                shutil.copytree(design, path / "design")
            else:
                (path / "design").mkdir()
                shutil.copy(design, path / "design")
        except (OSError, shutil.Error) as fault:
            raise RecordError(f"{path}: the design cannot be copied: {fault}") from fault
        body = {"id": path.name, "made_utc": datetime.now(UTC).isoformat(), "design": str(design.resolve())}
        write_atomically(path / "specimen.json", as_json(body))
        return Specimen(path)

    def specimen(self, name: str) -> Specimen:
        """Return the specimen called `name`; raise `UsageError` with the known ones where there is none."""
        path = self.specimens / name
        if not SPECIMEN.fullmatch(name) or not (path / "specimen.json").is_file():
            known = (
                ", ".join(sorted(p.parent.name for p in self.specimens.glob("S-*/specimen.json"))[-5:]) or "none yet"
            )
            raise UsageError(f"no specimen {name!r} in {self.specimens} (the latest: {known})")
        return Specimen(path)

    def run(self, name: str) -> RunFolder:
        """Return the run that `name` means: its id, the beginning or end of it, or its folder."""
        direct = Path(name)
        if "/" in name or (direct / "manifest.json").is_file():
            if not (direct / "manifest.json").is_file():
                raise UsageError(f"{name}: no run lies there; `fabctl run list` names them")
            try:
                return open_run(direct)
            except RecordError as fault:
                raise UsageError(f"{fault}; `fabctl run list` names the runs") from fault
        folders = [p for p in self.runs.iterdir() if p.is_dir()] if self.runs.is_dir() else []
        matches = [p for p in folders if p.name == name] or [
            p for p in folders if name and _begins_or_ends(p.name, name)
        ]
        if len(matches) == 1:
            return open_run(matches[0])
        if not matches:
            raise UsageError(f"no run {name!r} in {self.runs}; `fabctl run list` names them")
        raise UsageError(f"{name!r} may be any of {', '.join(sorted(p.name for p in matches))}")

    def all_runs(self) -> list[RunFolder]:
        """Return every readable run, oldest first; `unreadable_runs` are the others."""
        return [run for run in map(_readable, self._run_folders()) if run is not None]

    def unreadable_runs(self) -> list[Path]:
        """Return every run folder, half made or damaged, whose manifest cannot be read, oldest first."""
        return [path for path in self._run_folders() if _readable(path) is None]

    def _run_folders(self) -> list[Path]:
        return sorted(self.runs.glob("*-*-*")) if self.runs.is_dir() else []

    def runs_of(self, specimen: str, kind: str | None = None) -> list[RunFolder]:
        """Return the runs of one specimen, oldest first."""
        wanted = [run for run in self.all_runs() if run.manifest().get("specimen") == specimen]
        return [run for run in wanted if kind is None or run.manifest().get("kind") == kind]


def _readable(path: Path) -> RunFolder | None:
    try:
        return open_run(path)
    except RecordError:
        return None


def _begins_or_ends(whole: str, part: str) -> bool:
    return whole.startswith(part) or whole.endswith(part)


@dataclass(frozen=True)
class Specimen:
    """One sheet with a name."""

    path: Path

    @property
    def name(self) -> str:
        """Return the id, such as `S-0042`."""
        return self.path.name

    @property
    def design(self) -> Path:
        """Return the specimen's own copy of the design folder."""
        return self.path / "design"

    @property
    def is_coupon(self) -> bool:
        """Tell whether it is a coupon: flat patches to be pulled open by hand, no surface to press."""
        manifest = self.design / "manifest.json"
        return manifest.is_file() and json_of(manifest, "a design's manifest").get("kind") == "coupon"

    def record(self) -> dict[str, Any]:
        """Return what is written about the specimen."""
        path = self.path / "specimen.json"
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as fault:
            raise RecordError(f"{path}: cannot be read: {fault}") from fault
        if not isinstance(found, dict):
            raise RecordError(f"{path}: not a record")
        return found

    def note(self, **facts: Any) -> None:
        """Add facts to the specimen's record (deployed on, thickness measured, …)."""
        write_atomically(self.path / "specimen.json", as_json({**self.record(), **facts}))


def workspace(home: str | None = None) -> Workspace:
    """Return the workspace the caller works in."""
    return Workspace(Path(home or os.environ.get("FABCTL_HOME") or ".").resolve())
