"""A run folder keeps what was acknowledged, says how it ended, and is never overwritten."""

from __future__ import annotations

import errno
import json
import os
import random
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from fabctl.cli.main import cli
from fabctl.errors import RecordError
from fabctl.events import Event
from fabctl.records.export import export
from fabctl.records.folder import DurableLog, open_run, start_run, status_of, write_atomically
from fabctl.records.index import reindex, rows

WRITER = """
import sys
from pathlib import Path
from fabctl.records.folder import DurableLog, start_run
run = start_run(Path(sys.argv[1]), "indent", specimen="S-0001")
log = DurableLog(run.path / "samples.csv", header="row")
for row in range(10**9):
    log.append([str(row)])
    print(row, flush=True)
"""


def test_a_killed_writer_keeps_every_acknowledged_row_and_is_listed_as_interrupted(tmp_path: Path) -> None:
    rng = random.Random(7)
    for _ in range(12):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True
        ) as writer:
            assert writer.stdout is not None
            first = writer.stdout.readline()
            time.sleep(rng.uniform(0, 0.05))
            writer.send_signal(signal.SIGKILL)
            acknowledged = [first, *writer.stdout.readlines()]
        kept = (max(tmp_path.glob("*-indent-*"), key=lambda p: p.stat().st_mtime_ns) / "samples.csv").read_text()
        whole = [int(line) for line in acknowledged if line.endswith("\n")]
        assert [int(line) for line in kept.split("\n")[1 : len(whole) + 1]] == whole
    found = rows(tmp_path)
    assert [row.status for row in found] == ["interrupted"] * 12
    assert {row.specimen for row in found} == {"S-0001"}


def test_acknowledgement_follows_the_sync(tmp_path: Path) -> None:
    told: list[str] = []

    def sync(handle: int) -> None:
        told.append("synced")
        os.fdatasync(handle)

    log = DurableLog(tmp_path / "samples.csv", sync=sync)
    log.append(["1,2"])
    told.append("acknowledged")
    log.close()
    assert told == ["synced", "acknowledged"]


def test_a_full_disk_is_said_and_earlier_rows_stay(tmp_path: Path) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    log = DurableLog(tmp_path / "samples.csv")
    log.append(["1"])
    log.close()
    log = DurableLog(tmp_path / "samples.csv", sync=full)
    with pytest.raises(RecordError, match=r"No space left.*acknowledged before is kept"):
        log.append(["2"])
    log.close()
    assert (tmp_path / "samples.csv").read_text().startswith("1\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_device_that_is_full_refuses_the_row(tmp_path: Path) -> None:
    (tmp_path / "samples.csv").symlink_to("/dev/full")
    log = DurableLog(tmp_path / "samples.csv")
    with pytest.raises(RecordError, match="No space left"):
        log.append(["1"])
    log.close()


def test_a_run_goes_from_running_to_done(tmp_path: Path) -> None:
    source = tmp_path / "spec.yaml"
    source.write_text("name: x\n")
    run = start_run(tmp_path / "runs", "cut", specimen="S-0001", inputs=[source], config={"a": 1}, seed=3)
    assert status_of(run) == "running"
    run.log_events()(Event("stage", "frame", 0.5))
    run.write_result({"length_mm": 12.0})
    run.finish("done", "all burnt")
    again = open_run(run.path)
    assert status_of(again) == "done"
    assert again.result() == {"length_mm": 12.0}
    assert again.manifest()["inputs"][0]["bytes"] == 8
    event = json.loads((run.path / "events.jsonl").read_text())
    assert (event["kind"], event["done_frac"]) == ("stage", 0.5)


def test_two_runs_of_one_second_do_not_share_a_folder(tmp_path: Path) -> None:
    assert len({start_run(tmp_path, "scan").path for _ in range(20)}) == 20


def test_a_missing_input_stops_before_a_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"gone\.yaml"):
        start_run(tmp_path / "runs", "cut", inputs=[tmp_path / "gone.yaml"])
    assert not (tmp_path / "runs").exists()


def test_an_atomic_write_that_fails_leaves_the_old_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "outcome.json"
    write_atomically(path, "old")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RecordError, match="No space left"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["outcome.json"]


