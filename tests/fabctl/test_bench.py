"""A bench is held by one job at a time, and its devices are found by URL."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from fabctl.bench import HELD, announced, open_bench
from fabctl.config.bench import BenchConfig, load_bench
from fabctl.config.loader import parse
from fabctl.errors import BenchBusy, ConfigError, UsageError
from fabctl.simulated import SimulatorError, alive, start, stop
from fabctl.workspace import Workspace

ECHO = "python -c \"print('ready tcp://127.0.0.1:7', flush=True); import time; time.sleep(60)\""

TEXT = "name: toy\nlaser: {url: 'ready:laser', travel_mm: [300, 200]}\n"


def config(simulators: str = "{}", url: str = "ready:laser") -> BenchConfig:
    text = f"name: toy\nlaser: {{url: '{url}', travel_mm: [300, 200]}}\nsimulators: {simulators}\n"
    return parse(text, BenchConfig, "toy.yaml")


def test_the_shipped_benches_are_valid(tmp_path: Path) -> None:
    assert [load_bench(name, tmp_path).name for name in ("sim", "lab")] == ["sim", "lab"]


def test_an_unknown_bench_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"known: lab, sim"):
        load_bench("simm", tmp_path)


def test_a_second_user_is_told_who_has_the_bench_and_why(tmp_path: Path) -> None:
    lab = Workspace(tmp_path)
    with (
        open_bench(lab, config(), "cutting S-0001"),
        pytest.raises(BenchBusy, match=r"cutting S-0001, since"),
        open_bench(lab, config(), "jogging"),
    ):
        pass
    with open_bench(lab, config(), "jogging"):
        pass


def test_the_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    script = textwrap.dedent(f"""
        import sys, time
        from pathlib import Path
        from fabctl.bench import open_bench
        from fabctl.config.bench import BenchConfig
        from fabctl.config.loader import parse
        from fabctl.workspace import Workspace
        config = parse("name: toy\\nlaser: {{url: 'ready:laser', travel_mm: [300, 200]}}", BenchConfig, "toy")
        with open_bench(Workspace(Path({str(tmp_path)!r})), config, "burning"):
            print("held", flush=True)
            time.sleep(60)
    """)
    holder = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(BenchBusy, match="burning"), open_bench(Workspace(tmp_path), config(), "x"):
        pass
    holder.kill()
    holder.wait()
    holder.stdout.close()
    with open_bench(Workspace(tmp_path), config(), "x"):
        pass


def test_a_started_simulator_is_found_by_name_and_stopped(tmp_path: Path) -> None:
    lab, bench = Workspace(tmp_path), config(f"{{laser: '{ECHO.replace(chr(39), chr(39) * 2)}'}}")
    state = lab.bench_state("toy")
    try:
        found = start(bench, state)
        assert alive(found["laser"])
        assert start(bench, state) == found, "what runs is not started twice"
        with open_bench(lab, bench, "test") as held:
            assert held.url("laser") == "tcp://127.0.0.1:7"
    finally:
        stopped = stop(state)
    assert stopped == ["laser"]
    assert announced(state) == {}
    assert not alive(found["laser"])


def test_a_simulator_that_fails_says_why(tmp_path: Path) -> None:
    broken = config("{laser: python -c \"raise SystemExit('no port left')\"}")
    with pytest.raises(SimulatorError, match="no port left"):
        start(broken, Workspace(tmp_path).bench_state("toy"))


def test_a_simulator_that_is_not_up_names_the_command(tmp_path: Path) -> None:
    with open_bench(Workspace(tmp_path), config(), "x") as bench, pytest.raises(UsageError, match="fabctl sim up"):
        bench.url("laser")


@pytest.mark.parametrize("text", ["{", "[]", '{"laser": {}}', '{"laser": 3}', ""])
def test_a_damaged_list_of_simulators_is_no_list(tmp_path: Path, text: str) -> None:
    (tmp_path / "simulators.json").write_text(text)
    assert announced(tmp_path) == {}


def run_step(*words: str, handle: int | None = None) -> int:
    """Try to hold the bench in a process of its own, as a flow's step with `handle`; return its exit code."""
    script = textwrap.dedent(f"""
        from pathlib import Path
        from fabctl.bench import open_bench
        from fabctl.config.loader import parse
        from fabctl.config.bench import BenchConfig
        from fabctl.workspace import Workspace
        with open_bench(Workspace(Path({words[0]!r})), parse({TEXT!r}, BenchConfig, "x"), "a step"):
            pass
    """)
    given = {} if handle is None else {HELD: str(handle)}
    fds = () if handle is None else (handle,)
    return subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, **given}, pass_fds=fds, capture_output=True
    ).returncode


def test_a_flow_lends_its_bench_to_its_steps_and_to_nobody_else(tmp_path: Path) -> None:
    bench = parse(TEXT, BenchConfig, "x")
    with open_bench(Workspace(tmp_path), bench, "flow cap") as held:
        assert run_step(str(tmp_path), handle=held.lock) == 0
        assert run_step(str(tmp_path)) != 0, "another job cannot slip in between two steps"
        with (tmp_path / "other").open("w") as other:
            assert run_step(str(tmp_path), handle=other.fileno()) != 0, "the number of another file opens nothing"
        assert run_step(str(tmp_path), handle=held.lock) == 0, "a step's end does not let go of the flow's lock"
    assert run_step(str(tmp_path)) == 0
