"""A proof that no rim whatever brings a surface's expansions closer together than a certain spread.

The rim's scale factors are free, the expansions inside follow from them (harmonically). Weights p on cells and rim, of
sum zero and mass one on either sign, for which p·u does not depend on the rim, prove: spread ≥ p·u. A linear programme
over a few rim functions finds good weights; one adjoint solve then says how much p·u still depends on each rim vertex,
and shifting that much weight there makes the independence exact. So the proof does not rest on the programme.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from design.flatten.curve import edge_lengths_mm
from design.flatten.laplace import Laplace, angle_defects, assemble, factored
from design.flatten.programme import least_spread
from design.surface import Indices, TriMesh

Values = NDArray[np.float64]
NODES_count = 80  # rim values the programme may choose, between them it interpolates
CENTRES_count = 3000  # cells looked at; fewer make a weaker, still valid proof
CELL_RADIUS_ratio = 0.52  # of the cell's edge: a disk of a unit's area at an expansion of 1.4


@dataclass(frozen=True, slots=True)
class Bound:
    """What no single sheet without cones can go below, and the weights that show it."""

    spread_ratio: float
    weights: Values  # (n,) over the vertices; positive where u is too high (expansion too low), negative where too low


def proven_bound(mesh: TriMesh, loops: list[Indices], cell_mm: float = 0.0, is_tube: bool = False) -> Bound:
    """Return a lower bound of the spread of expansions over cells of `cell_mm` and along the rims.

    Every loop's scale factors are free but for what topology fixes: a hole's rim turns by −2π in the flat, a tube's end
    by nothing. That a flat must also close is left out, so the bound holds all the more.
    """
    border = np.concatenate(loops)
    operator = factored(assemble(mesh), border)
    curvature = angle_defects(mesh, border)
    base = operator.extend(np.zeros(len(border)), -curvature)
    average = cell_averages(mesh, border, cell_mm)
    E, e = _turning_equations(operator, curvature, base, loops, is_tube)
    hats = _hats(mesh, loops)
    columns = average @ operator.extend(hats[:, 1:])
    equal = (E @ hats[:, 1:], e) if len(e) else None
    answer = least_spread(average @ base, columns, equal=equal)
    proof = answer.proof
    slope = _adjoint(operator, average.T @ proof)
    multipliers = _multipliers(slope, E)
    proof[-len(border) :] -= slope + multipliers @ E  # the last rows are the rim's own
    weights = average.T @ proof
    lower = (weights @ base - multipliers @ e) / (0.5 * np.abs(proof).sum())
    return Bound(float(np.exp(max(0.0, lower))), weights)


def cell_averages(mesh: TriMesh, border: Indices, cell_mm: float) -> csr_array:
    """Return rows that average a vertex field over a cell's worth of surface around many vertices.

    The rim's vertices stand for themselves: what no cell covers as a whole must not hide between the cells.
    """
    count = len(mesh.vertices_mm)
    centres = np.setdiff1d(np.arange(0, count, max(1, count // CENTRES_count)), border)
    share = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas_mm2() / 3, 3), count)
    tree: Any = cKDTree(mesh.vertices_mm)
    near: list[list[int]] = list(tree.query_ball_point(mesh.vertices_mm[centres], CELL_RADIUS_ratio * cell_mm))
    lengths = np.array([len(row) for row in near])
    columns = np.concatenate([np.array(row, dtype=np.int64) for row in near])
    rows = np.repeat(np.arange(len(centres)), lengths)
    totals = np.bincount(rows, share[columns])
    rows = np.concatenate([rows, len(centres) + np.arange(len(border))])
    values = np.concatenate([share[columns] / totals[rows[: len(columns)]], np.ones(len(border))])
    columns = np.concatenate([columns, border])
    return csr_array((values, (rows, columns)), shape=(len(centres) + len(border), count))


def _turning_equations(
    operator: Laplace, curvature: Values, base: Values, loops: list[Indices], is_tube: bool
) -> tuple[Values, Values]:
    """Return E, e: what the rims' values must keep so that each further loop turns as it has to."""
    if len(loops) == 1:
        return np.empty((0, len(loops[0]))), np.empty(0)
    rows, right, start = [], [], len(loops[0])
    for number, loop in enumerate(loops[1:], start=1):
        inside = np.zeros(len(operator.border))
        inside[start : start + len(loop)] = 1.0
        start += len(loop)
        # The Dirichlet-to-Neumann map is symmetric, so one solve gives the whole row.
        rows.append(operator.flux(operator.extend(inside)))
        wanted = 0.0 if is_tube and number == 1 else -2 * np.pi
        have = (curvature[operator.border] + operator.flux(base)) @ inside
        right.append(wanted - have)
    return np.array(rows), np.array(right)


def _hats(mesh: TriMesh, loops: list[Indices]) -> Values:
    """Return piecewise linear rim functions, `(border, nodes)`, spread over the loops by their length."""
    lengths = [edge_lengths_mm(mesh.vertices_mm, loop) for loop in loops]
    whole = sum(length.sum() for length in lengths)
    blocks = []
    for loop, length in zip(loops, lengths, strict=True):
        nodes = min(len(loop), max(8, round(NODES_count * length.sum() / whole)))
        at = np.concatenate([[0.0], np.cumsum(length)[:-1]]) / length.sum() * nodes
        gap = np.abs(at[:, None] - np.arange(nodes))
        blocks.append(np.maximum(0.0, 1 - np.minimum(gap, nodes - gap)))
    out = np.zeros((sum(map(len, loops)), sum(block.shape[1] for block in blocks)))
    row = column = 0
    for block in blocks:
        out[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return out


def _adjoint(operator: Laplace, weights: Values) -> Values:
    """Return d(weights·u)/d(rim values): one solve with the inner block, which is its own transpose."""
    inner = operator.factor.solve(weights[operator.inner])
    return np.asarray(weights[operator.border] - operator.A_inner_border.T @ inner)


def _multipliers(slope: Values, E: Values) -> Values:
    """Return the combination of the equations that takes most of the slope away; any is valid, the best bounds best."""
    if len(E) == 0:
        return np.empty(0)
    return np.asarray(-np.linalg.lstsq(E.T, slope, rcond=None)[0])
