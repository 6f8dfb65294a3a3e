"""The sweep: the same bytes whoever works, nothing lost when it is stopped, nothing trusted that is torn."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from design.cells.library import load_library, save_library
from design.cells.sheet import Sheet
from design.cells.sweep import Plan, Progress, plan_of, sweep

SHEET = Sheet()
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def plan() -> Plan:
    return plan_of(SHEET, theta_count=5, t_step_mm=0.35)


@pytest.fixture(scope="module")
def alone(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("alone")
    return library_bytes(plan, sweep(plan, folder / "parts"), folder / "library.npz")


def library_bytes(plan: Plan, cells: list, path: Path) -> bytes:  # type: ignore[type-arg]
    save_library(path, plan, SHEET, cells, "test")
    return path.read_bytes()


def test_two_workers_make_the_same_bytes_as_one(plan: Plan, alone: bytes, tmp_path: Path) -> None:
    cells = sweep(plan, tmp_path / "parts", jobs=2)
    assert library_bytes(plan, cells, tmp_path / "library.npz") == alone


def test_a_stopped_sweep_goes_on_where_it_was(plan: Plan, alone: bytes, tmp_path: Path) -> None:
    def stop_after_two(now: Progress) -> None:
        if len(list((tmp_path / "parts").rglob("column-*.json"))) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(plan, tmp_path / "parts", report=stop_after_two)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").rglob("column-*.json")}
    assert len(kept) == 2
    reports: list[Progress] = []
    cells = sweep(plan, tmp_path / "parts", report=reports.append)
    assert len(reports) == 3 and reports[-1].done_count == reports[-1].total_count
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert library_bytes(plan, cells, tmp_path / "library.npz") == alone


def test_a_torn_part_is_solved_again(plan: Plan, alone: bytes, tmp_path: Path) -> None:
    sweep(plan, tmp_path / "parts")
    part = next((tmp_path / "parts").rglob("column-002.json"))
    part.write_bytes(part.read_bytes()[:100])
    assert library_bytes(plan, sweep(plan, tmp_path / "parts"), tmp_path / "library.npz") == alone


def test_a_finished_sweep_is_read_not_solved(plan: Plan, tmp_path: Path) -> None:
    sweep(plan, tmp_path / "parts")
    reports: list[Progress] = []
    sweep(plan, tmp_path / "parts", report=reports.append)
    assert reports == []


def test_the_key_follows_the_shape_and_not_the_rubber() -> None:
    from dataclasses import replace

    key = plan_of(SHEET).key()
    assert plan_of(replace(SHEET, E_MPa=3.0, thickness_mm=1.0)).key() == key
    assert plan_of(replace(SHEET, hinge_mm=0.3)).key() != key


@pytest.mark.slow
def test_a_sweep_killed_at_any_moment_loses_only_the_column_in_hand(plan: Plan, alone: bytes, tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\nfrom design.cells.sheet import Sheet\n"
        "from design.cells.sweep import plan_of, sweep\n"
        f"sweep(plan_of(Sheet(), 5, 0.35), Path({str(tmp_path / 'parts')!r}))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    give_up = time.monotonic() + 120
    while not list((tmp_path / "parts").rglob("column-*.json")) and time.monotonic() < give_up:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert list((tmp_path / "parts").rglob("column-*.json"))
    assert library_bytes(plan, sweep(plan, tmp_path / "parts"), tmp_path / "library.npz") == alone


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[str]:
    """A dask scheduler and two workers, each its own process."""
    address = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-m", "dask"]
    scheduler = [*words, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    worker = [*words, "worker", "--nthreads", "1", "--no-dashboard", "--no-nanny", "--local-directory", str(tmp_path)]
    commands = [scheduler, worker, worker]
    processes = [
        subprocess.Popen([*command, "--scheduler-file", str(address)], env=environment, cwd=tmp_path, **quiet)  # type: ignore[call-overload]
        for command in commands
    ]
    try:
        import json

        give_up = time.monotonic() + 60
        while time.monotonic() < give_up:
            if address.exists() and address.stat().st_size:
                break
            time.sleep(0.1)
        yield json.loads(address.read_text())["address"]
    finally:
        for process in reversed(processes):  # workers first: they say goodbye to the scheduler
            process.terminate()
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_two_processes_of_a_cluster_make_the_same_bytes(plan: Plan, alone: bytes, cluster: str, tmp_path: Path) -> None:
    cells = sweep(plan, tmp_path / "parts", cluster=cluster)
    assert library_bytes(plan, cells, tmp_path / "library.npz") == alone


@pytest.mark.slow
def test_the_shipped_library_is_what_the_solver_finds_today(tmp_path: Path) -> None:
    library = load_library()
    plan = plan_of(SHEET)
    cells = sweep(plan, tmp_path, columns=[35])  # θ = 20°: the shortest with a rim on both sides
    rows = library.table["theta_rad"] == cells[0].theta_rad
    stored = library.table["expansion_ratio"][rows]
    assert [c.verdict == "bistable" for c in cells] == (stored == stored).tolist()
    found = [c.expansion_ratio for c in cells if c.expansion_ratio is not None]
    assert found == pytest.approx(stored[stored == stored].tolist(), rel=1e-9)
