"""A surface with two ends laid flat as a strip that repeats: one seam, re-joined by a pure translation.

The scale factors are such that neither end turns in total (Σ k̃ = 0 on each), so walking around the tube in the flat
leads to the same place, moved by the period. The flat is computed on the uncut surface, as a harmonic map that grows by
the period each time around; the seam is only where it is cut, and both its sides are the same curve exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from design.flatten.curve import close, edge_lengths_mm, tangents, trace
from design.flatten.cut import Cut, cut_along, shortest_chain
from design.flatten.disk import fill_holes, given_u, hole_vertices
from design.flatten.laplace import Laplace, angle_defects, assemble, factored
from design.flatten.programme import least_spread, rim_modes, wave_numbers
from design.flatten.result import FlattenOptions, Laplacian
from design.surface import Indices, Points, TriMesh

Values = NDArray[np.float64]
Complex = NDArray[np.complex128]
STRAIGHTER_ratio = 30.0  # how much dearer a step across is than a step along when the seam looks for its way


@dataclass(frozen=True, slots=True)
class Tube:
    """A surface with two ends, other holes closed; the border is the first end, then the second."""

    mesh: TriMesh
    count: int
    ends: tuple[Indices, Indices]
    operator: Laplace
    curvature: Values
    kind: Laplacian

    def turning(self, u: Values) -> tuple[Values, Values]:
        """Return how much the flat's rim turns at each vertex of either end, in rad."""
        border = self.operator.border
        total = self.curvature[border] + self.operator.flux(u)
        return total[: len(self.ends[0])], total[len(self.ends[0]) :]


@dataclass(frozen=True, slots=True)
class Strip:
    """The flat of a tube, cut open: the seam's chain on the left repeats on the right, `period_mm` further along x."""

    cut: Cut
    flat_mm: Points  # (n, 2)
    u: Values  # (n,)
    left: Indices
    right: Indices
    period_mm: float


def tube(mesh: TriMesh, loops: list[Indices], kind: Laplacian) -> Tube:
    """Take the two longest loops as ends, close the others, and factor."""
    filled = fill_holes(mesh, loops[2:])
    border = np.concatenate(loops[:2])
    operator = factored(assemble(filled, kind), border)
    return Tube(filled, len(mesh.vertices_mm), (loops[0], loops[1]), operator, angle_defects(filled, border), kind)


def tube_scale_factors(surface: Tube, options: FlattenOptions) -> Values:
    """Return u over all vertices: constant on either end, or of least spread, such that neither end turns in total.

    A prescribed boundary is taken up to the one constant between the ends that the condition fixes.
    """
    first, second = surface.ends
    border = surface.operator.border
    on_second = np.concatenate([np.zeros(len(first)), np.ones(len(second))])
    given = np.zeros(len(border))
    if options.boundary == "prescribed":
        given = given_u(options)[border]
    base = surface.operator.extend(given, -surface.curvature)
    columns = [on_second]
    if options.boundary == "optimised":
        half = options.modes_count // 2
        for end, start in ((first, 0), (second, len(first))):
            block = np.zeros((len(border), half))
            block[start : start + len(end)] = rim_modes(surface.mesh.vertices_mm, end, half)
            columns += list(block.T)
    reach = surface.operator.extend(np.column_stack(columns))
    # What one end turns too much the other turns too little (Gauss, Bonnet), so one equation holds both.
    turns = np.array([surface.operator.flux(reach)[: len(first)].sum(axis=0)])
    excess = -np.array([surface.turning(base)[0].sum()])
    if len(columns) == 1:
        return base + reach[:, 0] * float(excess[0] / turns[0, 0])
    roughness = np.concatenate([[0.0], np.tile(wave_numbers(half), 2)])
    rows = slice(0, surface.count)
    answer = least_spread(base[rows], reach[rows], equal=(turns, excess), roughness=roughness)
    return base + reach @ answer.choice