def test_the_index_is_rebuilt_from_the_folders(tmp_path: Path) -> None:
    done, half = start_run(tmp_path, "cut"), tmp_path / "2026-01-01T000000Z-scan-dead"
    done.finish("done")
    half.mkdir()
    (half / "manifest.json").write_text('{"kind": "sc')
    before = rows(tmp_path)
    assert {row.status for row in before} == {"done", "broken"}
    (tmp_path / "index.sqlite").write_bytes(b"this is not a database at all, and longer than a header" * 10)
    assert rows(tmp_path) == before
    assert reindex(tmp_path) == before
    (half / "manifest.json").unlink()
    half.rmdir()
    assert [row.run for row in rows(tmp_path)] == [done.run_id]


def test_an_export_holds_every_file_and_its_hash(tmp_path: Path) -> None:
    run = start_run(tmp_path / "runs", "cut")
    run.artefact("job.nc").write_text("M5\n")
    run.finish("done")
    hashes = export(run, tmp_path / "out.tar.gz")
    with tarfile.open(tmp_path / "out.tar.gz") as archive:
        assert {name.split("/", 1)[1] for name in archive.getnames()} == set(hashes)
    assert set(hashes) == {"manifest.json", "outcome.json", "artefacts/job.nc"}


@pytest.mark.parametrize("outcome", ["{}", '{"status": 3}', "[]", "{"])
def test_one_bad_record_does_not_hide_the_others(tmp_path: Path, outcome: str) -> None:
    good, bad = start_run(tmp_path, "cut"), start_run(tmp_path, "scan")
    good.finish("done")
    (bad.path / "outcome.json").write_text(outcome)
    odd = start_run(tmp_path, "indent")
    manifest = json.loads((odd.path / "manifest.json").read_text())
    (odd.path / "manifest.json").write_text(json.dumps({**manifest, "started_utc": "x"}))
    assert {row.run: row.status for row in rows(tmp_path)}[good.run_id] == "done"
    assert {row.run: row.status for row in rows(tmp_path)}[odd.run_id] == "broken"


@pytest.mark.parametrize("outcome", ["{}", '{"status": null}', '{"status": ["done"]}', "[]", "{"])
def test_a_damaged_outcome_is_told_as_that(tmp_path: Path, outcome: str) -> None:
    run = start_run(tmp_path, "indent")
    (run.path / "outcome.json").write_text(outcome)
    for ask in (lambda: status_of(run), run.outcome):
        with pytest.raises(RecordError, match=r"outcome\.json"):
            ask()
    (row,) = rows(tmp_path)
    assert (row.status, "outcome.json" in row.message) == ("broken", True)


def test_the_list_is_to_be_had_where_nothing_can_be_written(tmp_path: Path) -> None:
    run = start_run(tmp_path, "cut")
    run.finish("done")
    (tmp_path / "index.sqlite").mkdir()
    assert {row.run: row.status for row in rows(tmp_path)}[run.run_id] == "done"


def test_the_list_tells_what_a_run_came_to_and_on_which_kind_of_bench(tmp_path: Path) -> None:
    made = (
        ("cut", {"bench": {"simulated": True}}, {"burnt_mm": 5210.0, "actual_s": 290.4, "estimate_s": 288.0}),
        ("indent", {"simulated": False}, {"stiffness_secant_N_mm": 0.00697, "curves_count": 2, "gain_ratio": 1.0}),
        ("calibrate", {"bench": "lab", "simulated": True}, {"gain_ratio": 1.0021}),
        ("report", {}, {}),
    )
    runs = tmp_path / "runs"
    for kind, config, result in made:
        run = start_run(runs, kind, config=config)
        run.write_result(result)
        run.finish("done", "all told" if kind == "report" else "")
    found = {row.kind: (row.simulated, row.message) for row in rows(runs)}
    assert found["cut"] == (True, "5.21 m burnt, 290 s, estimated 288 s")
    assert found["indent"] == (False, "2 curves, secant stiffness 0.00697 N/mm")
    assert found["calibrate"] == (True, "gain of the load cell 1.002")
    assert found["report"] == (None, "all told")
    told = CliRunner().invoke(cli, ["--home", str(tmp_path), "run", "list", "--kind", "cut"]).output
    assert "simulated 5.21 m burnt" in told.splitlines()[1]
