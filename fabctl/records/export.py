"""A run as one archive that a colleague can read without the tool."""

from __future__ import annotations

import tarfile
from pathlib import Path

from fabctl.errors import RecordError, UsageError
from fabctl.records.folder import RunFolder, sha256


def export(run: RunFolder, target: Path) -> dict[str, str]:
    """Write the whole run folder to `target` (.tar.gz); return name -> sha256 of every file in it."""
    if target.exists():
        raise UsageError(f"{target} is there already; name another file")
    files = sorted(p for p in run.path.rglob("*") if p.is_file())
    hashes = {str(p.relative_to(run.path)): sha256(p) for p in files}
    draft = target.with_name(f".{target.name}.new")
    try:
        with tarfile.open(draft, "w:gz") as archive:
            for path in files:
                archive.add(path, arcname=f"{run.run_id}/{path.relative_to(run.path)}")
        draft.replace(target)
    except OSError as fault:
        draft.unlink(missing_ok=True)
        raise RecordError(f"{target}: cannot be written: {fault.strerror or fault}") from fault
    return hashes
