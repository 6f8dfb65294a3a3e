"""`fabctl library`: build, look into, compare and calibrate the library of bistable cells."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from fabctl.cli.common import MATERIAL, json_option, lab, progress, say, show
from fabctl.cli.paths import InFile, OutFile, PictureFile

if TYPE_CHECKING:
    from design.cells.calibrate import Loading
    from design.cells.compare import Comparison, Unanswered
    from design.cells.homogenise import Cell, Failure
    from design.cells.library import CellLibrary
    from design.cells.sheet import Sheet
    from design.cells.sweep import Progress

material_option = click.option(
    "--material", type=MATERIAL, default="natural-rubber-2.3", show_default=True, help="Material file or its name."
)
file_option = click.option(
    "--library", "file", type=InFile(), help="A library file [the shipped one of the paper's sheet]."
)
t_option = click.option("--t-mm", type=float, required=True, help="Where slit 1 starts on its edge.")
theta_option = click.option("--theta-deg", type=float, required=True, help="Direction of slit 1.")
TOLD_ROWS_COUNT = 10  # of the rows without numbers, for a person
jobs_option = click.option("--jobs", type=int, default=-1, show_default=True, help="Processes; -1 is one per core.")


def _sheet(material: str) -> Sheet:
    from fabctl.config.material import load_material, sheet_of

    return sheet_of(load_material(material, lab().root))


@click.group()
def command() -> None:
    """Build, look into and compare the library of bistable cells."""


@command.command()
@material_option
@click.option(
    "--theta", "theta_count", type=click.IntRange(5), default=43, show_default=True, help="Angles, -30° to 30°."
)
@click.option("--t-step-mm", type=float, default=0.01, show_default=True, help="Step of t.")
@click.option(
    "--open", "is_open", is_flag=True, help="The contracting kind: cut as holes, closing to its second state."
)
@jobs_option
@click.option("--cluster", metavar="URL", help="A dask scheduler, tcp://HOST:PORT, whose workers have fabctl.")
@click.option("-o", "--output", type=OutFile((".npz",), "a library"), default=Path("library.npz"), show_default=True)
@json_option
def build(
    material: str,
    theta_count: int,
    t_step_mm: float,
    is_open: bool,
    jobs: int,
    cluster: str | None,
    output: Path,
    as_json: bool,
) -> None:
    """Simulate every cell of a sheet; goes on where an earlier build stopped."""
    processes = _processes(jobs)
    from design.cells.sweep import plan_of, sweep

    sheet = _sheet(material)
    plan = plan_of(sheet, theta_count, t_step_mm, kind="open" if is_open else "slit")
    parts = lab().root / "library-cache"
    report = _progress()
    try:
        cells = sweep(plan, parts, jobs=processes, cluster=cluster, report=report)
    except KeyboardInterrupt:
        say(f"stopped; finished columns are kept in {parts / plan.key()[:16]}, the same command goes on from there")
        raise
    from design.cells.library import load_library, save_library

    words = f"fabctl library build --material {material} --theta {theta_count} --t-step-mm {t_step_mm:g}"
    save_library(output, plan, sheet, cells, words + (" --open" if is_open else ""))
    library = load_library(output)
    show({"file": str(output), **_summary(library)}, as_json, [f"{output}", *_lines(library)])


def _processes(jobs: int) -> int:
    """Return how many processes work, each with one thread.

    The matrices of a cell are too small to share: on a busy machine two threads of BLAS cost a column 5.5 s of
    processor time, one costs 3.2 s. Called before NumPy is loaded, which reads these once; workers inherit them.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    return len(os.sched_getaffinity(0)) if jobs == -1 else max(jobs, 1)


def _progress() -> Any:
    from fabctl.events import Event

    listen = progress()

    def report(now: Progress) -> None:
        left = "" if now.left_s is None else f", {now.left_s:.0f} s left"
        text = f"{now.done_count} of {now.total_count} cells, {now.elapsed_s:.0f} s{left}"
        listen(Event("progress", text, now.done_count / now.total_count))

    return report


def _summary(library: CellLibrary) -> dict[str, Any]:
    low, high = library.range_ratio()
    return {
        "cells_count": len(library), "range_ratio": [low, high], "spread_ratio": high / low,
        "candidates": library.counts(),
        "reasons": library.reasons(),
        "shallow_count": len(library.shallow_cells()[0]),
        "sheet": asdict(library.sheet),
        "hash": library.hash,
        "command": library.meta["command"],
    }  # fmt: skip


