"""Figures of the deployed shape: `python -m benchmarks deploy [PART …]`.

Parts: derivatives, forms, targets, turned, vase, caps, gravity, compensation, time.

The published targets are read from `$FABCTL_SHARED` or `shared` beside the project; without them those figures are left
out and said to be.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks import Figure
from benchmarks._axisymmetric import pressed_N, spherical
from benchmarks._deploy_cases import (
    APEX,
    CAP_MM,
    PRESCRIBED_MJ,
    SHEET,
    cap,
    properties,
    published,
    sphere_deviation_mm,
    sphere_rms_mm,
    tiled,
    tiled_vase,
    whole_vase,
)  # fmt: skip
from design.cells.library import load_library
from design.deploy.compensate import Compensation, compensate
from design.deploy.equilibrium import from_flat, rolled, solve_level
from design.deploy.factor import factorise
from design.deploy.indentation import Response, indentation_response
from design.deploy.levels import Layout
from design.deploy.newton import Equilibrium, System, fold_angles, pins
from design.deploy.predict import compared
from design.deploy.search import equilibria
from design.deploy.shell import Shell, build_shell
from design.deploy.standing import standing
from design.deploy.supports import Support, settle
from design.pattern.tiling import tile
from design.surface import TriMesh

Reals = NDArray[np.float64]


def measure(words: list[str]) -> list[Figure]:
    """Return the figures of the parts named, of all where none is."""
    parts: dict[str, Callable[[], list[Figure]]] = {
        "derivatives": derivatives, "forms": closed_forms, "targets": solver_check,
        "turned": turned_lattices, "vase": welded_vase, "caps": two_caps, "gravity": gravity,
        "compensation": compensation, "time": times,
    }  # fmt: skip
    wanted = [word for word in words if not word.startswith("-")] or [
        part for part in parts if part not in ("turned", "vase")
    ]  # targets has them too
    return [figure for word in wanted for figure in parts[word]()]


def most(name: str, value: float, limit: float, unit: str, target: str, n: int) -> Figure:
    """Return a figure that must not exceed its limit."""
    return Figure(name, round(float(value), 12), unit, target, bool(value <= limit), n)


def derivatives() -> list[Figure]:
    """Return the error of gradient and Hessian against differences, and of the equilibrium."""
    layout, goal = cap(1.505, 10.0)
    system = System(layout.shell())
    rng = np.random.default_rng(1)
    x, way, h = goal + rng.normal(size=goal.shape), rng.normal(size=goal.shape), 1e-5
    slope = (system.energy(x + h * way) - system.energy(x - h * way)) / (2 * h)
    force = (system.gradient(x + h * way)[1] - system.gradient(x - h * way)[1]) / (2 * h)
    found = (system.linearise(x)[2] @ way.ravel()).reshape(way.shape)
    rest = from_flat(layout)
    asked = "gradient and Hessian against differences: 1e-6 relative"
    return [
        most("gradient", abs(np.sum(system.gradient(x)[1] * way) / slope - 1), 1e-6, "", asked, x.size),
        most("Hessian", np.abs(found - force).max() / np.abs(force).max(), 1e-6, "", asked, x.size),
        most("residual at rest", rest.residual_ratio, 1e-8, "", "max|g|/(median k_d·l0) ≤ 1e-8", x.size),
    ]


def closed_forms() -> list[Figure]:
    """Return the errors against a sphere, a clamped plate, a point-loaded shell and a cylinder."""
    sphere = [_sphere_radius_error(edge) for edge in (4.0, 2.0)]
    plates = np.array([_clamped_plate_error(edge) for edge in (5.0, 2.5, 1.25)])
    shell = _point_load_error()
    return [
        most("sphere radius", abs(sphere[1]), 1e-3, "", "sphere radius 0.1 % (bending → 0)", 2),
        most("clamped plate", abs(2 * plates[2] - plates[1]), 0.02, "", "clamped plate 2 % (extrapolated)", 3),
        Figure("clamped plate, finest mesh", float(plates[2]), "", "", None, 1),
        most("point-loaded shell", abs(shell), 0.05, "", "Reissner point load 5 %", 1),
        most("cylinder", abs(_cylinder_error()), 0.01, "", "cylinder bending 1 %", 1),
    ]


def _sphere_radius_error(edge_mm: float) -> float:
    layout, goal = cap(1.505, edge_mm, 1e-4 * edge_mm**2)
    x = solve_level(layout, goal).x_mm
    fit = np.linalg.lstsq(np.column_stack([2 * x, np.ones(len(x))]), np.sum(x**2, axis=1), rcond=None)[0]
    return float(np.sqrt(fit[3] + fit[:3] @ fit[:3])) / CAP_MM - 1


def _disk(radius_mm: float, edge_mm: float, beyond_mm: float) -> tuple[Reals, NDArray[np.int64]]:
    ring = np.linspace(0, 2 * np.pi, 361)[:-1]
    rim = (radius_mm + beyond_mm) * np.column_stack([np.cos(ring), np.sin(ring)])
    fan = np.array([[0, k + 1, (k + 1) % 360 + 1] for k in range(360)])
    tiling = tile(np.vstack([[0.0, 0.0], rim]), fan, edge_mm)
    used, cells = np.unique(tiling.cells, return_inverse=True)
    cells = cells.reshape(-1, 3)
    cells[tiling.inverted] = cells[tiling.inverted][:, ::-1]
    return tiling.vertices_mm[used], cells


def _clamped_plate_error(edge_mm: float) -> float:
    """Return the error of q·a⁴/(64·D) at the middle of a clamped round plate; linear, about the flat state."""
    radius, D, q = 40.0, 0.7, 1e-6
    flat, cells = _disk(radius, edge_mm, 3 * edge_mm)
    shell = build_shell(cells, 1.0, 0.2, 0.3, D, edge_mm, len(flat))
    system = System(shell)
    x = np.column_stack([flat, np.zeros(len(flat))])
    fixed = np.repeat((np.hypot(*flat.T) >= radius)[:, None], 3, axis=1)
    load = np.zeros_like(x)
    load[:, 2] = q * np.bincount(cells.ravel(), np.repeat(shell.area_mm2, 3) / 3, len(flat))
    load[fixed] = 0
    matrix = system.held(system.linearise(x)[2], fixed)
    w = factorise(matrix)[0].solve(load.ravel()).reshape(x.shape)[:, 2]
    return float(w[int(np.argmin(np.hypot(*flat.T)))] / (q * radius**4 / (64 * D)) - 1)


def _point_load_error() -> float:
    """Return the error of Reissner's stiffness 8√(D·Y)/R under a point load at the apex; linear."""
    layout, goal = cap(1.505, 1.6, 0.15)
    even = replace(layout, Y_N_mm=np.full(len(layout.cells), 0.2), nu_ratio=np.full(len(layout.cells), 0.3))
    x = solve_level(even, goal).x_mm
    system = System(even.shell())
    top = int(np.argmin(np.hypot(*even.flat_mm().T)))
    normal = _normal(x, even, top)
    fixed = pins(x)
    fixed[top] = False
    rim = np.linalg.norm(x - x[top], axis=1) > 60
    load = np.zeros_like(x)
    load[top] = normal
    u = factorise(system.held(system.linearise(x)[2], np.repeat(rim[:, None], 3, axis=1)))[0].solve(load.ravel())
    return float(1 / (u.reshape(x.shape)[top] @ normal) / (8 * np.sqrt(0.15 * 0.2) / CAP_MM) - 1)


