"""A photogrammetry rig: from a deployed mesh a cloud as a lab gets it, with what the cloud hides kept apart.

Cameras go round the specimen on its table. What they see is smoothed, noisy (more so at grazing angles), has holes and
outliers, comes with table and background, and in a frame and scale of its own.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
SPECIMEN, TABLE, BACKGROUND, OUTLIER = range(4)
LABELS = ("specimen", "table", "background", "outlier")


@dataclass(frozen=True, slots=True)
class ScanPlan:
    """What the photographer and the world do; fractions of lengths are of the mesh's box diagonal."""

    seed: int = 0
    points_count: int = 60_000
    unseen_frac: float = 0.15
    outliers_frac: float = 0.05
    noise_frac: float = 0.0015
    smoothing_frac: float = 0.003
    scale_ratio: float | None = None  # cloud units per mm; None draws one between 0.01 and 100
    turned: bool = True
    table: bool = True
    background_count: int = 2
    cameras_count: int = 20
    bump_frac: float = 0.0
    bump_width_frac: float = 0.06
    other_side: bool = False
    mirrored: bool = False


@dataclass(frozen=True, slots=True)
class Samples:
    """Points on something the cameras may see, with the class they belong to."""

    points_mm: Floats  # (n, 3)
    normals: Floats  # (n, 3)
    colours: Floats  # (n, 3), 0 to 1


@dataclass(frozen=True, slots=True)
class Scan:
    """The cloud in its own units, and everything a person does not know about it."""

    points: Floats
    normals: Floats
    colours: Floats
    labels: NDArray[np.int8]  # SPECIMEN, TABLE, BACKGROUND or OUTLIER
    displacement_mm: Floats  # what the specimen's points really deviate from the mesh, zero elsewhere
    source_mm: Floats  # where on the mesh each specimen point comes from, in the mesh's frame
    rotation: Floats  # cloud = scale * rotation @ mesh + translation
    translation: Floats
    scale_ratio: float
    unseen_frac: float


# --- the specimen ----------------------------------------------------------------------------------------------------


