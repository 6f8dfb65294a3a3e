"""`fabctl sim`: the simulated devices of a bench, as processes."""

from __future__ import annotations

import click

from fabctl.bench import announced
from fabctl.cli.common import bench_option, json_option, lab, show
from fabctl.config.bench import load_bench
from fabctl.simulated import alive, start, stop


@click.group("sim", no_args_is_help=True)
def command() -> None:
    """Start and stop the simulated devices of a bench."""


@command.command("up")
@bench_option
@json_option
def up(bench_name: str, as_json: bool) -> None:
    """Start every simulator that the bench file lists and that does not run yet."""
    home = lab()
    config = load_bench(bench_name, home.root)
    if not config.simulators:
        raise click.UsageError(f"bench {config.name} lists no simulators; it is a real one")
    found = start(config, home.bench_state(config.name))
    show({"simulators": found}, as_json, [f"{name:8} {facts['url']}" for name, facts in found.items()])


@command.command("down")
@bench_option
@json_option
def down(bench_name: str, as_json: bool) -> None:
    """Stop the bench's simulators."""
    home = lab()
    stopped = stop(home.bench_state(load_bench(bench_name, home.root).name))
    show({"stopped": stopped}, as_json, [f"stopped {', '.join(stopped)}" if stopped else "nothing was running"])


@command.command("status")
@bench_option
@json_option
def status(bench_name: str, as_json: bool) -> None:
    """Say which simulators run, and by what URL each is reached."""
    home = lab()
    config = load_bench(bench_name, home.root)
    known = announced(home.bench_state(config.name))
    rows = {
        name: {"running": name in known and alive(known[name]), "url": known.get(name, {}).get("url")}
        for name in config.simulators
    }
    show(
        {"simulators": rows},
        as_json,
        [f"{name:8} {'running ' + str(row['url']) if row['running'] else 'not running'}" for name, row in rows.items()],
    )