def _normal(x: Reals, layout: Layout, vertex: int) -> Reals:
    a, b, c = (x[layout.cells[np.any(layout.cells == vertex, axis=1), k]] for k in range(3))
    normal = np.cross(b - a, c - a).sum(axis=0)
    return np.asarray(normal / np.linalg.norm(normal))


def _cylinder_error() -> float:
    """Return the error of ½Dκ² per area for a sheet bent to a cylinder askew to its edges."""
    flat, cells = _disk(60.0, 2.0, 0.0)
    D, kappa = 0.7, 1 / 100
    shell: Shell = build_shell(cells, 1.0, 0.2, 0.3, D, 2.0, len(flat))
    turned = flat @ np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    bent = np.column_stack([np.sin(kappa * turned[:, 0]) / kappa, turned[:, 1], np.cos(kappa * turned[:, 0]) / kappa])
    energy = 0.5 * shell.fold_mJ * fold_angles(bent, shell.hinges) ** 2
    side = flat[shell.hinges[:, 1]] - flat[shell.hinges[:, 0]]
    turn = np.rint(np.arctan2(side[:, 1], side[:, 0]) / (np.pi / 3)).astype(int) % 3
    per_pair = sum(float(energy[turn == k].mean()) for k in range(3))
    return per_pair / (0.5 * D * kappa**2 * 2 * float(shell.area_mm2[0])) - 1