def _lines(library: CellLibrary) -> Iterator[str]:
    from design.cells.homogenise import SHALLOW_WELL_RATIO

    low, high = library.range_ratio()
    sheet = library.sheet
    yield f"{len(library)} bistable cells, expansion {low:.4f} to {high:.4f} (spread {high / low:.3f})"
    if shallow := len(library.shallow_cells()[0]):
        yield (
            f"{shallow} of them were decided at half the mesh size: at the full size their barrier is less than "
            f"{SHALLOW_WELL_RATIO:.1%} of the energy stored"
        )
    yield "candidates: " + ", ".join(f"{count} {verdict}" for verdict, count in library.counts().items())
    yield from (f"  {count:5d} {reason}" for reason, count in library.reasons().items())
    yield (
        f"sheet: edge {sheet.edge_mm:g} mm, slit {sheet.slit_mm:g} mm, hinge {sheet.hinge_mm:g} mm, thickness "
        f"{sheet.thickness_mm:g} mm, E {sheet.E_MPa:g} MPa, ν {sheet.nu_ratio:g}"
    )
    yield f"hash {library.hash[:16]}, made by: {library.meta['command']}"


@command.command("show")
@file_option
@json_option
def show_command(file: Path | None, as_json: bool) -> None:
    """Say what a library holds: range, counts with reasons, material, hash."""
    from design.cells.library import load_library

    library = load_library(file)
    show(_summary(library), as_json, _lines(library))


@command.command()
@file_option
@click.option("--t-mm", type=float, help="Plot energy and force of this cell instead of the maps.")
@click.option("--theta-deg", type=float)
@click.option("-o", "--output", type=PictureFile(), default=Path("library.svg"), show_default=True)
@json_option
def plot(file: Path | None, t_mm: float | None, theta_deg: float | None, output: Path, as_json: bool) -> None:
    """Draw the four maps, or energy and force of one cell along its uniaxial stretch."""
    from design.cells.homogenise import Failure, Trail, walked
    from design.cells.library import energy_scale_mJ, load_library
    from design.cells.mesh import REFERENCE
    from design.cells.periodic import periodic_cell, positions, uniaxial_curve
    from fabctl.reports import cells as pictures

    library = load_library(file)
    if (t_mm is None) != (theta_deg is None):
        raise click.UsageError("give both --t-mm and --theta-deg, or neither")
    if t_mm is None or theta_deg is None:
        pictures.save(pictures.maps(library), output)
    else:
        found, _, _ = walked(t_mm, math.radians(theta_deg), library.sheet, REFERENCE, Trail())
        if isinstance(found, Failure):
            _refuse(t_mm, theta_deg, found)
        m, pair = found
        cell, states = periodic_cell(m), (pair.saddle.s_ratio, pair.stable.s_ratio)
        known = [
            (positions(cell, m, m.nodes(state.y, state.s_ratio), state.s_ratio), state.s_ratio)
            for state in (pair.saddle, pair.stable)
        ]
        curve = uniaxial_curve(cell, states[1] + 0.03, known=known)
        title = f"t = {t_mm:g} mm, θ = {theta_deg:g}°"
        pictures.save(pictures.energy(curve, states, energy_scale_mJ(library.sheet), title), output)
    show({"picture": str(output), "library": library.hash}, as_json, [str(output)])


def _refuse(t_mm: float, theta_deg: float, why: Failure) -> NoReturn:
    from design.errors import DesignError

    raise DesignError(f"the cell t = {t_mm:g} mm, θ = {theta_deg:g}° is {why.verdict}: {why.reason}")


