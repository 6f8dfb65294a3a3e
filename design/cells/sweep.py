"""Every cell of a sheet, column by column of θ; parts are durable, so a stopped sweep goes on where it was.

One column is the unit of work: inside it each cell starts from its neighbours, across columns nothing is shared. Hence
the result is the same, bit for bit, whoever solves the columns and in what order.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from design.cells.geometry import t_bounds_mm
from design.cells.mesh import REFERENCE, Density
from design.cells.sheet import Sheet

if TYPE_CHECKING:  # the solver takes 2 s to load: the process that only shares out the work does so beside the workers
    from design.cells.homogenise import Cell, Trail

Array = NDArray[np.float64]

Kind = Literal["slit", "open"]  # cut as slits and expanding, or cut as holes and closing

THETA_LIMIT_RAD = math.pi / 6
LEAST_T_RATIO = 0.05  # of the edge: the published map begins here
CURVE_EVERY = 10  # cells of a column between two whose energy curve is kept
SOURCES = (
    "geometry",
    "mesh",
    "elements",
    "kernels",
    "sector",
    "tiling",
    "tangent",
    "homogenise",
    "open_cells",
    "sweep",
)


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be swept. Young's modulus and thickness are not in it: they only scale energies."""

    edge_mm: float
    slit_mm: float
    hinge_mm: float
    nu_ratio: float
    theta_count: int = 43
    t_step_mm: float = 0.01
    density: Density = REFERENCE
    kind: Kind = "slit"

    @property
    def sheet(self) -> Sheet:
        """Return the sheet with this geometry."""
        return Sheet(edge_mm=self.edge_mm, slit_mm=self.slit_mm, hinge_mm=self.hinge_mm, nu_ratio=self.nu_ratio)

    def key(self) -> str:
        """Return the hash of all inputs and of the solver's own text: equal keys, equal results."""
        text = json.dumps(asdict(self), sort_keys=True) + solver_hash()
        return hashlib.sha256(text.encode()).hexdigest()


def plan_of(
    sheet: Sheet,
    theta_count: int = 43,
    t_step_mm: float = 0.01,
    density: Density = REFERENCE,
    kind: Kind = "slit",
) -> Plan:
    """Return the plan for a sheet; the default is the paper's resolution, 7,552 candidates on its sheet."""
    return Plan(sheet.edge_mm, sheet.slit_mm, sheet.hinge_mm, sheet.nu_ratio, theta_count, t_step_mm, density, kind)


def solver_hash() -> str:
    """Return the hash of the files that compute a cell."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for name in SOURCES:
        digest.update((here / f"{name}.py").read_bytes())
    return digest.hexdigest()


def thetas_rad(plan: Plan) -> Array:
    """Return the columns' angles."""
    return np.linspace(-THETA_LIMIT_RAD, THETA_LIMIT_RAD, plan.theta_count)


def column_t_mm(plan: Plan, theta_rad: float) -> Array:
    """Return the candidates of one column: steps from the lower bound (at least 0.05 of the edge) to the upper."""
    low, high = t_bounds_mm(theta_rad, plan.sheet)
    low = max(low, LEAST_T_RATIO * plan.edge_mm)
    count = math.floor((high - low) / plan.t_step_mm + 1e-9) + 1
    return np.asarray(low + plan.t_step_mm * np.arange(max(count, 0)), dtype=np.float64)


def solve_column(plan: Plan, theta_rad: float) -> list[Cell]:
    """Return the cells of one column; each starts from the secant through the two before it where that holds."""
    from design.cells import homogenise

    solve = _solve_open if plan.kind == "open" else _solve_slit
    cells, trail = [], homogenise.Trail()
    for k, t_mm in enumerate(column_t_mm(plan, theta_rad)):
        cell, trail = solve(plan, float(t_mm), theta_rad, trail, k % CURVE_EVERY == 0)
        cells.append(cell)
    return cells


