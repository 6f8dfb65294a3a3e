"""`fabctl deploy`: predict the deployed shape of a design, its sag on a support and its other shapes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from fabctl.cli.common import PLACE_MM, json_option, lab, progress, show
from fabctl.cli.paths import InFolder, OutFolder

if TYPE_CHECKING:
    from design.deploy.newton import Equilibrium
    from design.deploy.predict import Deployed
    from design.deploy.supports import Settled
    from design.spec import Rim
    from fabctl.deploying import Laid
    from fabctl.events import Emit

GIVEN = (ParameterSource.COMMANDLINE, ParameterSource.ENVIRONMENT)


@click.command()
@click.argument("design", type=InFolder())
@click.option("--gravity", is_flag=True, help="Let the sheet's own weight act (along −z).")
@click.option(
    "--support",
    type=click.Choice(["held", "no-slip", "coulomb", "slip"]),
    default="no-slip",
    show_default=True,
    help="What the rim stands on, with --gravity.",
)
@click.option(
    "--friction", type=click.FloatRange(0, 10), default=0.5, show_default=True, help="Coefficient for coulomb."
)
@click.option("--level-floor", is_flag=True, help="A level floor instead of a bed made to the rim.")
@click.option(
    "--shapes", type=click.IntRange(0, 10_000), default=0, help="Look for other equilibria from this many starts."
)
@click.option(
    "--hint",
    "hints",
    type=(PLACE_MM, PLACE_MM, click.Choice(["up", "down"])),
    multiple=True,
    metavar="X Y up|down",
    help="Push the bump at X, Y (mm from the middle of the cells' box) to a side; may be given again.",
)
@click.option("--parts", type=click.IntRange(1, 6), default=1, show_default=True, help="Triangles along a unit's side.")
@click.option(
    "--compensate",
    is_flag=True,
    help="Build DESIGN-compensated: other expansions, nearer to the target; with --gravity under its weight.",
)
@click.option("--cascade", "by_unit", is_flag=True, help="Open the sheet from flat, one unit after the other.")
@click.option("--animation/--no-animation", default=True, help="Write the deployment as an animated picture.")
@click.option("-o", "--output", type=OutFolder(), help="Folder to write into [DESIGN-deployed].")
@json_option
def command(
    design: Path,
    gravity: bool,
    support: Rim,
    friction: float,
    level_floor: bool,
    shapes: int,
    hints: tuple[tuple[float, float, str], ...],
    parts: int,
    compensate: bool,
    by_unit: bool,
    animation: bool,
    output: Path | None,
    as_json: bool,
) -> None:
    """Predict what the sheet of the design folder DESIGN pops up to."""
    from design.deploy.predict import deploy
    from design.deploy.supports import settle
    from fabctl.deploying import divided, read_laid
    from fabctl.events import Event

    if by_unit and parts > 1:
        raise click.UsageError("--cascade opens whole units: leave --parts out")
    _refuse_unused(gravity, support)
    emit = progress()
    emit(Event("stage", f"reading {design}"))
    laid = read_laid(design, lab().root)
    laid = divided(laid, parts) if parts > 1 else laid
    emit(Event("stage", f"deploying {len(laid.layout.cells)} units"))
    popped = _from_hints(laid, hints) if hints else deploy(laid.layout, laid.target, laid.goal_mm)
    settled = None
    if gravity:
        emit(Event("stage", f"its weight acts; rim: {support}"))
        settled = settle(laid.layout, popped.mesh.vertices_mm, laid.sheet, support, friction, not level_floor)
    folder = output or design.with_name(design.name + "-deployed")
    facts = {**_facts(popped, parts), **_softest(laid, popped.equilibrium), **_sag(settled, support, laid)}
    if shapes:
        facts["shapes"] = _shapes(laid, shapes, emit)
    if compensate:
        facts["compensated"] = _compensated(design, emit, support if gravity else None)
    folder.mkdir(parents=True, exist_ok=True)
    if by_unit:
        facts["cascade"] = _cascade(laid, folder, popped, animation, emit)
    facts["folder"] = str(folder)
    emit(Event("stage", f"drawing {'picture and animation' if animation else 'the picture'} into {folder}"))
    _write(folder, laid, popped, settled, animation, facts)
    show(facts, as_json, _lines(facts))


def _refuse_unused(gravity: bool, support: Rim) -> None:
    """Raise `click.UsageError` where an option was given that another one takes all effect from."""
    ctx = click.get_current_context()
    given = [name for name in ("support", "friction", "level_floor") if ctx.get_parameter_source(name) in GIVEN]
    words = [f"--{name.replace('_', '-')}" for name in given]
    if words and not gravity:
        raise click.UsageError(f"{', '.join(words)} says how the sheet bears its weight: give --gravity too")
    if "friction" in given and support != "coulomb":
        raise click.UsageError(f"--friction is that of --support coulomb, and this rim is {support}")


def _from_hints(laid: Laid, hints: tuple[tuple[float, float, str], ...]) -> Deployed:
    """Return the shape in which the bumps at some places are pushed to given sides."""
    from design.deploy.predict import compared
    from design.deploy.search import hinted

    sides = [(x, y, 1.0 if side == "up" else -1.0) for x, y, side in hints]
    try:
        rest = hinted(laid.layout, laid.goal_mm, sides)
    except ValueError as fault:
        raise click.UsageError(f"--hint: {fault}") from fault
    return compared(laid.layout, rest, laid.target, laid.goal_mm)


def _facts(popped: Deployed, parts: int) -> dict[str, Any]:
    rest, off = popped.equilibrium, popped.deviation
    return {
        "units_count": len(popped.mesh.faces) // parts**2,
        "triangles_count": len(popped.mesh.faces),
        "deviation_mean_mm": off.mean_mm,
        "deviation_rms_mm": off.rms_mm,
        "deviation_max_mm": off.max_mm,
        "deviation_mean_frac": off.mean_frac,
        "points_rms_mm": off.points_rms_mm,
        "energy_mJ": rest.energy_mJ,
        "stable": rest.stable,
        "residual_ratio": rest.residual_ratio,
        "iterations_count": rest.iterations_count,
    }


def _softest(laid: Laid, rest: Equilibrium) -> dict[str, Any]:
    """Return how far the shape is from giving way: the smallest stiffness of any small motion, rigid ones held."""
    from design.deploy.newton import System, smallest_eigenvalue_N_mm

    system = System(laid.layout.shell())
    return {"smallest_eigenvalue_N_mm": smallest_eigenvalue_N_mm(system, rest.x_mm, (), None)}


def _sag(settled: Settled | None, support: str, laid: Laid) -> dict[str, Any]:
    from design.deploy.compare import deviation

    if settled is None:
        return {}
    off = deviation(settled.equilibrium.x_mm, laid.layout.cells, laid.target)  # where it stands, not aligned anew
    return {
        "loaded_deviation_mean_mm": off.mean_mm,
        "loaded_deviation_max_mm": off.max_mm,
        "support": support,
        "weight_N": settled.weight_N,
        "sag_mm": settled.sag_mm,
        "slid_mm": settled.slid_mm,
        "standing_count": settled.standing_count,
        "loaded_residual_ratio": settled.equilibrium.residual_ratio,
        "loaded_iterations_count": settled.equilibrium.iterations_count,
        "loaded_smallest_eigenvalue_N_mm": settled.smallest_eigenvalue_N_mm,
        "loaded_stable": settled.equilibrium.stable,
    }


def _shapes(laid: Laid, count: int, emit: Emit) -> list[dict[str, Any]]:
    from design.deploy.predict import compared
    from design.deploy.search import equilibria
    from fabctl.events import Event

    def watch(done_frac: float, name: str) -> None:
        emit(Event("progress", f"looking for other shapes: {name}", done_frac))

    found, lost = equilibria(laid.layout, laid.design_mm, count, watch=watch)
    rows: list[dict[str, Any]] = []
    for one in found:
        off = compared(laid.layout, one.equilibrium, laid.target, laid.design_mm).deviation
        rest = one.equilibrium
        rows.append(
            {"energy_mJ": rest.energy_mJ, "deviation_mean_mm": off.mean_mm, "deviation_mean_frac": off.mean_frac,
             "stable": rest.stable, "residual_ratio": rest.residual_ratio, "iterations_count": rest.iterations_count,
             **_softest(laid, rest), "starts": list(one.starts)}
        )  # fmt: skip
    for line in lost:
        emit(Event("warning", f"no shape from {line}"))
    return rows


def _cascade(laid: Laid, folder: Path, popped: Deployed, animation: bool, emit: Emit) -> dict[str, Any]:
    """Open the sheet unit by unit; write every step into `cascade.csv` and the way as an animation."""
    from design.deploy.cascade import cascade, cascade_csv
    from design.deploy.path import followed
    from design.deploy.predict import compared
    from fabctl.deploying import animation_gif, wells_of
    from fabctl.events import Event
    from fabctl.records.folder import write_atomically

    found = cascade(
        laid.layout,
        wells_of(laid),
        intended_mm=popped.mesh.vertices_mm,
        watch=lambda done: emit(Event("progress", "opening unit after unit", done)),
    )
    write_atomically(folder / "cascade.csv", cascade_csv(found))
    if animation:
        gif = animation_gif(followed(found.frames_mm, popped.mesh.vertices_mm), popped.mesh, "opened unit by unit")
        write_atomically(folder / "cascade.gif", gif)
    end = replace(popped.equilibrium, x_mm=found.x_mm)
    off = compared(laid.layout, end, laid.target, laid.design_mm).deviation
    return {
        "pulled_count": len(found.steps) + len(found.failed),
        "stayed_count": sum(step.stays for step in found.steps),
        "taken_along_count": sum(len(step.opened) for step in found.steps),
        "snapped_back_count": sum(len(step.closed) for step in found.steps),
        "open_count": int(found.is_open.sum()),
        "failed": list(found.failed),
        "energy_mJ": found.energy_mJ,
        "stable": found.stable,
        "residual_ratio": found.residual_ratio,
        "iterations_count": found.iterations_count,
        "smallest_eigenvalue_N_mm": found.smallest_eigenvalue_N_mm,
        "deviation_mean_mm": off.mean_mm,
    }


def _compensated(design: Path, emit: Emit, rim: Rim | None) -> dict[str, Any]:
    """Build the same design with compensated expansions beside it, free or on `rim`; refuse where they do not help."""
    from design.bundle import open_bundle
    from fabctl.designing import build_compensated

    bundle = open_bundle(design)
    folder = design.with_name(design.name + "-compensated")
    built, told = build_compensated(bundle, folder, lab().root, emit, rim or True)
    off = None if built.predicted is None else built.predicted.deployed.deviation
    return {
        "folder": str(folder),
        "told": told.message,
        "deviation_rms_mm": None if off is None else off.rms_mm,
        "points_rms_mm": None if off is None else off.points_rms_mm,
    }


def _write(
    folder: Path, laid: Laid, popped: Deployed, settled: Settled | None, animation: bool, facts: dict[str, Any]
) -> None:
    from design.deploy.path import deployment
    from design.meshfiles import write_ply
    from design.surface import TriMesh
    from fabctl.deploying import animation_gif, picture_png
    from fabctl.records.folder import as_json, write_atomically

    folder.mkdir(parents=True, exist_ok=True)
    shown = popped.mesh if settled is None else TriMesh(settled.equilibrium.x_mm, popped.mesh.faces)
    write_ply(folder / "deployed.ply", shown)
    key, title = ("", "deployed") if settled is None else ("loaded_", f"under its weight, rim {facts['support']}")
    title += f": {facts[f'{key}deviation_mean_mm']:.2f} mm from the target on average, "
    title += f"{facts[f'{key}deviation_max_mm']:.2f} mm at most"
    write_atomically(folder / "deployed.png", picture_png(shown, laid.target, title))
    if animation:
        frames = deployment(laid.layout, popped.mesh.vertices_mm)
        write_atomically(folder / "deployment.gif", animation_gif(frames, popped.mesh, "deployment"))
    write_atomically(folder / "deploy.json", as_json(facts))


def _lines(facts: dict[str, Any]) -> list[str]:
    lines = [
        f"{facts['units_count']} units: {facts['deviation_mean_mm']:.2f} mm from the target on average "
        f"({facts['deviation_mean_frac']:.2%} of its diagonal), {facts['deviation_max_mm']:.2f} mm at most",
        f"{'stable' if facts['stable'] else 'not stable'} "
        f"(smallest eigenvalue {facts['smallest_eigenvalue_N_mm']:.1e} N/mm); residual {facts['residual_ratio']:.1e} "
        f"after {facts['iterations_count']} iterations",
    ]
    if "sag_mm" in facts:
        off_mm, most_mm = facts["loaded_deviation_mean_mm"], facts["loaded_deviation_max_mm"]
        lines.append(
            f"weight {facts['weight_N']:.3f} N, rim {facts['support']}: sags {facts['sag_mm']:.2f} mm at the top, "
            f"slides {facts['slid_mm']:.2f} mm; as it stands {off_mm:.2f} mm from the target on average, "
            f"{most_mm:.2f} mm at most; {'stable' if facts['loaded_stable'] else 'not stable'} "
            f"(smallest eigenvalue {facts['loaded_smallest_eigenvalue_N_mm']:.1e} N/mm)"
        )
    for shape in facts.get("shapes", []):
        lines.append(
            f"shape of {shape['energy_mJ']:.4f} mJ: {shape['deviation_mean_mm']:.2f} mm from the target, residual "
            f"{shape['residual_ratio']:.1e}, smallest eigenvalue {shape['smallest_eigenvalue_N_mm']:.1e} N/mm "
            f"({', '.join(shape['starts'])})"
        )
    if "cascade" in facts:
        way = facts["cascade"]
        lines.append(
            f"opened unit by unit: {way['open_count']} of {facts['units_count']} open at the end, "
            f"{way['taken_along_count']} taken along, {way['snapped_back_count']} snapped back, "
            f"{len(way['failed'])} without an answer; {way['deviation_mean_mm']:.2f} mm from the target"
        )
    if "compensated" in facts:
        lines.append(f"{facts['compensated']['folder']}: {facts['compensated']['told']}")
    return [*lines, f"written to {facts['folder']}"]
