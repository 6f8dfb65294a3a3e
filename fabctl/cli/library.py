"""`fabctl library`: look into, compare and calibrate the library of bistable cells; `library_build` makes one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from fabctl.cli.common import json_option, progress, say, show
from fabctl.cli.library_build import build
from fabctl.cli.library_parts import (
    file_option,
    jobs_option,
    lines_of,
    material_option,
    processes_of,
    sheet_named,
    summary,
    t_option,
    theta_option,
)
from fabctl.cli.paths import InFile, PictureFile

if TYPE_CHECKING:
    from design.cells.calibrate import Loading
    from design.cells.compare import Comparison, Unanswered
    from design.cells.homogenise import Cell, Failure
    from design.cells.sheet import Sheet

TOLD_ROWS_COUNT = 10  # of the rows without numbers, for a person


@click.group()
def command() -> None:
    """Build, look into and compare the library of bistable cells."""


command.add_command(build)


@command.command("show")
@file_option
@json_option
def show_command(file: Path | None, as_json: bool) -> None:
    """Say what a library holds: range, counts with reasons, material, hash."""
    from design.cells.library import load_library

    library = load_library(file)
    show(summary(library), as_json, lines_of(library))


@command.command()
@file_option
@click.option(
    "--t-mm", type=click.FloatRange(-1000, 1000), help="Plot energy and force of this cell instead of the maps."
)
@click.option("--theta-deg", type=click.FloatRange(-360, 360), help="Direction of slit 1 of that cell.")
@click.option(
    "-o", "--output", type=PictureFile(), default=Path("library.svg"), show_default=True, help="The picture to write."
)
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
    say(f"drawing {output}" if t_mm is None else f"solving the cell and its stretch, for {output}")
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
    from fabctl.errors import DONE, REFUSED
    from fabctl.reports import cells as pictures

    sheet, theta = sheet_named(material), math.radians(theta_deg)
    say("solving the cell")
    cell = solve_cell(t_mm, theta, sheet)
    numbers = _numbers(cell, sheet)
    numbers["slits_mm"] = None if cell.verdict == "invalid" else cell_slits(t_mm, theta, sheet).tolist()
    why = f"the cell t = {t_mm:g} mm, θ = {theta_deg:g}° is {cell.verdict}: {cell.reason}"
    show(numbers, as_json, _cell_lines(numbers), DONE if cell.verdict == "bistable" else REFUSED, why)
    if output is not None:
        say(f"drawing its states into {output}")
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
    processes = processes_of(jobs)
    import numpy as np

    from design.cells import compare as comparing
    from design.cells.library import load_library
    from fabctl.errors import UsageError
    from fabctl.events import Event
    from fabctl.files import text_of

    sheet, library = sheet_named(material), load_library(file)
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
@click.option("--point", type=click.IntRange(0, 9999), help="Which of MEASURED's points, where it has several.")
@click.option("--curve", type=click.IntRange(0, 9999), help="Which curve of that point [the last].")
@material_option
@json_option
def calibrate(
    measured: Path, response: Path, point: int | None, curve: int | None, material: str, as_json: bool
) -> None:
    """Find E·thickness: MEASURED (a run's curves.csv) against the RESPONSE.csv predicted for the same specimen."""
    from design.cells.calibrate import calibrate as fit

    sheet = sheet_named(material)
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
