"""A surface with holes laid flat without filling them: every rim has scale factors of its own.

Filling a hole decides how its rim deforms; leaving it free lets the expansions spread less. What stays is that a hole's
rim must turn once and close in the flat. The turning is linear in the rims' scale factors, the closing is not, so the
programme is solved a few times, each time with the closing linearised about the last answer. Where the rims lie and how
they are turned follows from the least conformal energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from design.flatten.curve import close, edge_lengths_mm, tangents, trace
from design.flatten.disk import disk, given_u
from design.flatten.laplace import Laplace, angle_defects, assemble, factored
from design.flatten.programme import least_spread, rim_modes, wave_numbers
from design.flatten.result import FlattenOptions, Laplacian
from design.surface import Indices, Points, TriMesh

Values = NDArray[np.float64]
Complex = NDArray[np.complex128]
ROUNDS_count = 8
CLOSED_ratio = 1e-4  # of a rim's length: what is left open then is closed by changing its lengths


@dataclass(frozen=True, slots=True)
class Rims:
    """A surface with several rims, the outer one first, and the factored operator with all of them as border."""

    mesh: TriMesh
    loops: list[Indices]
    operator: Laplace
    curvature: Values
    start_u: Values  # (n,) scale factors with the holes filled: a start that turns and closes as it must

    def parts(self) -> list[slice]:
        """Return where each loop lies in the border."""
        ends = np.cumsum([0, *map(len, self.loops)])
        return [slice(a, b) for a, b in pairwise(ends.tolist())]


def rims(mesh: TriMesh, loops: list[Indices], kind: Laplacian) -> Rims:
    """Factor with every loop as border; start from the flat with holes filled."""
    filled = disk(mesh, loops, kind)
    rim_u = filled.scale_factors(np.zeros(len(loops[0])))
    border = np.concatenate(loops)
    operator, curvature = factored(assemble(mesh, kind), border), angle_defects(mesh, border)
    return Rims(mesh, loops, operator, curvature, operator.extend(rim_u[border], -curvature))


def rims_u(surface: Rims, options: FlattenOptions) -> Values:
    """Return u over all vertices as the options ask; an isometric boundary lets the holes do as if they were filled."""
    if options.boundary == "optimised":
        return best_rims(surface, options.modes_count)
    if options.boundary == "prescribed":
        return surface.operator.extend(given_u(options)[surface.operator.border], -surface.curvature)
    return surface.start_u


def best_rims(surface: Rims, modes_count: int) -> Values:
    """Return u over all vertices of least spread: waves along every rim, holes that turn once and close."""
    basis = _basis(surface, modes_count)
    reach = surface.operator.extend(basis)
    flux = surface.operator.flux(reach)
    parts = surface.parts()[1:]
    turns = np.array([flux[part].sum(axis=0) for part in parts])
    turning = surface.curvature[surface.operator.border] + surface.operator.flux(surface.start_u)
    excess = np.array([-2 * np.pi - turning[part].sum() for part in parts])
    roughness = np.concatenate(
        [wave_numbers(basis.shape[1] - len(parts)), np.zeros(len(parts))]
    )  # the holes' constants come last
    x = np.zeros(basis.shape[1])
    for _ in range(ROUNDS_count):
        gaps, slopes = _closing(surface, surface.start_u + reach @ x, turning + flux @ x, basis, flux)
        equal = (np.vstack([turns, slopes]), np.concatenate([excess, slopes @ x - gaps]))
        x = least_spread(surface.start_u, reach, equal=equal, roughness=roughness).choice
        left = _closing(surface, surface.start_u + reach @ x, turning + flux @ x, basis, flux)[0]
        if np.abs(left).max() < CLOSED_ratio:
            break
    return np.asarray(surface.start_u + reach @ x)


def _basis(surface: Rims, modes_count: int) -> Values:
    """Return `(border, k)`: waves along the outer rim, half as many along every hole, then each hole's constant."""
    points_mm, total = surface.mesh.vertices_mm, len(surface.operator.border)
    columns, constants = [], []
    for number, (loop, part) in enumerate(zip(surface.loops, surface.parts(), strict=True)):
        count = modes_count if number == 0 else min(modes_count // 2, len(loop) // 2)
        block = np.zeros((total, count))
        block[part] = rim_modes(points_mm, loop, count)
        columns.append(block)
        if number > 0:
            constant = np.zeros((total, 1))
            constant[part] = 1.0
            constants.append(constant)
    return np.hstack([*columns, *constants])


def _closing(surface: Rims, u: Values, turning: Values, basis: Values, flux: Values) -> tuple[Values, Values]:
    """Return how far each hole's rim is from closing, over its length, `(2h,)`, and how the columns change that."""
    gaps, slopes = [], []
    for loop, part in zip(surface.loops[1:], surface.parts()[1:], strict=True):
        lengths_mm, tangent = _rim(surface, loop, part, u, turning)
        stretch = 0.5 * (basis[part] + np.roll(basis[part], -1, axis=0))
        turn = np.cumsum(flux[part], axis=0) - flux[part][0]
        step = lengths_mm * tangent / lengths_mm.sum()
        slope = step @ (stretch + 1j * turn)
        gaps += [step.sum().real, step.sum().imag]
        slopes += [slope.real, slope.imag]
    return np.array(gaps), np.array(slopes)


def _rim(surface: Rims, loop: Indices, part: slice, u: Values, turning: Values) -> tuple[Values, Complex]:
    before_mm = edge_lengths_mm(surface.mesh.vertices_mm, loop)
    return before_mm * np.exp(0.5 * (u[loop] + np.roll(u[loop], -1))), tangents(turning[part])


def lay_rims(surface: Rims, u: Values) -> Points:
    """Return the flat `(n, 2)`: each rim as u asks for, the holes' rims placed by the least conformal energy."""
    operator = surface.operator
    turning = surface.curvature[operator.border] + operator.flux(u)
    total = len(operator.border)
    shapes, places, areas = [], [], []
    for loop, part in zip(surface.loops, surface.parts(), strict=True):
        lengths_mm, tangent = _rim(surface, loop, part, u, turning)
        curve = trace(close(lengths_mm, edge_lengths_mm(surface.mesh.vertices_mm, loop), tangent), tangent)
        shape, place = np.zeros(total, dtype=complex), np.zeros(total)
        shape[part], place[part] = curve - curve.mean(), 1.0
        shapes.append(shape)
        places.append(place)
        areas.append(0.5 * float(np.sum(curve.real * np.roll(curve.imag, -1) - curve.imag * np.roll(curve.real, -1))))
    columns = np.column_stack([*shapes, *places[1:]])
    extended = operator.extend(columns.real) + 1j * operator.extend(columns.imag)
    weights = _placed(np.asarray(columns.conj().T @ operator.flux(extended), dtype=np.complex128), areas)
    z = extended @ weights
    return np.column_stack([z.real, z.imag])


def _placed(energy: Complex, areas_mm2: list[float]) -> Complex:
    """Return the factors of outer shape, hole shapes (pure turns) and hole places that make the energy least.

    `energy` is the Hermitian Dirichlet form of the columns; the area, which conformal energy takes off, depends on a
    hole's own scale only. The best scale is close to one, and set to one.
    """
    holes = len(areas_mm2) - 1
    conformal = energy.copy()
    for k in range(1, holes + 1):
        conformal[k, k] -= 2 * areas_mm2[k]
    turns = np.linalg.solve(conformal[1:, 1:], -conformal[1:, 0])[:holes]
    fixed = np.concatenate([[1.0], turns / np.abs(turns)])
    free = slice(holes + 1, None)
    places = np.linalg.solve(energy[free, free], -energy[free, : holes + 1] @ fixed)
    return np.concatenate([fixed, places])