def solver_check() -> list[Figure]:
    """Return the deviations with prescribed and computed bending stiffness."""
    figures = []
    edge = float(np.sqrt(np.pi * (2 * CAP_MM / 1.75 * np.tan(np.pi / 6)) ** 2 / 920 / np.sqrt(0.1875)))
    diagonal = float(np.linalg.norm([2 * CAP_MM * np.sin(np.pi / 3)] * 2 + [CAP_MM / 2]))
    for name, D, asked in (("prescribed D", PRESCRIBED_MJ, 0.12), ("computed D, 10 mm cells", None, None)):
        layout, _ = cap(1.75, edge if D else 10.0, D)
        found = from_flat(layout)
        percent = 100 * sphere_deviation_mm(found.x_mm, layout)[0] / diagonal
        figures.append(_deviation(f"cap, {name}", percent, asked, len(layout.cells)))
        figures.append(_bending_cost(f"cap, {name}", layout, found))
    for target, limit in (("double_dome", 0.30), ("lilium_tower", 1.5)):
        mesh = published(target)
        if mesh is None:
            figures.append(Figure(target, "published target not here", "", f"≤ {limit} %", None, 0))
            continue
        for name, D, asked in (("prescribed D", PRESCRIBED_MJ, limit), ("computed D, 10 mm cells", None, None)):
            layout, goal = tiled(mesh, 920 if D else None, D, target)
            figures += _every_shape(f"{target}, {name}", layout, goal, mesh, asked)
    return [*figures, *turned_lattices(), *welded_vase()]


def turned_lattices() -> list[Figure]:
    """Return how much the lilium's closest shape hangs on the way its units lie: the flat turned under the lattice."""
    mesh = published("lilium_tower")
    if mesh is None:
        return []
    percents = []
    for turn_deg in range(0, 60, 10):
        layout, goal = tiled(mesh, 920, PRESCRIBED_MJ, "lilium_tower", np.deg2rad(turn_deg))
        shapes, _ = equilibria(layout, goal, 0)
        percents.append(min(100 * compared(layout, s.equilibrium, mesh, goal).deviation.mean_frac for s in shapes))
    told = ", ".join(f"{p:.2f}" for p in percents)
    return [Figure("lilium_tower, its flat turned by 0, 10, … 50°: the closest", told, "%", "reported", None, 6)]


def welded_vase(count: int = 3400) -> list[Figure]:
    """Return the deviation of the whole vase, one sheet with a joined seam, from a rolled cylinder."""
    half = published("vase")
    if half is None:
        return [Figure("welded vase", "published target not here", "", "≤ 1.1 %", None, 0)]
    mesh = whole_vase(half)
    layout, goal = tiled_vase(mesh, count)
    found = from_flat(layout, rolled)
    sides = [found, from_flat(layout, lambda level: rolled(level, outward=-1.0))]
    percents = [100 * compared(layout, one, mesh, goal).deviation.mean_frac for one in sides]
    told = ", ".join(f"{one.energy_mJ:.3f} mJ: {p:.2f} %" for one, p in zip(sides, percents, strict=True))
    return [
        _deviation("welded vase, prescribed D, from a rolled cylinder", min(percents), 1.1, len(layout.cells)),
        Figure("welded vase: rolled to either side", told, "", "reported", None, 2),
        most("welded vase: residual", found.residual_ratio, 1e-8, "", "≤ 1e-8", len(layout.cells)),
    ]


def _every_shape(name: str, layout: Layout, goal: Reals, mesh: TriMesh, asked: float | None) -> list[Figure]:
    shapes, lost = equilibria(layout, goal, 4, seed=1)
    rows = [compared(layout, shape.equilibrium, mesh, goal).deviation.mean_frac * 100 for shape in shapes]
    energies = ", ".join(f"{s.equilibrium.energy_mJ:.3f} mJ: {r:.2f} %" for s, r in zip(shapes, rows, strict=True))
    return [
        _deviation(name, min(rows), asked, len(layout.cells)),
        _bending_cost(f"{name}, closest", layout, shapes[int(np.argmin(rows))].equilibrium),
        Figure(f"{name}: every equilibrium", energies, "", "reported", None, len(shapes)),
        Figure(f"{name}: starts without an answer", len(lost), "", "", None, len(lost) + len(shapes)),
    ]


def _bending_cost(name: str, layout: Layout, found: Equilibrium) -> Figure:
    """Return the energy that bending costs, of the whole."""
    shell = layout.shell()
    bent_mJ = 0.5 * float(shell.fold_mJ @ fold_angles(found.x_mm, shell.hinges) ** 2)
    told = f"{bent_mJ:.3f} of {found.energy_mJ:.3f}"
    return Figure(f"{name}: what bending costs", told, "mJ", "reported", None, len(layout.cells))


