"""`fabctl laser`: talk to the laser by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import PLACE_MM, bench_option, confirm, json_option, lab, progress, say, show, yes_option
from fabctl.cli.finite import numbers
from fabctl.cli.paths import OutFile

if TYPE_CHECKING:
    from drivers.grbl.laser import Laser
    from drivers.grbl.messages import Report
    from fabctl.bench import Bench


@click.group("laser", no_args_is_help=True)
def command() -> None:
    """Talk to the laser: info, home, unlock, jog, frame, console, settings, test grid."""


@contextmanager
def _laser(bench_name: str, purpose: str) -> Iterator[tuple[Laser, Bench]]:
    from fabctl.bench import open_bench
    from fabctl.config.bench import load_bench
    from fabctl.cut.job import laser_on

    home = lab()
    with open_bench(home, load_bench(bench_name, home.root), purpose) as bench, laser_on(bench) as laser:
        yield laser, bench


def _place(report: Report) -> str:
    where = report.machine_mm or report.work_mm
    text = f"{report.state}" + (f"  X{where[0]:.3f} Y{where[1]:.3f} mm" if where else "")
    return text + ("  (locked: home it or unlock it)" if report.state == "Alarm" else "")


def _facts(report: Report) -> dict[str, Any]:
    return {"state": report.state, "machine_mm": report.machine_mm, "pins": report.pins}


@command.command("info")
@bench_option
@json_option
def info(bench_name: str, as_json: bool) -> None:
    """Show who the board is, how it is set and where it stands."""
    from fabctl.cut.job import identity_of

    with _laser(bench_name, "laser info") as (laser, bench):
        who, report = identity_of(laser), laser.report()
        url = bench.url("laser")
    facts = {
        "url": url,
        "firmware": who.firmware,
        "version": who.version,
        "options": who.options,
        "rx_bytes": who.rx_bytes,
        "planner_count": who.planner_count,
        "laser_mode": who.is_on(32),
        "homing": who.is_on(22),
        "soft_limits": who.is_on(20),
        "travel_mm": [who.setting(130), who.setting(131)],
        "full_power": who.setting(30),
        "work_offset_mm": who.work_offset_mm(),
        "startup": who.startup,
        **_facts(report),
    }
    lines = [
        f"{who.firmware} {who.version} [{who.options}] at {url}",
        f"buffer {who.rx_bytes} bytes, {who.planner_count} moves; laser mode {_yes(who.is_on(32))}, "
        f"homing {_yes(who.is_on(22))}, soft limits {_yes(who.is_on(20))}",
        f"travel {who.setting(130)} × {who.setting(131)} mm, full power S{who.setting(30)}",
        _place(report),
    ]
    show(facts, as_json, lines)


def _yes(value: bool) -> str:
    return "on" if value else "off"


@command.command("home")
@bench_option
@yes_option
@json_option
def home(bench_name: str, yes: bool, as_json: bool) -> None:
    """Find the limit switches; afterwards the position is known."""
    with _laser(bench_name, "homing") as (laser, _):
        if not confirm("The head will travel to its corner. Is the way free?", yes):
            raise click.Abort
        report = laser.home()
    show(_facts(report), as_json, [_place(report)])


@command.command("unlock")
@bench_option
@yes_option
@json_option
def unlock(bench_name: str, yes: bool, as_json: bool) -> None:
    """Clear an alarm without homing: the position is only what the board believes."""
    with _laser(bench_name, "unlocking") as (laser, _):
        if not confirm("The position may be wrong; homing is safer. Unlock?", yes):
            raise click.Abort
        report = laser.unlock()
    show(_facts(report), as_json, [_place(report)])


@command.command("jog", context_settings={"ignore_unknown_options": True})
@click.argument("x_mm", type=PLACE_MM)
@click.argument("y_mm", type=PLACE_MM)
@click.option("--feed", "feed_mm_s", type=click.FloatRange(0.1, 10_000), default=50.0, show_default=True, help="mm/s")
@bench_option
@yes_option
@json_option
def jog(x_mm: float, y_mm: float, feed_mm_s: float, bench_name: str, yes: bool, as_json: bool) -> None:
    """Move the head by X_MM, Y_MM with the beam off; Ctrl-C stops it."""
    with _laser(bench_name, "jogging") as (laser, _):
        if not confirm(f"The head will move by X{x_mm:+g} Y{y_mm:+g} mm at {feed_mm_s:g} mm/s. Is the way free?", yes):
            raise click.Abort
        laser.jog(x_mm, y_mm, feed_mm_s)
        report = laser.report()
    show(_facts(report), as_json, [_place(report)])


@command.command("settings")
@click.argument("change", required=False, metavar="[N=VALUE]")
@bench_option
@yes_option
@json_option
def settings(change: str | None, bench_name: str, yes: bool, as_json: bool) -> None:
    """Show the board's settings, or write one: 32=1, or N0= to clear a start-up line."""
    from fabctl.cut.job import identity_of

    with _laser(bench_name, "settings") as (laser, _):
        who = identity_of(laser)
        if change is not None:
            name, found, value = change.removeprefix("$").partition("=")
            number = name.removeprefix("N")
            if not found or not number.isdigit():
                raise click.UsageError("write N=VALUE, such as 32=1, or N0= for a start-up line")
            before = who.startup[int(number) : int(number) + 1] if name[0] == "N" else who.setting(int(number))
            if not confirm(f"${name} is {before}; write {value!r} into the board's memory?", yes):
                raise click.Abort
            laser.run_quietly(f"${name}={value}", 3.0)
            who = laser.connect()
    rows = {f"${number}": value for number, value in sorted(who.settings.items())}
    show({"settings": rows, "startup": who.startup}, as_json, [f"{name:5} {value:g}" for name, value in rows.items()])