def _solve_slit(plan: Plan, t_mm: float, theta_rad: float, trail: Trail, with_curve: bool) -> tuple[Cell, Trail]:
    from design.cells import homogenise

    found, mesh_ratio, trail = homogenise.walked(t_mm, theta_rad, plan.sheet, plan.density, trail)
    cell = homogenise.cell_of(t_mm, theta_rad, found, mesh_ratio)
    if with_curve and not isinstance(found, homogenise.Failure):
        cell = replace(cell, curve_mm2=homogenise.even_curve_mm2(*found))
    return cell, trail


def _solve_open(plan: Plan, t_mm: float, theta_rad: float, trail: Trail, _: bool) -> tuple[Cell, Trail]:
    from design.cells import open_cells

    return open_cells.solve_open_cell(t_mm, theta_rad, plan.sheet, plan.density, trail)


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a sweep is."""

    done_count: int  # cells
    total_count: int
    elapsed_s: float
    left_s: float | None  # None before anything is known


Report = Callable[[Progress], None]
Work = tuple[Plan, int, float]


def _solve_work(work: Work) -> tuple[int, list[dict[str, Any]], float]:
    plan, index, theta = work
    begin = time.perf_counter()
    return index, [asdict(cell) for cell in solve_column(plan, theta)], time.perf_counter() - begin


def sweep(
    plan: Plan,
    parts: Path,
    jobs: int = 1,
    cluster: str | None = None,
    report: Report | None = None,
    columns: Iterable[int] | None = None,
) -> list[Cell]:
    """Return every cell of the plan (or of some `columns`), in order of θ and t.

    Finished columns are kept under `parts/<key>/`; what is there is read, not solved again. `cluster` is the address of
    a dask scheduler whose workers can import this package.
    """
    thetas = thetas_rad(plan)
    wanted = list(range(len(thetas)) if columns is None else columns)
    counts = {k: len(column_t_mm(plan, thetas[k])) for k in wanted}
    folder = parts / plan.key()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    solved = {k: rows for k in wanted if (rows := _read_part(folder / f"column-{k:03d}.json", counts[k])) is not None}
    # Longest first, so that no worker is left alone with a long column at the end.
    todo = sorted((k for k in wanted if k not in solved), key=lambda k: -counts[k])
    total, kept = sum(counts.values()), sum(counts[k] for k in solved)
    begin = time.monotonic()
    done = kept
    works = [(plan, k, float(thetas[k])) for k in todo]
    for index, rows, _ in _results(works, jobs, cluster):
        _write_part(folder / f"column-{index:03d}.json", rows)
        solved[index] = rows
        done += counts[index]
        if report is not None:
            elapsed = time.monotonic() - begin
            left = elapsed * (total - done) / (done - kept) if done > kept else None
            report(Progress(done, total, elapsed, left))
    from design.cells.homogenise import Cell

    return [Cell(**row) for k in wanted for row in solved[k]]


def _results(works: list[Work], jobs: int, cluster: str | None) -> Iterator[tuple[int, list[dict[str, Any]], float]]:
    if cluster is not None:
        yield from _on_cluster(works, cluster)
    elif jobs == 1 or len(works) < 2:
        yield from map(_solve_work, works)
    else:
        from joblib import Parallel, delayed

        at_work = Parallel(n_jobs=jobs, return_as="generator_unordered")(delayed(_solve_work)(w) for w in works)
        import design.cells.library  # noqa: F401 - needed in the end; loaded while the workers are at it

        yield from at_work


def _on_cluster(works: list[Work], address: str) -> Iterator[tuple[int, list[dict[str, Any]], float]]:
    from distributed import Client, as_completed

    with Client(address) as client:
        futures = client.map(_solve_work, works, pure=False)
        for _, result in as_completed(futures, with_results=True):
            yield result


def _read_part(path: Path, count: int) -> list[dict[str, Any]] | None:
    """Return a finished column, or None where it is missing or torn."""
    try:
        rows = json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return None
    return rows if isinstance(rows, list) and len(rows) == count else None


def _write_part(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a column so that it is there in whole or not at all; Python's JSON keeps floats bit for bit."""
    draft = path.with_suffix(f".{os.getpid()}.tmp")
    with draft.open("w") as file:
        json.dump(rows, file)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