def _deviation(name: str, percent: float, asked: float | None, n: int) -> Figure:
    target = "reported" if asked is None else f"mean deviation ≤ {asked} % of the diagonal"
    return Figure(name, round(percent, 4), "%", target, None if asked is None else bool(percent <= asked), n)


def press(apex: float, D_of: Callable[[Layout], Reals] | None = None, parts: int = 4) -> tuple[Response, Layout]:
    """Return the response at the apex of a 10 mm cap: sphere of R/10, rim held."""
    layout, goal = cap(apex, 10.0)
    if D_of is not None:
        layout = replace(layout, D_mJ=D_of(layout))
    found = solve_level(layout, goal)
    _, x = sphere_deviation_mm(found.x_mm, layout)
    return indentation_response(layout, x, CAP_MM / 10, 4.0, 16, parts=parts), layout


def two_caps() -> list[Figure]:
    """Return the ratio of the paper's two caps, with the computed D and with other assumptions about it."""
    figures: list[Figure] = []
    low, high = (press(APEX[name]) for name in ("low", "high"))
    depths = (0.5, 1.0, 2.0, 3.0, 4.0)
    ratios = [low[0].stiffness_N_mm(d) / high[0].stiffness_N_mm(d) for d in depths]
    figures.append(
        Figure("low cap over high cap, secant to 2 mm, computed D", round(ratios[2], 3), "", "between 1.6 and 2.5",
               bool(1.6 <= ratios[2] <= 2.5), len(low[1].cells) + len(high[1].cells))
    )  # fmt: skip
    fall = ", ".join(f"{d:g} mm: {r:.2f}" for d, r in zip(depths, ratios, strict=True))
    figures.append(Figure("its fall with depth", fall, "", "reported", None, len(depths)))
    for name, (response, layout) in (("low", low), ("high", high)):
        rising = bool(np.all(np.diff(response.load_N) > 0))
        figures += [
            Figure(f"{name} cap, secant to 2 mm", round(response.stiffness_N_mm(2.0), 5), "N/mm", "", None,
                   len(layout.cells)),
            Figure(f"{name} cap: load never falls", rising, "", "no collapse", rising, len(response.depth_mm)),
            most(f"{name} cap: left after release", response.recovered_mm, 1e-3, "mm", "recovery on release", 1),
            most(f"{name} cap: worst residual", response.residual_ratio, 1e-8, "", "≤ 1e-8", len(response.depth_mm)),
        ]  # fmt: skip
    constant = [press(APEX[n], lambda layout: np.full(len(layout.cells), PRESCRIBED_MJ))[0] for n in ("low", "high")]
    shift = constant[0].stiffness_N_mm(2.0) / constant[1].stiffness_N_mm(2.0)
    figures.append(Figure("the ratio with D constant", round(shift, 3), "", "reported", None, 2))
    share = float(np.mean(low[1].D_mJ / low[1].Y_N_mm))
    linear = [press(APEX[n], lambda layout: share * layout.Y_N_mm)[0] for n in ("low", "high")]
    ratio = linear[0].stiffness_N_mm(2.0) / linear[1].stiffness_N_mm(2.0)
    figures.append(Figure("the ratio with D ∝ Y", round(ratio, 3), "", "cross-check", None, 2))
    return [*figures, *second_opinion(low[0], high[0])]


def second_opinion(low: Response, high: Response) -> list[Figure]:
    """Return the same ratio from the meridian alone, which has no units, no hinges and no contact vertices."""
    depths = np.arange(0.25, 2.01, 0.25)
    laws: dict[str, Callable[[Reals, Reals], Reals]] = {
        "computed D": lambda Y, D: D,
        "D constant": lambda Y, D: np.full(len(Y), PRESCRIBED_MJ),
        "D ∝ Y": lambda Y, D: 0.6 * Y,
    }
    figures = []
    for name, law in laws.items():
        loads = {which: _meridian_N(apex, law, depths) for which, apex in APEX.items()}
        ratio = float(loads["low"][-1] / loads["high"][-1])
        figures.append(Figure(f"meridian alone, {name}: ratio to 2 mm", round(ratio, 3), "", "second opinion", None, 2))
        if name == "computed D":
            mine = low.stiffness_N_mm(2.0) / high.stiffness_N_mm(2.0)
            figures.append(most("triangles against the meridian: ratio", abs(mine / ratio - 1), 0.05, "", "agree", 2))
    return figures


