"""`fabctl rig`: talk to the indentation rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import PLACE_MM, bench_option, confirm, json_option, lab, progress, show, yes_option
from fabctl.cli.figures import spoken

if TYPE_CHECKING:
    from drivers.rig.indenter import Indenter
    from drivers.rig.samples import Sample
    from fabctl.bench import Bench

SPEED_MM_S = click.FloatRange(0, 1000, min_open=True)
JOG_FORCE_N = 1.0  # an operator's hand-driven motion stops at the first touch
SHOWN_S, QUIET_S = 0.1, 2.0  # how often a motion is told; what is over within so long needs no telling
PATIENCE_RATIO, PATIENCE_S = 1.5, 10.0  # of a motion over the whole travel

valid_days_option = click.option(
    "--valid-days",
    type=click.IntRange(1, 36_500),
    default=365,
    show_default=True,
    help="After how many days it is past its date.",
)


@click.group()
def command() -> None:
    """Talk to the indentation rig: info, jog, tare, home, calibrate."""


@command.command()
@bench_option
@json_option
def info(bench_name: str, as_json: bool) -> None:
    """Say who answers and how it stands, and where its map contradicts itself; nothing moves."""
    from drivers.rig.plausible import contradictions

    with _rig(bench_name, "asking the rig") as (rig, _):
        identity, air, now = rig.identify(), rig.environment(), rig.fresh_sample()
        doubts = list(contradictions(rig.registers))
    body = {
        "model": identity.model,
        "serial": identity.serial,
        "firmware": identity.firmware,
        "capacity_N": identity.capacity_N,
        "travel_mm": identity.travel_mm,
        **air,
        **_state(now),
    }
    lines = [f"{name:18} {spoken(value)}" for name, value in body.items()]
    show({**body, "doubts": doubts}, as_json, [*lines, *(f"doubt: {each}; is that so?" for each in doubts)])


@command.command()
@bench_option
@click.option(
    "--time-s", type=click.FloatRange(0.05, 3600), default=1.0, show_default=True, help="How long to average."
)
@json_option
def tare(bench_name: str, time_s: float, as_json: bool) -> None:
    """Average the force with the indenter free: the zero, its noise and drift. Nothing moves."""
    import numpy as np

    with _rig(bench_name, "reading the zero") as (rig, _):
        found = _sampled(rig, time_s)
    forces, times = np.array([s.force_N for s in found]), np.array([s.time_s for s in found])
    drift = float(np.polyfit(times, forces, 1)[0]) if len(found) > 2 else 0.0
    noise = float(forces.std(ddof=1))
    body = {"zero_N": float(forces.mean()), "noise_N": noise, "drift_N_s": drift, "samples_count": len(found)}
    show(body, as_json, [f"zero {body['zero_N']:.4f} N, noise {noise:.4f} N, drift {1000 * drift:.3f} mN/s"])


@command.command()
@bench_option
@click.option("--speed-mm-s", type=SPEED_MM_S, default=5.0, show_default=True, help="How fast the stage moves.")
@yes_option
@json_option
def home(bench_name: str, speed_mm_s: float, yes: bool, as_json: bool) -> None:
    """Drive up to the home switch, where position is 0."""
    way = Way("home", "Drive up to the home switch?", speed_mm_s, lambda _: 0.0, lambda rig, _: rig.home(speed_mm_s))
    _moved(bench_name, way, yes, as_json)


@command.command(context_settings={"ignore_unknown_options": True})  # -5 is a place, no option
@click.argument("by_mm", type=PLACE_MM)
@bench_option
@click.option("--speed-mm-s", type=SPEED_MM_S, default=1.0, show_default=True, help="How fast the stage moves.")
@yes_option
@json_option
def jog(by_mm: float, bench_name: str, speed_mm_s: float, yes: bool, as_json: bool) -> None:
    """Move BY_MM (positive: down). Downwards it stops at the first touch, 1 N above what the cell shows now."""

    def begin(rig: Indenter, now: Sample) -> int:
        goal_mm = now.position_mm + by_mm
        if by_mm > 0:
            return rig.move(goal_mm, speed_mm_s, "above", now.force_N + JOG_FORCE_N)
        return rig.move(goal_mm, speed_mm_s)

    way = Way("jog", f"Move {by_mm:+g} mm?", speed_mm_s, lambda now: now.position_mm + by_mm, begin)
    _moved(bench_name, way, yes, as_json)


@command.command()
@bench_option
@click.option("--speed-mm-s", type=SPEED_MM_S, default=1.0, show_default=True, help="How fast the stage moves.")
@yes_option
@json_option
def retract(bench_name: str, speed_mm_s: float, yes: bool, as_json: bool) -> None:
    """Clear a latched fault and drive up to position 0, slowly; never downwards."""
    question = "Clear the faults and drive up?"
    way = Way("retract", question, speed_mm_s, lambda _: 0.0, lambda rig, _: rig.move(0.0, speed_mm_s))
    _moved(bench_name, way, yes, as_json)


@command.command()
@bench_option
@yes_option
@json_option
def clear(bench_name: str, yes: bool, as_json: bool) -> None:
    """Make the controller forget its latched faults; nothing moves."""
    from fabctl.errors import Stopped

    with _rig(bench_name, "clearing faults") as (rig, _):
        now = rig.fresh_sample()
        if not confirm(f"Clear {', '.join(now.faults) or 'no faults'}?", yes):
            raise Stopped("not cleared")
        rig.clear_faults()
        after = rig.fresh_sample()
    show(_state(after), as_json, [f"{after.state}, faults: {', '.join(after.faults) or 'none'}"])


@command.group()
def calibrate() -> None:
    """Calibrate the load cell with masses, or the frame with a rigid block."""


@calibrate.command("force")
@click.option(
    "--mass-g",
    "masses_g",
    type=click.FloatRange(0, 1e6),
    multiple=True,
    default=(0, 100, 200, 500),
    show_default=True,
    help="A known mass; one option each.",
)
@valid_days_option
@bench_option
@yes_option
@json_option
def calibrate_force_command(
    masses_g: tuple[float, ...], valid_days: int, bench_name: str, yes: bool, as_json: bool
) -> None:
    """Lay known masses on the cell, one after the other; nothing moves."""
    from fabctl.errors import Stopped
    from fabctl.indent.calibrate import calibrate_force, hang_in_slot

    with _rig(bench_name, "calibrating the load cell") as (rig, bench):
        slot = bench.slot

        def put_on(mass_kg: float) -> None:
            if slot is not None:
                hang_in_slot(slot, mass_kg)
            elif not confirm(f"Lay {1000 * mass_kg:g} g on the cell. Done?", yes):
                raise Stopped("not calibrated")

        masses_kg = [mass / 1000 for mass in masses_g]
        try:
            run, body = calibrate_force(lab().root, bench.config, rig, masses_kg, put_on, progress(), valid_days)
        finally:
            if slot is not None:
                hang_in_slot(slot, 0.0)
    lines = [f"gain {body['gain_ratio']:.5f} ± {2 * body['gain_se_ratio']:.5f} (k = 2), zero {body['zero_N']:.4f} N"]
    show({"run": run.run_id, **body}, as_json, lines)


@calibrate.command("frame")
@click.option(
    "--force-N",
    "force_N",
    type=click.FloatRange(0.001, 10_000),
    default=8.0,
    show_default=True,
    help="How hard to press the block.",
)
@click.option(
    "--block-mm-N",
    "block_mm_N",
    type=click.FloatRange(0, 10),
    default=0.0,
    show_default=True,
    help="What the block itself gives.",
)
@valid_days_option
@bench_option
@yes_option
@json_option
def calibrate_frame_command(
    force_N: float, block_mm_N: float, valid_days: int, bench_name: str, yes: bool, as_json: bool
) -> None:
    """Press a rigid block three times: what gives way is the frame."""
    from fabctl.errors import Stopped
    from fabctl.indent.calibrate import block_in_slot, calibrate_frame

    if not confirm(f"A rigid block lies under the indenter; press it with {force_N:g} N?", yes):
        raise Stopped("not calibrated")
    with _rig(bench_name, "calibrating the frame") as (rig, bench):
        if bench.slot is not None:
            block_in_slot(bench.slot)
        assert bench.config.rig is not None
        run, body = calibrate_frame(
            lab().root, bench.config, rig, bench.config.rig, force_N, progress(), block_mm_N, valid_days
        )
    twice = 2 * body["compliance_se_mm_N"]
    lines = [f"frame {body['compliance_mm_N']:.5f} ± {twice:.5f} mm/N (k = 2), {body['curves_count']} curves"]
    show({"run": run.run_id, **body}, as_json, lines)


@contextmanager
def _rig(bench_name: str, purpose: str) -> Iterator[tuple[Indenter, Bench]]:
    """Lend the bench's rig."""
    from contextlib import closing

    from drivers.rig.indenter import open_indenter
    from fabctl.bench import open_bench, refuse_without
    from fabctl.config.bench import load_bench
    from fabctl.config.rig import load_rig

    place = lab()
    config = load_bench(bench_name, place.root)
    refuse_without(config, "rig")
    assert config.rig is not None
    registers = load_rig(config.rig.map, place.root)
    with (
        open_bench(place, config, purpose) as bench,
        closing(open_indenter(bench.url("rig"), registers)) as rig,
    ):
        yield rig, bench


