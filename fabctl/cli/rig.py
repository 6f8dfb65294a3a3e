"""`fabctl rig`: talk to the indentation rig."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import PLACE_MM, bench_option, confirm, json_option, lab, show, yes_option

if TYPE_CHECKING:
    from drivers.rig.indenter import Indenter
    from drivers.rig.samples import Sample
    from fabctl.bench import Bench

SPEED_MM_S = click.FloatRange(0, 1000, min_open=True)
JOG_FORCE_N = 1.0  # an operator's hand-driven motion stops at the first touch


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
    lines = [f"{name:18} {_spoken(value)}" for name, value in body.items()]
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
    _moved(bench_name, "home", "Drive up to the home switch?", yes, as_json, lambda rig, _: rig.home(speed_mm_s))


@command.command()
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

    _moved(bench_name, "jog", f"Move {by_mm:+g} mm?", yes, as_json, begin)


@command.command()
@bench_option
@click.option("--speed-mm-s", type=SPEED_MM_S, default=1.0, show_default=True, help="How fast the stage moves.")
@yes_option
@json_option
def retract(bench_name: str, speed_mm_s: float, yes: bool, as_json: bool) -> None:
    """Clear a latched fault and drive up to position 0, slowly; never downwards."""
    _moved(
        bench_name,
        "retract",
        "Clear the faults and drive up?",
        yes,
        as_json,
        lambda rig, _: rig.move(0.0, speed_mm_s),
    )


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
@click.option(
    "--valid-days",
    type=click.IntRange(1, 36_500),
    default=365,
    show_default=True,
    help="After how many days it is past its date.",
)
@bench_option
@yes_option
@json_option
def calibrate_force_command(
    masses_g: tuple[float, ...], valid_days: int, bench_name: str, yes: bool, as_json: bool
) -> None:
    """Lay known masses on the cell, one after the other; nothing moves."""
    from fabctl.cli.common import progress
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
            run, body = calibrate_force(lab().root, bench.config.name, rig, masses_kg, put_on, progress(), valid_days)
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
@click.option(
    "--valid-days",
    type=click.IntRange(1, 36_500),
    default=365,
    show_default=True,
    help="After how many days it is past its date.",
)
@bench_option
@yes_option
@json_option
def calibrate_frame_command(
    force_N: float, block_mm_N: float, valid_days: int, bench_name: str, yes: bool, as_json: bool
) -> None:
    """Press a rigid block three times: what gives way is the frame."""
    from fabctl.cli.common import progress
    from fabctl.errors import Stopped
    from fabctl.indent.calibrate import block_in_slot, calibrate_frame

    if not confirm(f"A rigid block lies under the indenter; press it with {force_N:g} N?", yes):
        raise Stopped("not calibrated")
    with _rig(bench_name, "calibrating the frame") as (rig, bench):
        if bench.slot is not None:
            block_in_slot(bench.slot)
        assert bench.config.rig is not None
        run, body = calibrate_frame(
            lab().root, bench.config.name, rig, bench.config.rig, force_N, progress(), block_mm_N, valid_days
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


def _moved(bench_name: str, word: str, question: str, yes: bool, as_json: bool, begin: Any) -> None:
    """Ask, arm, move, stop, disarm; the stage is stopped on every way out."""
    from drivers.rig.indenter import Limits
    from fabctl.errors import Stopped

    if not confirm(question, yes):
        raise Stopped("not moved")
    with _rig(bench_name, f"{word} of the rig") as (rig, bench):
        config = bench.config.rig
        assert config is not None
        rig.clear_faults()
        rig.set_limits(Limits(config.force_limit_N, -2.0, 0.0, config.travel_mm, 0.5, 50.0, 0.5))
        try:
            now = rig.fresh_sample()
            rig.arm()
            after = rig.wait(begin(rig, now), 120.0)
        finally:
            rig.stop()
            rig.disarm()
        after = rig.fresh_sample()
    show(_state(after), as_json, [f"{word}: at {after.position_mm:.3f} mm, {after.force_N:.3f} N gross"])


def _sampled(rig: Indenter, time_s: float) -> list[Sample]:
    from drivers.clock import WallClock

    clock, found = WallClock(), []
    until_s = clock.now_s() + time_s
    while clock.now_s() < until_s:
        found.append(rig.fresh_sample())
        clock.sleep(0.01)
    return found


def _spoken(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _state(sample: Sample) -> dict[str, Any]:
    return {
        "state": sample.state,
        "faults": list(sample.faults),
        "position_mm": sample.position_mm,
        "force_gross_N": sample.force_N,
    }
