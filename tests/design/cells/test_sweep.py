"""The sweep: the same bytes whoever works, nothing lost when it is stopped, nothing trusted that is torn."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
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
        "tell = lambda now: print(now.done_count, flush=True)\n"
        f"sweep(plan_of(Sheet(), 5, 0.35), Path({str(tmp_path / 'parts')!r}), report=tell)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline()  # the first column is done, and the next one begun
        process.send_signal(signal.SIGKILL)
    process.wait()
    assert list((tmp_path / "parts").rglob("column-*.json"))
    assert library_bytes(plan, sweep(plan, tmp_path / "parts"), tmp_path / "library.npz") == alone


CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    quiet = {"dashboard_address": None, "local_directory": "."}
    with LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", **quiet) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[str]:
    """A dask scheduler and two workers, each its own process, until the pipe to them is shut."""
    process = subprocess.Popen(
        [sys.executable, "-c", CLUSTER], env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=tmp_path, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.communicate()


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