@dataclass(frozen=True)
class Way:
    """One motion by hand: its word, what is asked first, where it goes from a sample on, and what begins it."""

    word: str
    question: str
    speed_mm_s: float
    goal_mm: Callable[[Any], float]  # of the sample before it
    begin: Callable[[Any, Any], int]  # rig and sample; the command's number


def _moved(bench_name: str, way: Way, yes: bool, as_json: bool) -> None:
    """Ask, arm, move, stop, disarm; the stage is stopped on every way out."""
    from drivers.rig.indenter import Limits
    from fabctl.errors import Stopped
    from fabctl.records.ending import undisturbed

    if not confirm(way.question, yes):
        raise Stopped("not moved")
    with _rig(bench_name, f"{way.word} of the rig") as (rig, bench):
        config = bench.config.rig
        assert config is not None
        rig.clear_faults()
        rig.set_limits(Limits(config.force_limit_N, -2.0, 0.0, config.travel_mm, 0.5, 50.0, 0.5))
        try:
            now = rig.fresh_sample()
            rig.hear = _told(way, now)
            rig.arm()
            rig.wait(way.begin(rig, now), PATIENCE_RATIO * config.travel_mm / way.speed_mm_s + PATIENCE_S)
        finally:
            with undisturbed():
                rig.stop()
                rig.disarm()
        after = rig.fresh_sample()
    show(_state(after), as_json, [f"{way.word}: at {after.position_mm:.3f} mm, {after.force_N:.3f} N gross"])