@command.command("cell")
@t_option
@theta_option
@material_option
@click.option("-o", "--output", type=PictureFile(), help="Draw the states of the cell into this file.")
@json_option
def cell_command(t_mm: float, theta_deg: float, material: str, output: Path | None, as_json: bool) -> None:
    """Solve one cell: its numbers and slits, and with -o a picture of its states. Exit code 3 if it is not bistable."""
    from design.cells.geometry import cell_slits
    from design.cells.homogenise import Failure, solve_cell
    from design.cells.states import cell_states
    from fabctl.errors import REFUSED
    from fabctl.reports import cells as pictures

    sheet, theta = _sheet(material), math.radians(theta_deg)
    cell = solve_cell(t_mm, theta, sheet)
    numbers = _numbers(cell, sheet)
    numbers["slits_mm"] = None if cell.verdict == "invalid" else cell_slits(t_mm, theta, sheet).tolist()
    show(numbers, as_json, _cell_lines(numbers))
    if cell.verdict != "bistable":
        raise SystemExit(REFUSED)
    if output is not None:
        found = cell_states(t_mm, theta, sheet)
        if isinstance(found, Failure):
            _refuse(t_mm, theta_deg, found)
        pictures.save(pictures.states(found), output)


def _cell_lines(numbers: dict[str, Any]) -> Iterator[str]:
    """Yield the numbers with the digits they have: the mesh alone moves an expansion by 0.002."""
    for key, value in numbers.items():
        if key == "slits_mm" and value is not None:
            for k, slit in enumerate(value, 1):
                yield f"slit {k}, mm: " + ", ".join(f"({x:.4f}, {y:.4f})" for x, y in slit)
        elif isinstance(value, float):
            yield f"{key}: {value:.1e}" if key == "residual_ratio" else f"{key}: {value:.5g}"
        elif value is not None:
            yield f"{key}: {value}"


def _numbers(cell: Cell, sheet: Sheet) -> dict[str, Any]:
    from design.cells.library import energy_scale_mJ, hexagon_mm2

    scale = energy_scale_mJ(sheet)

    def scaled(value_mm2: float | None) -> float | None:
        return None if value_mm2 is None else value_mm2 * scale

    stiffness = scaled(cell.stiffness_mm2)
    return {
        "verdict": cell.verdict,
        "reason": cell.reason or None,
        "residual_ratio": None if math.isnan(cell.residual_ratio) else cell.residual_ratio,
        "t_mm": cell.t_mm,
        "theta_deg": math.degrees(cell.theta_rad),
        "expansion_ratio": cell.expansion_ratio,
        "saddle_ratio": cell.saddle_ratio,
        "barrier_mJ": scaled(cell.barrier_mm2),
        "stored_mJ": scaled(cell.stored_mm2),
        "stiffness_mJ": stiffness,
        "Y_N_mm": None if stiffness is None else stiffness / hexagon_mm2(sheet),
        "nu_tangent_ratio": cell.nu_tangent_ratio,
        "mesh_ratio": cell.mesh_ratio,
    }


@command.command()
@click.argument("published", type=InFile())
@material_option
@file_option
@jobs_option
@json_option
def compare(published: Path, material: str, file: Path | None, jobs: int, as_json: bool) -> None:
    """Compare with a PUBLISHED table: each row solved afresh, then the library interpolated."""
    processes = _processes(jobs)
    import numpy as np

    from design.cells import compare as comparing
    from design.cells.library import load_library
    from fabctl.errors import UsageError
    from fabctl.events import Event
    from fabctl.files import text_of

    sheet, library = _sheet(material), load_library(file)
    try:
        table = comparing.read_published(text_of(published, "a table of cells"), sheet)
    except comparing.TableError as fault:
        raise UsageError(f"{published}: {fault}") from fault
    listen, total = progress(), len(table.t_mm)
    cells = comparing.solve_rows(
        table, sheet, jobs=processes, done=lambda n: listen(Event("progress", f"{n} of {total} rows", n / total))
    )
    subset = table.comparable(sheet)
    everything = np.ones(total, dtype=bool)
    result: dict[str, Any] = {"rows_count": total, "comparable_count": int(subset.sum())}
    lines = [f"{total} rows, {int(subset.sum())} comparable"]
    ways = {
        "solved": comparing.columns_of(cells),
        "interpolated": comparing.interpolated(table, library.scaled(sheet)),
    }
    for way, numbers in ways.items():
        fair = comparing.compared(table, numbers, subset if subset.any() else everything)
        for name, rows in (("comparable", subset), ("all", everything)):
            if rows.any():
                found = comparing.compared(table, numbers, rows, fair.scale)
                result[f"{way}_{name}"] = {**asdict(found), "worst": [_worst(table, numbers, k) for k in found.worst]}
                lines += _comparison(f"{way}, {name} rows", found)
    result["verdicts"] = comparing.verdicts(cells)
    lines.append("solved rows: " + ", ".join(f"{n} {verdict}" for verdict, n in result["verdicts"].items()))
    lines += [f"  worst: {row}" for row in result.get("solved_comparable", result["solved_all"])["worst"]]
    for way, silent in (
        ("solved", comparing.unanswered(cells)),
        ("interpolated", comparing.outside(table, ways["interpolated"][0])),
    ):
        result[f"{way}_unanswered"] = [asdict(row) for row in silent]
        lines += _unanswered(way, silent)
    show(_finite(result), as_json, lines)