def vertex_normals(vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    """Return area-weighted unit normals of the vertices."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))


def sample_mesh(
    vertices: Floats, faces: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return `count` points spread evenly over the area, with interpolated normals."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(faces), count, p=area / area.sum())
    r1, r2 = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - r1, r1 * (1 - r2), r1 * r2], axis=1)
    points = np.einsum("nk,nkd->nd", weights, vertices[faces[face]])
    normals = np.einsum("nk,nkd->nd", weights, vertex_normals(vertices, faces)[faces[face]])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def bump_mm(points: Floats, diagonal_mm: float, plan: ScanPlan, rng: np.random.Generator) -> Floats:
    """Return the height of a smooth local bump at every point; zero when none is asked for."""
    if plan.bump_frac == 0:
        return np.zeros(len(points))
    centre = points[rng.integers(len(points))]
    distance = np.linalg.norm(points - centre, axis=1) / (plan.bump_width_frac * diagonal_mm)
    return np.asarray(plan.bump_frac * diagonal_mm * np.exp(-0.5 * distance**2))


def rubber_colours(points: Floats, box_low: Floats, diagonal_mm: float) -> Floats:
    """Return dark rubber with slits and one white label near the corner of least x + y, so that ends differ."""
    stripes = 0.5 + 0.5 * np.sin(2 * np.pi * (points @ np.array([1.0, 0.58, 0.3])) / (0.045 * diagonal_mm))
    grey = 0.12 + 0.10 * stripes
    order = points @ np.array([0.8, 0.6, 0.0])
    label = np.linalg.norm(points - points[np.argmin(order)], axis=1) < 0.07 * diagonal_mm
    return np.asarray(np.repeat(np.where(label, 0.92, grey)[:, None], 3, axis=1))


# --- the room --------------------------------------------------------------------------------------------------------


def table_samples(size_mm: float, centre: Floats, density_mm2: float, rng: np.random.Generator) -> Samples:
    """Return a wooden table top at z = 0 around `centre`."""
    half = size_mm * rng.uniform(0.55, 0.85, 2)
    count = int(min(4 * half[0] * half[1] * density_mm2, 4e6))
    points = np.zeros((count, 3))
    points[:, :2] = centre[:2] + rng.uniform(-1, 1, (count, 2)) * half + rng.normal(0, 0.1 * size_mm, 2)
    grain = 0.5 + 0.3 * np.sin(points[:, 0] / (0.02 * size_mm) + 2 * np.sin(points[:, 1] / (0.2 * size_mm)))
    colours = np.stack([0.35 + 0.4 * grain, 0.22 + 0.3 * grain, 0.1 + 0.15 * grain], axis=1)
    return Samples(points, np.tile([0.0, 0.0, 1.0], (count, 1)), colours)


def background_samples(size_mm: float, centre: Floats, density_mm2: float, rng: np.random.Generator) -> Samples:
    """Return one stray thing beyond the specimen: a ball or a bit of wall."""
    azimuth, distance = rng.uniform(0, 2 * np.pi), size_mm * rng.uniform(1.0, 1.8)
    place = centre + distance * np.array([np.cos(azimuth), np.sin(azimuth), rng.uniform(0.0, 0.4)])
    radius = size_mm * rng.uniform(0.06, 0.2)
    count = int(min(max(4 * np.pi * radius**2 * density_mm2, 50), 1e6))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if rng.random() < 0.5:
        points, normals = place + radius * direction, direction
    else:
        facing = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0])
        along = np.array([facing[1], -facing[0], 0.0])
        points = place + rng.uniform(-1, 1, (count, 1)) * 1.7 * radius * along
        points[:, 2] += rng.uniform(-1.0, 1.0, count) * radius
        normals = np.tile(facing, (count, 1))
    return Samples(points, normals, np.clip(rng.uniform(0.2, 0.9, 3) + rng.normal(0, 0.05, (count, 3)), 0, 1))


def camera_path(centre: Floats, size_mm: float, count: int, rng: np.random.Generator) -> Floats:
    """Return camera places on a wavy ring round the specimen."""
    azimuth = rng.uniform(0, 2 * np.pi) + np.linspace(0, 2 * np.pi, count, endpoint=False)
    elevation = np.radians(42 + 22 * np.sin(3 * azimuth))
    distance = 1.6 * size_mm
    ring = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    return np.asarray(centre + distance * ring + rng.normal(0, 0.05 * size_mm, (count, 3)))


def seen_by(
    samples: Samples, cameras: Floats, vertices: Floats, faces: NDArray[np.int64], start_mm: float
) -> tuple[NDArray[np.int64], Floats]:
    """Return by how many cameras each point is seen, and the cosine of the second best viewing angle.

    The cosine's sign says which side was looked at. Both faces of a sheet can be seen; a ray begins `start_mm` off
    the surface, so that it does not meet itself.
    """
    o3d: Any = importlib.import_module("open3d")
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(np.ascontiguousarray(faces.astype(np.uint32)))
    )
    count = np.zeros(len(samples.points_mm), dtype=np.int64)
    best = np.zeros((2, len(samples.points_mm)))
    side = np.zeros(len(samples.points_mm))
    for camera in cameras:
        ray = camera - samples.points_mm
        length = np.linalg.norm(ray, axis=1, keepdims=True)
        ray /= length
        cosine = np.sum(ray * samples.normals, axis=1)
        start = samples.points_mm + start_mm * (ray + np.sign(cosine)[:, None] * samples.normals)
        rays = np.concatenate([start, ray], axis=1).astype(np.float32)
        hidden = scene.test_occlusions(o3d.core.Tensor(rays), 0.0, float(length.max())).numpy()
        side += np.where(hidden, 0.0, cosine)
        cosine = np.where(hidden, 0.0, np.abs(cosine))
        count += cosine > 0.17  # nothing matches beyond about 80 degrees
        best = np.sort(np.vstack([best, cosine]), axis=0)[-2:]
    return count, best[0] * np.where(side < 0, -1.0, 1.0)


def holes(points: Floats, seen: NDArray[np.bool_], unseen_frac: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return `seen` less some patches, so that `unseen_frac` of all points is unseen (if it was not more already)."""
    lost = round(unseen_frac * len(points)) - int((~seen).sum())
    if lost <= 0:
        return seen
    centres = points[rng.integers(len(points), size=rng.integers(1, 5))]
    reach = rng.uniform(0.5, 1.5, len(centres))
    nearness = np.min(np.linalg.norm(points[:, None] - centres, axis=2) / reach, axis=1)
    nearness[~seen] = np.inf
    kept = seen.copy()
    kept[np.argsort(nearness)[:lost]] = False
    return kept


# --- what comes out --------------------------------------------------------------------------------------------------


def random_rotation(rng: np.random.Generator) -> Floats:
    """Return a rotation drawn evenly from all."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def scan(vertices_mm: Floats, faces: NDArray[np.int64], plan: ScanPlan) -> Scan:
    """Return what the rig makes of the mesh; the same plan gives the same cloud."""
    rng = np.random.default_rng(plan.seed)
    diagonal_mm = float(np.linalg.norm(np.ptp(vertices_mm, axis=0)))
    side = np.diag([1.0, 1.0, -1.0]) if plan.other_side else np.diag([-1.0, 1.0, 1.0]) if plan.mirrored else np.eye(3)
    placed = vertices_mm @ side
    lift = np.array([0.0, 0.0, 0.002 * diagonal_mm - placed[:, 2].min()])
    placed = placed + lift
    centre = (placed.min(axis=0) + placed.max(axis=0)) / 2
    cameras = camera_path(centre, diagonal_mm, plan.cameras_count, rng)

    source, normals = sample_mesh(placed, faces, plan.points_count, rng)
    bump = bump_mm(source, diagonal_mm, plan, rng)
    body = Samples(source, normals, rubber_colours(source, placed.min(axis=0), diagonal_mm))
    density_mm2 = plan.points_count / float(_area_mm2(placed, faces))
    things = [(SPECIMEN, body)]
    if plan.table:
        things.append((TABLE, table_samples(diagonal_mm, centre, 0.6 * density_mm2, rng)))
    things += [
        (BACKGROUND, background_samples(diagonal_mm, centre, 0.6 * density_mm2, rng))
        for _ in range(plan.background_count)
    ]

    parts, labels, deviations, sources, unseen_frac = [], [], [], [], 0.0
    for label, thing in things:
        count, cosine = seen_by(thing, cameras, placed, faces, 2e-4 * diagonal_mm)
        seen = count >= 2
        offset = np.zeros(len(seen))
        if label == SPECIMEN:
            seen = holes(thing.points_mm, seen, plan.unseen_frac, rng)
            unseen_frac, offset = 1.0 - float(seen.mean()), bump
        shown = Samples(
            _smoothed(thing.points_mm[seen], plan.smoothing_frac * diagonal_mm)
            + offset[seen, None] * thing.normals[seen]
            + _noise(thing.normals[seen], cosine[seen], plan.noise_frac * diagonal_mm, rng),
            thing.normals[seen] * np.sign(cosine[seen, None]),
            np.clip(thing.colours[seen] + rng.normal(0, 0.02, (int(seen.sum()), 3)), 0, 1),
        )
        parts.append(shown)
        labels.append(np.full(len(shown.points_mm), label, dtype=np.int8))
        deviations.append(offset[seen])
        sources.append((thing.points_mm[seen] - lift) @ side)
    stray = _outliers(parts[0], plan.outliers_frac, diagonal_mm, rng)
    parts.append(stray)
    labels.append(np.full(len(stray.points_mm), OUTLIER, dtype=np.int8))
    deviations.append(np.zeros(len(stray.points_mm)))
    sources.append(np.zeros_like(stray.points_mm))

    rotation = random_rotation(rng) if plan.turned else np.eye(3)
    scale = float(10 ** rng.uniform(-2, 2)) if plan.scale_ratio is None else plan.scale_ratio
    shift = rng.uniform(-5, 5, 3) * diagonal_mm * scale if plan.turned else np.zeros(3)
    points = np.concatenate([p.points_mm for p in parts])
    order = rng.permutation(len(points))
    return Scan(
        points=(scale * points @ rotation.T + shift)[order],
        normals=(np.concatenate([p.normals for p in parts]) @ rotation.T)[order],
        colours=np.concatenate([p.colours for p in parts])[order],
        labels=np.concatenate(labels)[order],
        displacement_mm=np.concatenate(deviations)[order],
        source_mm=np.concatenate(sources)[order],
        rotation=rotation @ side,
        translation=scale * rotation @ lift + shift,
        scale_ratio=scale,
        unseen_frac=unseen_frac,
    )


def _area_mm2(vertices: Floats, faces: NDArray[np.int64]) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _smoothed(points: Floats, radius_mm: float) -> Floats:
    """Return the points drawn halfway to the mean of their neighbours, as dense matching does."""
    if radius_mm <= 0 or len(points) < 10:
        return points
    distance, near = cKDTree(points).query(points, k=9)
    weight = np.exp(-0.5 * (distance / radius_mm) ** 2)[..., None]
    return np.asarray(0.5 * points + 0.5 * np.sum(weight * points[near], axis=1) / np.sum(weight, axis=1))


def _noise(normals: Floats, cosine: Floats, sigma_mm: float, rng: np.random.Generator) -> Floats:
    """Return noise mostly along the normal, as 1/cos of the viewing angle and at most four times."""
    spread = sigma_mm / np.maximum(np.abs(cosine), 0.25)
    along = rng.normal(size=len(normals)) * spread
    return np.asarray(along[:, None] * normals + 0.3 * spread[:, None] * rng.normal(size=normals.shape))


def _outliers(body: Samples, outliers_frac: float, diagonal_mm: float, rng: np.random.Generator) -> Samples:
    """Return wrong matches: half float off the specimen, half lie anywhere in a box around it."""
    count = round(outliers_frac / (1 - outliers_frac) * len(body.points_mm))
    near = body.points_mm[rng.integers(len(body.points_mm), size=count // 2)]
    floaters = near + rng.normal(0, 0.03 * diagonal_mm, near.shape)
    low, high = body.points_mm.min(axis=0), body.points_mm.max(axis=0)
    anywhere = rng.uniform(low - 0.3 * diagonal_mm, high + 0.3 * diagonal_mm, (count - len(near), 3))
    anywhere[:, 2] = np.abs(anywhere[:, 2])
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Samples(np.concatenate([floaters, anywhere]), normals, rng.uniform(0, 1, (count, 3)))