@command.command("console")
@bench_option
def console(bench_name: str) -> None:
    """Talk to the board line by line; ? ! ~ act at once, an empty line or Ctrl-D ends."""
    from drivers.errors import DeviceError

    with _laser(bench_name, "console") as (laser, _):
        say("lines go to the board as they are; ? status, ! hold, ~ resume, off: beam off and reset; empty line: end")
        while line := click.prompt("", default="", prompt_suffix="> ", show_default=False, err=True).strip():
            try:
                if line in ("?", "!", "~"):
                    report = {"?": laser.report, "!": laser.hold}.get(line)
                    say(_place(report()) if report else "resumed")
                    if line == "~":
                        laser.resume()
                elif line == "off":
                    say(str(laser.off()))
                else:
                    for message in laser.ask(line, 60.0):
                        say(str(message))
                    say("ok")
            except DeviceError as fault:
                say(str(fault))


@command.command("frame")
@click.argument("width_mm", type=click.FloatRange(1, 10_000))
@click.argument("height_mm", type=click.FloatRange(1, 10_000))
@click.option("--power", "power_frac", type=click.FloatRange(0, 0.05), default=0.0, help="Fraction of full power.")
@bench_option
@yes_option
@json_option
def frame(width_mm: float, height_mm: float, power_frac: float, bench_name: str, yes: bool, as_json: bool) -> None:
    """Go once around a rectangle from where the head is, beam off, or at most 5 % on."""
    from fabctl.cut.program import decimal

    size = (f"X{decimal(width_mm)}Y0", f"X{decimal(width_mm)}Y{decimal(height_mm)}", f"X0Y{decimal(height_mm)}", "X0Y0")
    question = f"Go around {width_mm:g} × {height_mm:g} mm at {power_frac:.0%} power?"
    with _laser(bench_name, "framing") as (laser, bench):
        report = _go_around(laser, bench, size, power_frac, lambda: confirm(question, yes))
    show(_facts(report), as_json, [_place(report)])


def _go_around(
    laser: Laser, bench: Bench, corners: tuple[str, ...], power_frac: float, ask: Callable[[], bool]
) -> Report:
    from fabctl.cut.by_hand import run_here

    lines = ["G21", "G90", "G94", "M4S0" if power_frac else "M5", "G0X0Y0", f"G1{corners[0]}F3000S{{s}}", *corners[1:]]
    run_here(laser, bench, [*lines, "M5", "G4P0.01"], power_frac, progress(), ask)
    return laser.report()


@command.command("testgrid")
@click.option("--powers", default="0.2,0.4,0.6,0.8,1.0", show_default=True, help="Fractions of full power.")
@click.option("--feeds", default="10,15,20,25,30", show_default=True, help="Speeds, mm/s.")
@click.option("--passes", default="1", show_default=True, help="Numbers of passes.")
@click.option(
    "--cell-mm", type=click.FloatRange(2, 200), default=8.0, show_default=True, help="Side of one square of the grid."
)
@click.option("-o", "--out", type=OutFile(), help="Only write the program to this file.")
@bench_option
@yes_option
@json_option
def testgrid(
    powers: str, feeds: str, passes: str, cell_mm: float, out: Path | None, bench_name: str, yes: bool, as_json: bool
) -> None:
    """Cut a labelled grid of power, speed and passes from where the head is."""
    from fabctl.cut.testgrid import Grid, grid_lines, size_mm

    grid = Grid(
        tuple(numbers(powers, "--powers")),
        tuple(numbers(feeds, "--feeds")),
        tuple(int(value) for value in numbers(passes, "--passes")),
        cell_mm,
    )
    if (
        not all(0 < power <= 1 for power in grid.powers_frac)
        or min(grid.feeds_mm_s) <= 0
        or not all(1 <= count <= 100 for count in grid.passes)
    ):
        raise click.UsageError("powers are fractions up to 1, feeds above zero, passes 1 to 100")
    width, height = size_mm(grid)
    facts = {"width_mm": width, "height_mm": height, "cells_count": len(grid.powers_frac) * len(grid.feeds_mm_s)}
    if out:
        from fabctl.records.folder import write_atomically

        write_atomically(out, "\n".join(grid_lines(grid, 1000.0)) + "\n")
        show({**facts, "file": str(out)}, as_json, [f"{out}: {width:g} × {height:g} mm, for $30=1000"])
        return
    from fabctl.cut.by_hand import run_here
    from fabctl.cut.job import identity_of

    question = f"Cut a grid of {width:g} × {height:g} mm here, exhaust on, you beside it?"
    with _laser(bench_name, "test grid") as (laser, bench):
        lines = grid_lines(grid, identity_of(laser).setting(30) or 1000.0)
        time_s = run_here(laser, bench, lines, 0.0, progress(), lambda: confirm(question, yes))
    show({**facts, "actual_s": time_s}, as_json, [f"cut in {time_s:.0f} s"])
