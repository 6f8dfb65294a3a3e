"""A run's samples for other programs: CSV with units, Parquet, HDF5, bluesky event-model documents."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

from fabctl.errors import RecordError, UsageError
from fabctl.indent.analysis import samples_of
from fabctl.indent.recorder import COLUMNS
from fabctl.records.folder import RunFolder, status_of

UNITS = {"time_s": "s", "position_mm": "mm", "force_gross_N": "N", "force_N": "N"}
NUMBERS = ("time_s", "position_mm", "force_gross_N", "force_N")
WHOLE = ("sequence", "point", "curve")

Columns = dict[str, list[Any]]


def export(run: RunFolder, kind: str, path: Path) -> dict[str, Any]:
    """Write the run's samples to `path`; return what was written."""
    columns = _columns(run)
    writers = {"csv": _write_csv, "parquet": _write_parquet, "hdf5": _write_hdf5, "bluesky": _write_bluesky}
    if kind not in writers:
        raise UsageError(f"unknown format {kind!r}; known: {', '.join(writers)}")
    try:
        writers[kind](run, columns, path)
    except OSError as fault:
        raise RecordError(f"{path}: cannot be written: {fault.strerror or fault}") from fault
    return {"run": run.run_id, "format": kind, "path": str(path), "rows_count": len(columns["time_s"])}


def _columns(run: RunFolder) -> Columns:
    text = samples_of(run).read_text(encoding="utf-8")
    lines = text.splitlines() if text.endswith("\n") else text.splitlines()[:-1]
    columns: Columns = {name: [] for name in COLUMNS}
    for row in csv.DictReader(lines):
        for name in COLUMNS:
            value = row[name]
            columns[name].append(float(value) if name in NUMBERS else int(value) if name in WHOLE else value)
    return columns


def _facts(run: RunFolder) -> dict[str, Any]:
    manifest = run.manifest()
    return {
        "run": run.run_id,
        "specimen": manifest.get("specimen"),
        "started_utc": manifest.get("started_utc"),
        "status": status_of(run),
        "config": manifest.get("config", {}),
    }


def _write_csv(run: RunFolder, columns: Columns, path: Path) -> None:
    """Two header lines: names, units. The facts of the run stand before them as comments."""
    facts = _facts(run)
    with path.open("w", encoding="utf-8", newline="") as stream:
        for name in ("run", "specimen", "started_utc", "status"):
            stream.write(f"# {name}: {facts[name]}\n")
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerow([UNITS.get(name, "") for name in COLUMNS])
        table.writerows(zip(*columns.values(), strict=True))


def _write_parquet(run: RunFolder, columns: Columns, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields = [pa.field(n, _arrow_type(pa, n), metadata={"unit": UNITS.get(n, "")}) for n in columns]
    schema = pa.schema(fields, metadata={"fabctl": json.dumps(_facts(run), default=str)})
    pq.write_table(pa.table(columns, schema=schema), path)


def _arrow_type(pa: Any, name: str) -> Any:
    return pa.float64() if name in NUMBERS else pa.int64() if name in WHOLE else pa.string()


def _write_hdf5(run: RunFolder, columns: Columns, path: Path) -> None:
    import h5py
    import numpy as np

    with h5py.File(path, "w") as file:
        group = file.create_group("samples")
        for name, values in columns.items():
            kind: Any = np.float64 if name in NUMBERS else np.int64 if name in WHOLE else h5py.string_dtype()
            data = group.create_dataset(name, data=np.array(values, dtype=kind) if name not in NUMBERS else values)
            data.attrs["unit"] = UNITS.get(name, "")
        for name, value in _facts(run).items():
            file.attrs[name] = value if isinstance(value, str) else json.dumps(value, default=str)


def _write_bluesky(run: RunFolder, columns: Columns, path: Path) -> None:
    """One JSON document a line: [name, document], as bluesky's own file writers do."""
    with path.open("w", encoding="utf-8") as stream:
        for name, document in documents(run, columns):
            stream.write(json.dumps([name, document], default=str) + "\n")


def documents(run: RunFolder, columns: Columns) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the event-model documents of a run: start, descriptor, event page, stop. Ids follow from the run's own."""
    facts = _facts(run)
    began_s = datetime.fromisoformat(str(facts["started_utc"])).timestamp()
    start = str(uuid5(NAMESPACE_URL, f"fabctl:{run.run_id}"))
    descriptor = str(uuid5(NAMESPACE_URL, f"fabctl:{run.run_id}:primary"))
    yield (
        "start",
        {
            "uid": start,
            "time": began_s,
            "plan_name": "indent",
            "sample": facts["specimen"] or "",
            "fabctl": json.loads(json.dumps(facts, default=str)),
        },
    )
    yield (
        "descriptor",
        {
            "uid": descriptor,
            "run_start": start,
            "time": began_s,
            "name": "primary",
            "data_keys": {name: _data_key(name) for name in columns if name != "time_s"},
        },
    )
    count = len(columns["time_s"])
    times = [began_s + t for t in columns["time_s"]]
    data = {name: values for name, values in columns.items() if name != "time_s"}
    if count:
        yield (
            "event_page",
            {
                "descriptor": descriptor,
                "uid": [str(uuid5(NAMESPACE_URL, f"fabctl:{run.run_id}:{k}")) for k in range(count)],
                "seq_num": list(range(1, count + 1)),
                "time": times,
                "data": data,
                "timestamps": dict.fromkeys(data, times),
                "filled": {},
            },
        )
    exits = {"done": "success", "stopped": "abort"}
    yield (
        "stop",
        {
            "uid": str(uuid5(NAMESPACE_URL, f"fabctl:{run.run_id}:stop")),
            "run_start": start,
            "time": times[-1] if times else began_s,
            "exit_status": exits.get(str(facts["status"]), "fail"),
            "num_events": {"primary": count},
        },
    )


def _data_key(name: str) -> dict[str, Any]:
    kind = "number" if name in NUMBERS else "integer" if name in WHOLE else "string"
    key: dict[str, Any] = {"dtype": kind, "shape": [], "source": f"fabctl:samples.csv:{name}"}
    return key | ({"units": UNITS[name]} if name in UNITS else {})