def _unanswered(way: str, rows: list[Unanswered]) -> Iterator[str]:
    for row in rows[:TOLD_ROWS_COUNT]:
        yield f"  {way}, row {row.row}: t {row.t_mm:.4f} mm, θ {row.theta_deg:.3f}° is {row.verdict}: {row.reason}"
    if len(rows) > TOLD_ROWS_COUNT:
        yield f"  {way}: {len(rows) - TOLD_ROWS_COUNT} more rows without numbers; --json names them all"


def _worst(table: Any, numbers: Any, row: int) -> dict[str, float]:
    return {
        "t_mm": float(table.t_mm[row]),
        "theta_deg": math.degrees(table.theta_rad[row]),
        "published_ratio": float(table.expansion_ratio[row]),
        "found_ratio": float(numbers[0][row]),
    }


def _comparison(title: str, found: Comparison) -> Iterator[str]:
    yield f"{title}: {found.answered_count} of {found.rows_count} answered, scale {found.scale:.4g} per mm²"
    for name, spread in (
        ("expansion, absolute", found.expansion),
        ("stiffness, relative", found.stiffness),
        ("barrier, relative", found.barrier),
    ):
        yield (
            f"  {name:20} median {spread.median:.5f}  95 % {spread.q95:.5f}  99 % {spread.q99:.5f}  "
            f"worst {spread.worst:.5f}"
        )


def _finite(value: Any) -> Any:
    """Return the tree with NaN as null: JSON has no word for it."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@command.command()
@click.argument("measured", type=InFile())
@click.argument("response", type=InFile())
@click.option("--point", type=int, help="Which of MEASURED's points, where it has several.")
@click.option("--curve", type=int, help="Which curve of that point [the last].")
@material_option
@json_option
def calibrate(
    measured: Path, response: Path, point: int | None, curve: int | None, material: str, as_json: bool
) -> None:
    """Find E·thickness: MEASURED (a run's curves.csv) against the RESPONSE.csv predicted for the same specimen."""
    from design.cells.calibrate import calibrate as fit

    sheet = _sheet(material)
    loading, model = _loading(measured, point, curve), _loading(response)
    found = fit(loading.depth_mm, loading.force_N, model.depth_mm, model.force_N)
    stretch = sheet.E_MPa * sheet.thickness_mm
    result = {
        **asdict(found),
        "curve": loading.name,
        "E_thickness_N_mm": found.factor_ratio * stretch,
        "E_thickness_ci95_N_mm": found.factor_ci95_ratio * stretch,
        "E_MPa": found.factor_ratio * sheet.E_MPa,
    }
    lines = [
        f"E·thickness {result['E_thickness_N_mm']:.4g} ± {result['E_thickness_ci95_N_mm']:.2g} N/mm "
        f"(the material file says {stretch:.4g})",
        f"at {sheet.thickness_mm:g} mm: E_MPa: {result['E_MPa']:.4g}",
        f"contact at {found.contact_mm:.3f} mm, misfit {found.misfit_ratio:.1%} of the greatest force, "
        f"{found.samples_count} samples" + (f" of {loading.name}" if loading.name else ""),
    ]
    show(result, as_json, lines)


def _loading(path: Path, point: int | None = None, curve: int | None = None) -> Loading:
    from design.cells.calibrate import read_loading
    from design.errors import DesignError
    from fabctl.errors import UsageError
    from fabctl.files import text_of

    text = text_of(path, "a CSV with the columns depth_mm and load_N")
    try:
        return read_loading(text, point, curve)
    except DesignError as fault:
        raise UsageError(f"{path}: {fault}") from fault