def _meridian_N(apex: float, law: Callable[[Reals, Reals], Reals], depths_mm: Reals) -> Reals:
    """Return the load on a cap whose stiffness changes as its expansion does, unit by unit no longer."""

    def at(polar: Reals) -> tuple[Reals, Reals, Reals]:
        Y, nu, D = properties(apex / (1 + np.tan(polar / 2) ** 2))
        return Y, nu, law(Y, D)

    meridian, nodes = spherical(CAP_MM, np.pi / 3, 241, at)
    return pressed_N(meridian, nodes, CAP_MM / 10, depths_mm)


def gravity() -> list[Figure]:
    """Return how far both caps sag on each support."""
    figures, sags = [], {}
    for name, apex in APEX.items():
        layout, goal = cap(apex, 10.0)
        _, x = sphere_deviation_mm(solve_level(layout, goal).x_mm, layout)
        for support in ("held", "no-slip", "coulomb", "slip"):
            found = settle(layout, x, SHEET, support)
            sags[name, support] = found.sag_mm
            figures.append(Figure(f"{name} cap sags, {support}", round(found.sag_mm, 4), "mm", "", None, 1))
    more = sags["high", "no-slip"] / sags["low", "no-slip"]
    asked = "the high cap sags more with a rim that does not slip"
    return [*figures, Figure("sag, high over low, no slip", round(more, 3), "", asked, bool(more > 1), 2)]


def compensation() -> list[Figure]:
    """Return how much nearer changed expansions bring a free dome and a cap that is held and heavy."""
    figures: list[Figure] = []
    bounds = load_library().range_ratio()
    mesh = published("double_dome")
    if mesh is None:
        figures.append(Figure("double_dome compensated", "published target not here", "", "≥ 3 times", None, 0))
    else:
        layout, goal = tiled(mesh, None, None)
        before = compared(layout, solve_level(layout, goal), mesh, goal).deviation
        found = compensate(layout, goal, bounds)
        after = compared(found.layout, found.equilibrium, mesh, goal).deviation
        figures += _gains("double_dome", found, before.rms_mm, after.rms_mm)
    supports: tuple[Support, ...] = ("held", "no-slip")
    for support in supports:
        layout, goal = cap(1.6, 10.0)
        held = standing(layout, goal, SHEET, support)
        heavy = solve_level(layout, goal, held.loads, held.fixed)
        found = compensate(layout, goal, bounds, standing=held)
        rms = [sphere_rms_mm(e.x_mm, held.aligned) for e in (heavy, found.equilibrium)]
        figures += _gains(f"heavy cap, rim {support}", found, *rms)
    return figures


def _gains(name: str, found: Compensation, before_mm: float, after_mm: float) -> list[Figure]:
    points, surface = found.before_mm / found.after_mm, before_mm / after_mm
    n = len(found.layout.cells)
    return [
        Figure(f"{name}: points' RMS before over after", round(points, 2), "", "points: ≥ 3 times less RMS",
               bool(points >= 3), n),
        Figure(f"{name}: surface RMS before over after", round(surface, 2), "", "≥ 2 times less to the surface",
               bool(surface >= 2), n),
        most(f"{name}: residual", found.equilibrium.residual_ratio, 1e-8, "", "≤ 1e-8", n),
    ]  # fmt: skip


def times() -> list[Figure]:
    """Return seconds from flat with SciPy alone, compiled code warm: by the clock, and processor time."""
    figures = []
    from_flat(cap(1.505, 10.0, PRESCRIBED_MJ)[0])
    seconds, counts = [], []
    for edge, limit in ((5.2, 2.0), (1.645, 10.0), (1.163, 25.0)):
        layout, _ = cap(1.505, edge, PRESCRIBED_MJ)
        begin, worked = time.perf_counter(), time.process_time()
        found = from_flat(layout)
        seconds.append(time.perf_counter() - begin)
        counts.append(len(layout.cells))
        name = f"from flat, {counts[-1]} units ({found.iterations_count} iterations)"
        figures += [
            most(name, seconds[-1], limit / 2, "s", f"≤ {limit:g} s, half of it with the optional solver", counts[-1]),
            Figure(f"{name}: processor time", round(time.process_time() - worked, 3), "s", "", None, counts[-1]),
        ]
    rate = float(np.polyfit(np.log(counts), np.log(seconds), 1)[0])
    return [
        *figures,
        Figure("growth exponent", round(rate, 2), "", "growth near linear", bool(rate < 1.2), len(counts)),
    ]