def lay_strip(surface: Tube, u: Values, seam: Indices | None = None) -> Strip:
    """Return the flat strip along x, its first end below; the seam runs as straight up as edges allow.

    `seam` is a chain from the first end to the second that is to be the cut.
    """
    if seam is None:
        mesh = surface.mesh
        holes = hole_vertices(mesh, surface.count)
        rough = shortest_chain(mesh, surface.ends[0], surface.ends[1], holes)
        strip = _lay_strip(surface, u, rough)
        seam = shortest_chain(mesh, surface.ends[0], surface.ends[1], holes, _upright_cost(strip))
    return _lay_strip(surface, u, seam)


def _upright_cost(strip: Strip) -> Values:
    """Return a cost per edge `(m, 3)` that makes steps along x dear."""
    corners = strip.flat_mm[strip.cut.mesh.faces]
    step = np.roll(corners, -1, axis=1) - corners
    return np.asarray(np.hypot(step[..., 0] * STRAIGHTER_ratio, step[..., 1]))


def _lay_strip(surface: Tube, u: Values, seam: Indices) -> Strip:
    opened = cut_along(surface.mesh, [seam])
    on_left, on_right = opened.sides[0]  # seen while walking up: its right is where the strip begins
    starts = seam[0], seam[-1]
    rims, period_mm = _rims(surface, u, starts)
    z = _harmonic(surface, opened, on_left, rims, period_mm)
    flat_mm = np.column_stack([z.real, z.imag])
    return Strip(opened, flat_mm, u[opened.target_index], on_right, on_left, period_mm)


def _rims(surface: Tube, u: Values, starts: tuple[int, int]) -> tuple[list[Complex], float]:
    """Return either end's points from its start on along +x, ordered as the loop is, and their common period.

    The second end runs backwards: its boundary direction is −x.
    """
    pieces = []
    for end, turning, start in zip(surface.ends, surface.turning(u), starts, strict=True):
        shift = int(np.flatnonzero(end == start)[0])
        loop, turns = np.roll(end, -shift), np.roll(turning, -shift)
        before = edge_lengths_mm(surface.mesh.vertices_mm, loop)
        asked = before * np.exp(0.5 * (u[loop] + np.roll(u[loop], -1)))
        tangent = tangents(turns)
        pieces.append((shift, before, asked, tangent, np.sum(asked * tangent)))
    period_mm = float(np.mean([abs(piece[4]) for piece in pieces]))
    rims = []
    for sign, (shift, before, asked, tangent, span) in zip((1, -1), pieces, strict=True):
        along = tangent * (sign * abs(span) / span)
        points = trace(close(asked, before, along, sign * period_mm), along)
        if sign < 0:
            # The start lies on the seam's left copy at one period; from there it runs down to just above zero.
            points = np.concatenate([[0.0], points[1:] + period_mm])
        rims.append(np.roll(points, shift))
    return rims, period_mm


def _harmonic(surface: Tube, opened: Cut, moved: Indices, rims: list[Complex], period_mm: float) -> Complex:
    """Return the flat of the cut surface: harmonic, one period greater on `moved`, the second end placed by its flux.

    The second end's place is what makes x and y conjugate: no flux of x, one period of flux of y through it.
    """
    index, n = opened.target_index, len(surface.mesh.vertices_mm)
    lift = np.zeros(len(index))
    lift[moved] = period_mm
    open_laplace = assemble(opened.mesh, surface.kind)
    fold = csc_array((np.ones(len(index)), (index, np.arange(len(index)))), shape=(n, len(index)))
    operator = surface.operator
    if surface.kind == "delaunay":
        # Intrinsic edges of the uncut surface may cross the seam; those of the cut one do not.
        operator = factored(csc_array(fold @ open_laplace @ fold.T), operator.border)
    pull = np.column_stack([-(fold @ (open_laplace @ lift)), np.zeros(n)])
    border = np.concatenate(rims)
    first = len(surface.ends[0])
    second = np.concatenate([np.zeros(first), np.ones(len(border) - first)])
    values = operator.extend(np.column_stack([border.real, border.imag]), pull)
    reach = operator.extend(second)
    flux = (operator.flux(values) - pull[operator.border])[first:].sum(axis=0)
    place = (np.array([0.0, period_mm]) - flux) / operator.flux(reach)[first:].sum()
    values = values + reach[:, None] * place
    return np.asarray((values[index, 0] + lift) + 1j * values[index, 1])
