"""A list of all runs that answers quickly: SQLite, derived from the run folders and never more than that.

The folders are the truth. The index is brought up to date whenever it is asked: folders that are new, or whose files
changed since, are read again; folders that are gone are forgotten. Deleting the file loses nothing.
"""

from __future__ import annotations

import contextlib
import sqlite3
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from fabctl.errors import RecordError
from fabctl.records.folder import open_run, status_of
from fabctl.records.words import is_simulated, result_words

SCHEMA = """
create table if not exists listed (
  run text primary key, stamp_ns integer not null, kind text, specimen text, started_utc text,
  status text not null, message text not null, operator text, simulated integer
)
"""
OPEN = ("running", "interrupted", "broken")  # states that may change without a file of the folder changing


@dataclass(frozen=True, slots=True)
class Row:
    """One run, as the list shows it. A folder without a readable manifest is `broken`, with the reason as message."""

    run: str
    kind: str | None
    specimen: str | None
    started_utc: str | None
    status: str
    message: str
    operator: str | None
    simulated: bool | None  # None: it needed no bench

    def as_dict(self) -> dict[str, Any]:
        """Return the row as plain JSON."""
        return asdict(self)


def rows(runs: Path, index: Path | None = None) -> list[Row]:
    """Return every run below `runs`, oldest first, after bringing the index up to date."""
    path = index or runs / "index.sqlite"
    try:
        return _rows(runs, path)
    except (sqlite3.OperationalError, OSError):
        pass  # a full disk, a folder one may only read: the list is still to be had
    except sqlite3.DatabaseError:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)  # damaged: it is only derived
            return _rows(runs, path)
    try:
        return _rows(runs, Path(":memory:"))
    except sqlite3.Error as fault:
        raise RecordError(f"{runs}: the runs cannot be listed: {fault}") from fault


def reindex(runs: Path) -> list[Row]:
    """Throw the index away and read every folder anew."""
    with contextlib.suppress(OSError):
        (runs / "index.sqlite").unlink(missing_ok=True)
    return rows(runs)


def _rows(runs: Path, path: Path) -> list[Row]:
    folders = {p.name: p for p in runs.iterdir() if p.is_dir()} if runs.is_dir() else {}
    if not folders and not path.exists():
        return []
    with closing(sqlite3.connect(path, timeout=10)) as base, base:
        base.execute(SCHEMA)
        known = {
            name: (stamp, status) for name, stamp, status in base.execute("select run, stamp_ns, status from listed")
        }
        base.executemany("delete from listed where run = ?", [(name,) for name in known if name not in folders])
        for name, folder in folders.items():
            stamp = _stamp_ns(folder)
            seen, status = known.get(name, (None, "broken"))
            if seen == stamp and status not in OPEN:
                continue
            row = _read(folder)
            told = (row.kind, row.specimen, row.started_utc, row.status, row.message, row.operator, row.simulated)
            base.execute("insert or replace into listed values (?, ?, ?, ?, ?, ?, ?, ?, ?)", (row.run, stamp, *told))
        query = "select run, kind, specimen, started_utc, status, message, operator, simulated from listed order by run"
        return [replace(row, simulated=_flag(row.simulated)) for row in (Row(*found) for found in base.execute(query))]


def _flag(stored: int | None) -> bool | None:
    """Return what SQLite keeps as a number."""
    return None if stored is None else bool(stored)


def _read(folder: Path) -> Row:
    try:
        run = open_run(folder)
        manifest, outcome, status = run.manifest(), run.outcome(), status_of(run)
        message = str((outcome or {}).get("message", "")) or (result_words(run.result() or {}) if outcome else "")
        simulated = is_simulated(manifest)
    except (RecordError, KeyError, ValueError, TypeError) as fault:
        why = str(fault) if isinstance(fault, RecordError) else f"{folder}: not a whole record: {fault!r}"
        return Row(folder.name, None, None, None, "broken", why, None, None)
    texts = [manifest.get(key) for key in ("kind", "specimen", "started_utc")]
    kind, specimen, started = (None if text is None else str(text) for text in texts)
    return Row(folder.name, kind, specimen, started, status, message, str(manifest.get("operator")), simulated)


def _stamp_ns(folder: Path) -> int:
    stamps = [p.stat().st_mtime_ns for p in (folder / "manifest.json", folder / "outcome.json") if p.exists()]
    return max(stamps, default=0)
