"""Equilibria of one sector, a third of a unit: all a uniformly expanding cell does, at an eighteenth of its cost.

While the tiling expands by s in every direction its mirror edges stay straight (nodes slide along them) and each unit
keeps its three-fold turn about the *deformed* centroid. Both are linear in the unknowns y and in s:
node n stands at maps[n] @ y[masters[n]] + s·pull[n]. Energies are per sector and per E·thickness, in mm².
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from design.cells import kernels
from design.cells.elements import THREE_POINTS, gradients
from design.cells.geometry import EDGE_DIRECTION, THIRD_TURN, centroid_mm, sector
from design.cells.mesh import REFERENCE, Density, Topology, fitting, nodes_mm, topology, vertices_mm
from design.cells.sheet import Sheet

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TOLERANCE_RATIO = 1e-9  # of E·thickness·hinge: forces below are rounding
STEPS_COUNT = 40  # Newton steps before giving up; a good start needs three or four


@dataclass(frozen=True, slots=True)
class Ties:
    """How the nodes hang on the unknowns; the same for every cell of a density."""

    masters: Ints  # (n, 2), -1 for none
    maps: Array  # (n, 2, 2)
    pull: Array  # (n, 2), for an edge of one: times the edge it is in mm
    size: int
    width: int


@functools.lru_cache(maxsize=8)
def ties(density: Density) -> Ties:
    """Return the ties of a density, unknowns numbered layer by layer so that the band is narrow."""
    top = topology(density)
    n = top.node_count
    place = _places(top)
    masters, maps, pull = np.full((n, 2), -1), np.zeros((n, 2, 2)), np.zeros((n, 2))
    image = dict(zip(top.cut_turned.tolist(), top.cut.tolist(), strict=True))
    on_bottom, on_left = set(top.bottom.tolist()), set(top.left.tolist())
    centre = centroid_mm(1.0)
    size = 0
    for node in np.lexsort((np.arange(n), place)).tolist():
        if node == top.corner or node in image:
            continue
        if node == top.centre:
            pull[node] = centre
        elif node in on_bottom or node in on_left:
            masters[node, 0] = size
            maps[node, :, 0] = (1.0, 0.0) if node in on_bottom else EDGE_DIRECTION
            size += 1
        else:
            masters[node] = size, size + 1
            maps[node] = np.eye(2)
            size += 2
    for node, original in image.items():
        masters[node] = masters[original]
        maps[node] = THIRD_TURN @ maps[original]
        pull[node] = centre - THIRD_TURN @ centre
    owned = masters[top.elements].reshape(len(top.elements), -1)
    spans = [row[row >= 0].max() - row[row >= 0].min() for row in owned]
    return Ties(masters, maps, pull, size, int(max(spans)))


def _places(top: Topology) -> Array:
    """Return a number per node that rises along the chain of layers."""
    layer = np.empty(top.vertex_count)
    for k, nodes in enumerate(top.layers):
        layer[nodes] = k
    return np.concatenate([layer, 0.5 * (layer[top.edges[:, 0]] + layer[top.edges[:, 1]])])


@dataclass(frozen=True, slots=True)
class Model:
    """One sector ready to be solved."""

    rest_mm: Array  # (n, 2) nodes
    elements: Ints  # (m, 6)
    grads: Array
    weights: Array
    hinge_mm: float
    edge_mm: float
    mu: float  # per Young's modulus
    lam: float
    density: Density
    ties: Ties

    def nodes(self, y: Array, s_ratio: float) -> Array:
        """Return the deformed nodes (n, 2), mm."""
        padded = np.append(y, 0.0)  # master -1 reads the zero
        held = padded[self.ties.masters]
        return np.asarray(np.einsum("nij,nj->ni", self.ties.maps, held) + s_ratio * self.edge_mm * self.ties.pull)

    def unknowns(self, nodes: Array) -> Array:
        """Return y for nodes that obey the ties."""
        y = np.empty(self.ties.size)
        first, second = self.ties.masters.T
        single = (first >= 0) & (second < 0)
        y[first[single]] = np.einsum("ni,ni->n", nodes[single], self.ties.maps[single, :, 0])
        double = second >= 0
        local = np.linalg.solve(self.ties.maps[double], nodes[double][..., None])[..., 0]
        own = np.abs(self.ties.pull[double]).sum(axis=1) == 0  # images follow, they do not set
        y[first[double][own]], y[second[double][own]] = local[own].T
        return y

    @property
    def rest(self) -> Array:
        """Return the unknowns of the stress-free state, at s = 1."""
        return self.unknowns(self.rest_mm)

    def energy_mm2(self, y: Array, s_ratio: float) -> float:
        """Return the energy, infinite where an element is turned over."""
        nodes = self.nodes(y, s_ratio)
        return float(kernels.total_energy(nodes, self.elements, self.grads, self.weights, self.mu, self.lam))


def model(
    t_mm: float,
    theta_rad: float,
    sheet: Sheet,
    density: Density = REFERENCE,
    rule: tuple[Array, Array] = THREE_POINTS,
) -> Model:
    """Return the sector of the cell (t, θ); its polygon must be sound (`geometry.fault`)."""
    part = sector(t_mm, theta_rad, sheet)
    density = fitting(part, density)
    rest = nodes_mm(vertices_mm(part, density), density)
    return model_of(rest, sheet, density, rule)


def model_of(rest_mm: Array, sheet: Sheet, density: Density, rule: tuple[Array, Array] = THREE_POINTS) -> Model:
    """Return the sector whose stress-free nodes are `rest_mm` (n, 2)."""
    elements = topology(density).elements
    grads, weights = gradients(rest_mm, elements, rule)
    mu, lam = kernels.lame_MPa(1.0, sheet.nu_ratio)
    return Model(rest_mm, elements, grads, weights, sheet.hinge_mm, sheet.edge_mm, mu, lam, density, ties(density))


@dataclass(frozen=True, slots=True)
class Tangent:
    """Energy with two derivatives at one (y, s), the band factored."""

    energy_mm2: float
    slope: float  # dE/ds
    grad: Array  # dE/dy
    mixed: Array  # d²E/dyds
    curve: float  # d²E/ds²
    band: Array  # L and D
    negative_count: int  # of d²E/dy²

    def drift(self) -> Array:
        """Return dy/ds along the equilibria."""
        return -self.solve(self.mixed)

    def solve(self, rhs: Array) -> Array:
        """Return (d²E/dy²)⁻¹ rhs for one column."""
        return np.asarray(kernels.solve_band(self.band, rhs[:, None])[:, 0])


def raw_tangent(m: Model, y: Array, s_ratio: float) -> tuple[float, float, Array, Array, float, Array] | None:
    """Return energy, slope, gradient, mixed column, curvature and band, unfactored; None where an element is turned."""
    energy, g, h = kernels.element_derivatives(m.nodes(y, s_ratio), m.elements, m.grads, m.weights, m.mu, m.lam)
    if not np.isfinite(energy):
        return None
    tie = m.ties
    band, mixed, curve, slope, grad = kernels.gather(
        g, h, m.elements, tie.masters, tie.maps, m.edge_mm * tie.pull, tie.size, tie.width
    )
    return energy, slope, grad, mixed, curve, band


def tangent(m: Model, y: Array, s_ratio: float, shift: float = 0.0) -> Tangent | None:
    """Return the tangent with `shift` added to the diagonal in y; None where an element is turned over."""
    raw = raw_tangent(m, y, s_ratio)
    if raw is None:
        return None
    energy, slope, grad, mixed, curve, band = raw
    if shift:
        band[:, 0] += shift
    negative = kernels.factor_band(band)
    return Tangent(energy, slope, grad, mixed, curve, band, negative)


@dataclass(frozen=True, slots=True)
class State:
    """An equilibrium, or the last thing before giving up: then `converged` is False and the residual says how far."""

    y: Array
    s_ratio: float
    energy_mm2: float
    slope: float
    curve_total: float  # d²E/ds² with y relaxed
    drift: Array
    negative_count: int  # negative eigenvalues in y, with s held
    residual_ratio: float
    steps_count: int
    converged: bool


def _state(m: Model, y: Array, s_ratio: float, at: Tangent, residual: float, steps: int, converged: bool) -> State:
    drift = at.drift()
    curve = at.curve + float(at.mixed @ drift)
    return State(y, s_ratio, at.energy_mm2, at.slope, curve, drift, at.negative_count, residual, steps, converged)


def relax(m: Model, y: Array, s_ratio: float, steps_count: int = STEPS_COUNT) -> State:
    """Return the minimum over y with s held: Newton, a line search, a shift where the Hessian is indefinite."""
    force = m.hinge_mm
    at = tangent(m, y, s_ratio)
    if at is None:
        return State(y, s_ratio, np.inf, np.nan, np.nan, np.zeros_like(y), -1, np.inf, 0, False)
    residual = np.inf
    for step in range(steps_count):
        residual = float(np.abs(at.grad).max()) / force
        if residual < TOLERANCE_RATIO and at.negative_count == 0:
            return _state(m, y, s_ratio, at, residual, step, True)
        convex = _convex(m, y, s_ratio, at)
        move = -convex.solve(at.grad)
        if residual < TOLERANCE_RATIO:  # a saddle: leave it along the softest direction found
            move = convex.solve(move + 1e-3 * np.cos(np.arange(len(y))))
            move *= 0.05 * m.hinge_mm / np.abs(move).max()
        y, found = _search(m, y, s_ratio, at, move)
        if not found:
            break
        nxt = tangent(m, y, s_ratio)
        assert nxt is not None  # the line search has seen a finite energy here
        at = nxt
    return _state(m, y, s_ratio, at, residual, steps_count, residual < TOLERANCE_RATIO and at.negative_count == 0)


def _convex(m: Model, y: Array, s_ratio: float, at: Tangent) -> Tangent:
    """Return a tangent whose Hessian in y is positive, shifted as far as needed."""
    shift = 1e-4
    while at.negative_count:
        shifted = tangent(m, y, s_ratio, shift)
        assert shifted is not None
        at, shift = shifted, 4 * shift
    return at


def _search(m: Model, y: Array, s_ratio: float, at: Tangent, move: Array) -> tuple[Array, bool]:
    """Return the first of halved steps that lowers the energy enough (Armijo), and whether there was one."""
    slope = min(float(at.grad @ move), 0.0)
    length = 1.0
    for _ in range(40):
        candidate = y + length * move
        if m.energy_mm2(candidate, s_ratio) <= at.energy_mm2 + 1e-4 * length * slope + 1e-15:
            return candidate, True
        length *= 0.5
    return y, False


def root(m: Model, y: Array, s_ratio: float, steps_count: int = 25) -> State:
    """Return the point near (y, s) where dE/dy = 0 and dE/ds = 0, minimum or saddle, by Newton with damping.

    For the second stable state P5 and the saddle P3: solved as roots, so a snap in between cannot spoil the barrier.
    """
    at = tangent(m, y, s_ratio)
    if at is None:
        return State(y, s_ratio, np.inf, np.nan, np.nan, np.zeros_like(y), -1, np.inf, 0, False)
    residual = np.inf
    for step in range(steps_count):
        residual = max(float(np.abs(at.grad).max()), abs(at.slope) / m.edge_mm) / m.hinge_mm
        if residual < TOLERANCE_RATIO:
            return _state(m, y, s_ratio, at, residual, step, True)
        back, drift = at.solve(at.grad), at.drift()
        ds = -(at.slope - float(at.mixed @ back)) / (at.curve + float(at.mixed @ drift))
        ds = float(np.clip(ds, -0.05, 0.05))
        move = -back + ds * drift
        length = min(1.0, 4 * m.hinge_mm / max(float(np.abs(move).max()), 1e-300))
        nxt = None
        while nxt is None and length > 1e-6:
            nxt = tangent(m, y + length * move, s_ratio + length * ds)
            length *= 0.5
        if nxt is None:
            break
        y, s_ratio, at = y + 2 * length * move, s_ratio + 2 * length * ds, nxt
    return _state(m, y, s_ratio, at, residual, steps_count, False)