def _told(way: Way, start: Sample) -> Callable[[Sample], None]:
    """Return a listener that shows how far a motion has come, some times a second."""
    from fabctl.events import Event

    tell, whole_mm, shown_s = progress(), way.goal_mm(start) - start.position_mm, start.time_s

    def hear(sample: Sample) -> None:
        nonlocal shown_s
        if sample.time_s - shown_s < SHOWN_S:
            return
        shown_s = sample.time_s
        done = (sample.position_mm - start.position_mm) / whole_mm if whole_mm else 0.0
        words = f"{way.word}: at {sample.position_mm:.2f} mm, {sample.force_N:.3f} N gross"
        tell(Event("progress", words, min(0.999, max(0.0, done))))

    return hear


def _sampled(rig: Indenter, time_s: float) -> list[Sample]:
    from drivers.clock import WallClock
    from fabctl.events import Event

    tell, clock, found = progress(), WallClock(), []
    began_s = clock.now_s()
    while (past_s := clock.now_s() - began_s) < time_s:
        found.append(rig.fresh_sample())
        if time_s > QUIET_S:
            tell(Event("progress", f"{found[-1].force_N:.4f} N, {time_s - past_s:.0f} s left", past_s / time_s))
        clock.sleep(0.01)
    return found


def _state(sample: Sample) -> dict[str, Any]:
    return {
        "state": sample.state,
        "faults": list(sample.faults),
        "position_mm": sample.position_mm,
        "force_gross_N": sample.force_N,
    }
