"""The nearest surface that a sheet can become: the target, moved as little as the library's range allows.

Alternates three steps: lay the surface flat; replace each face's map from the flat by the nearest one that is a
rotation times an expansion within the window (local); find the surface whose maps fit those best and that stays near
the target (global, one factorisation per flat). How strongly the target holds is lowered until the spread fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from design.errors import NotConverged
from design.flatten.flat import flatten
from design.flatten.quality import signed_areas_mm2
from design.flatten.result import Flattening, FlattenOptions
from design.surface import Faces, Points, TriMesh

Values = NDArray[np.float64]
HOLD_FIRST, HOLD_LAST = 200.0, 0.2  # pull of the target, in units of 1/diagonal²: from stiff to loose
STAGES_count = 20  # over which the hold is loosened
EXTRA_count = 20  # further ones at the loosest
INNER_count = 12  # local/global rounds per flat
INSIDE_ratio, INSIDE_LAST_ratio = 0.995, 0.96  # the window aimed at is a little narrower than the one allowed
WINDOW_STEPS_count = 60


OPTIMISED = FlattenOptions(boundary="optimised")


@dataclass(frozen=True, slots=True)
class Feasible:
    """A surface within the range, its flat, and how far it is from the target it came from."""

    flattening: Flattening
    rms_mm: float  # of the distance to the target, over the area
    max_mm: float
    rms_ratio: float  # of the target's diagonal
    stages_count: int


def closest_feasible(
    mesh: TriMesh,
    limit_ratio: float,
    options: FlattenOptions = OPTIMISED,
    emit: Callable[[float, str], None] = lambda _done, _message: None,
) -> Feasible:
    """Return the surface near `mesh` whose expansions spread by at most `limit_ratio`.

    `emit(done, message)` hears of progress. Raises `NotConverged` with the least spread reached where none is found.
    """
    points_mm, scale_mm = mesh.vertices_mm.copy(), mesh.diagonal_mm()
    least = np.inf
    for stage in range(STAGES_count + EXTRA_count):
        moved = TriMesh(points_mm, mesh.faces)
        flat = flatten(moved, options)
        spread = flat.spread_ratio()
        least = min(least, spread)
        emit(stage / (STAGES_count + EXTRA_count), f"spread {spread:.4f}, allowed {limit_ratio:.4f}")
        if spread <= limit_ratio:
            return _measured(mesh, flat, stage)
        part = min(1.0, stage / (STAGES_count - 1))
        extra = max(0.0, (stage - STAGES_count + 1) / EXTRA_count)
        inside = INSIDE_ratio + (INSIDE_LAST_ratio - INSIDE_ratio) * extra
        hold = HOLD_FIRST * (HOLD_LAST / HOLD_FIRST) ** part / scale_mm**2
        points_mm = _approach(mesh, flat, limit_ratio * inside, hold)
    hint = f"the least spread reached is {least:.3f}; cut a seam, add cones, or choose a flatter target"
    raise NotConverged("the search for a feasible surface", least / limit_ratio - 1, STAGES_count + EXTRA_count, hint)


def _approach(target: TriMesh, flat: Flattening, limit_ratio: float, hold: float) -> Points:
    """Return vertices moved towards maps within the window, held to the target's surface by `hold` (1/mm²)."""
    index, count = flat.target_index, len(target.vertices_mm)
    areas_mm2 = np.abs(signed_areas_mm2(flat.flat_mm, flat.faces))
    low, high = _window(flat.expansion_ratio, areas_mm2, limit_ratio)
    gradient = _gradient(flat.flat_mm, flat.faces)
    corners = index[flat.faces]
    stiffness = _stiffness(gradient, areas_mm2, corners, count)
    mass = np.bincount(corners.ravel(), np.repeat(areas_mm2 / 3, 3), count)
    solver = splu(csc_array(stiffness + diags_array(hold * mass)))
    points_mm = flat.mesh.vertices_mm
    for _ in range(INNER_count):
        _, _, near_mm = igl.point_mesh_squared_distance(points_mm, target.vertices_mm, target.faces)
        J = np.einsum("fkx,fkd->fxd", points_mm[corners], gradient)
        pull = np.einsum("fxd,fkd->fkx", _admissible(J, low, high), gradient) * areas_mm2[:, None, None]
        right = hold * mass[:, None] * near_mm
        np.add.at(right, corners, pull)
        points_mm = np.asarray(solver.solve(right))
    return points_mm


def _window(expansion_ratio: Values, weights: Values, limit_ratio: float) -> tuple[float, float]:
    """Return the range (low, low·limit) from which the expansions stick out least."""
    logs, width = np.log(expansion_ratio), np.log(limit_ratio)
    lows = np.linspace(logs.min(), logs.max() - width, WINDOW_STEPS_count)
    out = [np.sum(weights * (np.maximum(low - logs, 0) ** 2 + np.maximum(logs - low - width, 0) ** 2)) for low in lows]
    low = float(lows[int(np.argmin(out))])
    return float(np.exp(low)), float(np.exp(low + width))


def _admissible(J: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """Return for each 3×2 map the nearest rotation, times √(σ1σ2) held between `low` and `high`."""
    left, sigma, right = np.linalg.svd(J, full_matrices=False)
    expansion = np.clip(np.sqrt(sigma[:, 0] * sigma[:, 1]), low, high)
    return np.asarray(left @ right * expansion[:, None, None])


def _gradient(flat_mm: Points, faces: Faces) -> NDArray[np.float64]:
    """Return `(m, 3, 2)`: the gradient of each corner's hat function over its flat face."""
    corners = flat_mm[faces]
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    turned = np.stack([-opposite[..., 1], opposite[..., 0]], axis=-1)
    return np.asarray(turned / (2 * signed_areas_mm2(flat_mm, faces))[:, None, None])


def _stiffness(gradient: NDArray[np.float64], areas_mm2: Values, corners: Faces, count: int) -> csc_array:
    blocks = np.einsum("fid,fjd->fij", gradient, gradient) * areas_mm2[:, None, None]
    rows, columns = np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, (1, 3)).ravel()
    return csc_array((blocks.ravel(), (rows, columns)), shape=(count, count))


def _measured(target: TriMesh, flat: Flattening, stages_count: int) -> Feasible:
    square_mm2 = igl.point_mesh_squared_distance(flat.mesh.vertices_mm, target.vertices_mm, target.faces)[0]
    share_mm2 = np.bincount(
        flat.mesh.faces.ravel(), np.repeat(flat.mesh.face_areas_mm2() / 3, 3), len(flat.mesh.vertices_mm)
    )
    rms_mm = float(np.sqrt(np.average(square_mm2, weights=share_mm2)))
    return Feasible(flat, rms_mm, float(np.sqrt(square_mm2.max())), rms_mm / target.diagonal_mm(), stages_count)
