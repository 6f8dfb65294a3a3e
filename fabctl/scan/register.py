"""From a cleaned cloud to a pose one can trust, or an honest no.

Search globally, refine what survives, judge every pose on the same measure in both directions, and compare the best
with all others modulo the target's own symmetries. A pose within `RIVAL_RATIO` of the best that no symmetry explains
makes the answer ambiguous; points that a person or a marker gives may then decide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from design.findings import Finding
from fabctl.events import Emit, Event, silent
from fabctl.scan.clean import Cleaned, Part
from fabctl.scan.coarse import search, search_cloud
from fabctl.scan.foreign import nearest, spacing_of
from fabctl.scan.refine import Fit, Options, refine
from fabctl.scan.similarity import Similarity
from fabctl.scan.symmetry import Symmetries, find_mirrors
from fabctl.scan.target import Target

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

RIVAL_RATIO = 1.10  # poses that fit within this of the best are listed, and must be explained
SEARCH_POINTS = 4000
FIT_POINTS = 8_000  # for judging poses; the chosen one is refined with FINAL_POINTS
FINAL_POINTS = 150_000
DENSE_POINTS = 60_000
KEEP_CLOUD_FRAC, KEEP_TARGET_FRAC = 0.92, 0.7  # the rest is held at its edge: outliers, and what was not seen
EXPLAINED_FRAC = 0.025  # of the diagonal; a point nearer to the target than this is explained by the pose
WORST_RMS_FRAC = 0.02
LEAST_COVERAGE_FRAC, LEAST_EXPLAINED_FRAC = 0.45, 0.75
SURE_RMS_FRAC, SURE_COVERAGE_FRAC, SURE_EXPLAINED_FRAC = 0.008, 0.55, 0.88
MIRROR_BETTER_RATIO = 0.7
MIRROR_DOUBT_FRAC = 0.005
SAME_POSE_FRAC = 0.006

Status = Literal["aligned", "symmetric", "ambiguous", "failed", "mirrored"]


@dataclass(frozen=True, slots=True)
class Judged:
    """A refined pose and how well it fits, all as fractions of the diagonal or of a whole."""

    fit: Fit
    cloud_rms_frac: float
    target_rms_frac: float
    coverage_frac: float  # of the target's area, with a point near it
    explained_frac: float  # of the part's points, near the target
    relation: str = "found by the search"

    @property
    def pose(self) -> Similarity:
        """Return the map from the cloud as read to the target, mm."""
        return self.fit.pose

    @property
    def score_frac(self) -> float:
        """Return one number for the fit in both directions; less is better."""
        return float(np.hypot(self.cloud_rms_frac, self.target_rms_frac) / np.sqrt(2))

    def plausible(self) -> bool:
        """Return whether the cloud can be a scan of the target in this pose at all."""
        return (
            max(self.cloud_rms_frac, self.target_rms_frac) < WORST_RMS_FRAC
            and self.coverage_frac > LEAST_COVERAGE_FRAC
            and self.explained_frac > LEAST_EXPLAINED_FRAC
        )

    def sure(self) -> bool:
        """Return whether the fit is so good that other parts of the cloud need not be tried."""
        return (
            max(self.cloud_rms_frac, self.target_rms_frac) < SURE_RMS_FRAC
            and self.coverage_frac > SURE_COVERAGE_FRAC
            and self.explained_frac > SURE_EXPLAINED_FRAC
        )


@dataclass(frozen=True, slots=True)
class Registration:
    """The answer: a status, the poses it rests on, and what must be said."""

    status: Status
    best: Judged | None
    alternatives: tuple[Judged, ...]  # within RIVAL_RATIO of the best, the best left out
    part: Part | None
    specimen: Mask  # (n,), of the cloud's points
    symmetries: Symmetries
    findings: tuple[Finding, ...]
    decided_by: str = "geometry"


@dataclass(frozen=True, slots=True)
class Datums:
    """Points known in both frames: labelled on the specimen, picked by a person, or markers."""

    labels: tuple[str, ...]
    cloud: Floats  # (k, 3), in the cloud's units
    target_mm: Floats  # (k, 3)


def thin(points: Floats, count: int, seed: int) -> Floats:
    """Return about `count` points spread evenly over the cloud's surface, in random order."""
    if len(points) <= count:
        return points[np.random.default_rng(seed).permutation(len(points))]
    low = points.min(axis=0)
    size = float(np.linalg.norm(np.ptp(points, axis=0))) / 40
    for _ in range(12):
        index = ((points - low) / size).astype(np.int64)
        side = index.max() + 2
        _, first = np.unique((index[:, 0] * side + index[:, 1]) * side + index[:, 2], return_index=True)
        if 0.8 * count <= len(first) <= 1.5 * count:
            break
        size *= float(np.clip(np.sqrt(len(first) / (1.1 * count)), 0.3, 3.0))
    picked = np.random.default_rng(seed).permutation(first)[:count]
    return np.asarray(points[picked])


def judge(fit: Fit, points: Floats, dense: Floats, target: Target, relation: str = "found by the search") -> Judged:
    """Return how well the fit lays the even samples `points` on the target, and the target on `dense`."""
    size = target.diagonal_mm
    placed = fit.pose(points)
    away = np.linalg.norm(placed - target.closest(placed).points_mm, axis=1) / size
    grid = target.search
    samples = grid.grid.points[:3000]
    image = (fit.pose(dense) - target.centre_mm) / size
    tree = cKDTree(image)
    distance, at = nearest(tree, samples)
    reach = max(3 * spacing_of(tree, image[:2000]), 0.012)
    near = distance < reach
    across = np.abs(np.sum((image[at] - samples) * grid.normals[:3000], axis=1))
    back = np.where(near, across, distance)
    return Judged(
        fit,
        _held_rms(away, KEEP_CLOUD_FRAC),
        _held_rms(back, KEEP_TARGET_FRAC),
        float(near.mean()),
        float((away < EXPLAINED_FRAC).mean()),
        relation,
    )


def _held_rms(values: Floats, keep_frac: float) -> float:
    return float(np.sqrt(np.mean(np.minimum(values, np.quantile(values, keep_frac)) ** 2)))


def poses_for_part(
    points: Floats, target: Target, symmetries: Symmetries, scale_ratio: float | None, seed: int, *, mirrored: bool
) -> list[Judged]:
    """Return the refined, distinct poses (modulo symmetry) of these points of the cloud, the best first.

    `scale_ratio` is mm per cloud unit where that is known.
    """
    cloud = search_cloud(thin(points, SEARCH_POINTS, seed), mirrored=mirrored)
    size = target.diagonal_mm
    known = None if scale_ratio is None else scale_ratio / (size * cloud.entering.scale_ratio)
    found = search(cloud, target.search, known)
    leaving = Similarity(np.eye(3), target.centre_mm, size)
    even, dense = thin(points, FIT_POINTS, seed), points[:: max(1, len(points) // DENSE_POINTS)]
    options = Options(free_scale=scale_ratio is None, still=symmetries.still(target))
    score = found.score()
    judged: list[Judged] = []
    for k in np.flatnonzero(score < max(2.2 * score[0], score[0] + 0.004))[:6]:
        start = leaving.after(Similarity(found.rotation[k], found.shift[k], float(found.scale_ratio[k])))
        start = start.after(cloud.entering)
        if any(symmetries.apart_frac(start, j.pose, target) < SAME_POSE_FRAC / 2 for j in judged):
            continue
        fit = refine(even, start, target, options)
        judged.append(judge(fit, even[:4000], dense, target))
    judged.sort(key=lambda j: j.score_frac)
    kept: list[Judged] = []
    for one in judged:
        if all(symmetries.apart_frac(one.pose, other.pose, target) > SAME_POSE_FRAC for other in kept):
            kept.append(one)
    return kept


def register(
    points: Floats,
    cleaned: Cleaned,
    target: Target,
    symmetries: Symmetries,
    *,
    scale_ratio: float | None = None,
    datums: Datums | None = None,
    seed: int = 0,
    emit: Emit = silent,
) -> Registration:
    """Return the pose of the cloud (n, 3) on the target, or why there is none; same input and seed, same answer."""
    tried: list[tuple[Part, list[Judged]]] = []
    for part in cleaned.parts:
        members = _members(cleaned, part)
        if members.sum() < 200:
            continue
        emit(Event("stage", f"aligning: {part.name}, {int(members.sum())} points"))
        found = poses_for_part(points[members], target, symmetries, scale_ratio, seed, mirrored=False)
        tried.append((part, found))
        if found and found[0].sure():
            break
    tried = [(part, found) for part, found in tried if found]
    if not tried:
        finding = Finding("SCAN-EMPTY", "nothing in the cloud can be the specimen", hint="is the file the right one?")
        none = np.zeros(len(points), dtype=bool)
        return Registration("failed", None, (), None, none, symmetries, (finding,))
    part, found = min(tried, key=lambda t: (not t[1][0].plausible(), _merit(t[1][0])))
    best = found[0]
    if best.score_frac > MIRROR_DOUBT_FRAC or not best.plausible():
        emit(Event("stage", "aligning: the mirror image, to see whether it fits better"))
        body = points[_members(cleaned, part)]
        image = poses_for_part(body, target, symmetries, scale_ratio, seed, mirrored=True)
        if image and image[0].plausible() and image[0].score_frac < MIRROR_BETTER_RATIO * best.score_frac:
            unmirrored = _unmirrored(image[0], body, target, symmetries, scale_ratio, seed)
            if unmirrored is None:
                best = replace(image[0], relation="mirror image")
                return _finished("mirrored", best, (), part, points, cleaned, symmetries, target, scale_ratio)
            best, found = unmirrored, [unmirrored, *found]
    if not best.plausible():
        return _finished("failed", best, (), part, points, cleaned, symmetries, target, scale_ratio)
    members = _members(cleaned, part)
    even = thin(points[members], FIT_POINTS, seed)
    rivals = [j for j in found[1:] if j.score_frac <= RIVAL_RATIO * best.score_frac]
    turned = list(_symmetric(best, even, points[members], target, symmetries, scale_ratio))
    if datums is not None:
        chosen, by_datum = decide_by_datums([best, *turned, *rivals], datums, target, symmetries)
        if by_datum:
            others = tuple(j for j in [best, *turned, *rivals] if j is not chosen and j.pose is not chosen.pose)
            return _finished(
                "aligned", chosen, others, part, points, cleaned, symmetries, target, scale_ratio, "datum points"
            )
    status: Status = "ambiguous" if rivals else "symmetric" if turned or symmetries.continuous else "aligned"
    return _finished(status, best, (*turned, *rivals), part, points, cleaned, symmetries, target, scale_ratio)


def _unmirrored(
    image: Judged, members: Floats, target: Target, symmetries: Symmetries, scale_ratio: float | None, seed: int
) -> Judged | None:
    """Return the proper pose that the mirrored one amounts to where the target is its own mirror image, else None."""
    mirrors = find_mirrors(target, symmetries)
    if not mirrors:
        return None
    even, dense = thin(members, FIT_POINTS, seed), members[:: max(1, len(members) // DENSE_POINTS)]
    options = Options(free_scale=scale_ratio is None, still=symmetries.still(target))
    fit = refine(even, mirrors[0].motion.after(image.pose), target, options)
    return judge(fit, even[:4000], dense, target)


def _merit(judged: Judged) -> float:
    return judged.score_frac / max(judged.coverage_frac * judged.explained_frac, 1e-3)


def _members(cleaned: Cleaned, part: Part) -> Mask:
    of = cleaned.cells.of_point
    held = np.zeros(len(of), dtype=bool)
    inside = of >= 0
    held[inside] = part.cells[of[inside]]
    return held if "plane kept" in part.name else held & ~cleaned.is_table


def _symmetric(
    best: Judged,
    even: Floats,
    dense: Floats,
    target: Target,
    symmetries: Symmetries,
    scale_ratio: float | None,
) -> Iterator[Judged]:
    """Yield the pose under every symmetry of the target, refined and judged in its own right."""
    options = Options(free_scale=scale_ratio is None, still=symmetries.still(target))
    for symmetry in symmetries.turns:
        fit = refine(even, symmetry.motion.after(best.pose), target, options)
        found = judge(
            fit, even[:4000], dense[:: max(1, len(dense) // DENSE_POINTS)], target, f"symmetry: {symmetry.describe()}"
        )
        if found.score_frac <= RIVAL_RATIO * best.score_frac:
            yield found


def decide_by_datums(
    candidates: list[Judged], datums: Datums, target: Target, symmetries: Symmetries
) -> tuple[Judged, bool]:
    """Return the candidate that the datum points single out, and whether they do.

    They do where the best candidate's points miss by less than a third of what the next one's do. About the axis of a
    surface of revolution the points also choose the turn.
    """
    placed = [spun_to(j, datums, symmetries) for j in candidates]
    miss = [float(np.sqrt(((j.pose(datums.cloud) - datums.target_mm) ** 2).sum(axis=1).mean())) for j in placed]
    order = np.argsort(miss)
    single = len(order) == 1 or miss[order[0]] < miss[order[1]] / 3
    fits = miss[order[0]] < 0.05 * target.diagonal_mm
    return placed[order[0]], bool(single and fits)


def spun_to(judged: Judged, datums: Datums, symmetries: Symmetries) -> Judged:
    """Return the pose turned about the axis of revolution so that the datum points fit best."""
    from fabctl.scan.symmetry import spin_angle

    if symmetries.axis_point_mm is None or symmetries.axis_direction is None:
        return judged
    angle = spin_angle(judged.pose(datums.cloud), datums.target_mm, symmetries.axis_point_mm, symmetries.axis_direction)
    return replace(judged, fit=replace(judged.fit, pose=symmetries.spin(angle).after(judged.pose)))


def _finished(
    status: Status,
    best: Judged,
    alternatives: tuple[Judged, ...],
    part: Part,
    points: Floats,
    cleaned: Cleaned,
    symmetries: Symmetries,
    target: Target,
    scale_ratio: float | None,
    decided_by: str = "geometry",
) -> Registration:
    specimen = specimen_points(points, cleaned, part, best.pose, target)
    if status in ("aligned", "symmetric") and specimen.sum() > 500:
        options = Options(free_scale=scale_ratio is None, still=symmetries.still(target))
        chosen = points[specimen]
        final = refine(chosen[:: max(1, len(chosen) // FINAL_POINTS)], best.pose, target, options)
        best = replace(best, fit=final)
        specimen = specimen_points(points, cleaned, part, best.pose, target)
    findings = tuple(_findings(status, best, alternatives, cleaned, symmetries, target))
    return Registration(status, best, alternatives, part, specimen, symmetries, findings, decided_by)


def specimen_points(points: Floats, cleaned: Cleaned, part: Part, pose: Similarity, target: Target) -> Mask:
    """Return which points are the specimen, given the pose: dense cells near the target, table left out."""
    band_mm = 0.05 * target.diagonal_mm
    cells = cleaned.cells
    near = np.zeros(len(cells.count), dtype=bool)
    dense = ~cleaned.sparse
    placed = pose(cells.centre[dense])
    away = np.linalg.norm(placed - target.closest(placed).points_mm, axis=1)
    near[dense] = away < band_mm
    held = np.zeros(len(points), dtype=bool)
    inside = cells.of_point >= 0
    held[inside] = (near & ((cleaned.cluster >= 0) | part.cells))[cells.of_point[inside]]
    return held if "plane kept" in part.name else held & ~cleaned.is_table


def _findings(
    status: Status,
    best: Judged,
    alternatives: tuple[Judged, ...],
    cleaned: Cleaned,
    symmetries: Symmetries,
    target: Target,
) -> Iterator[Finding]:
    if status == "failed":
        yield Finding(
            "SCAN-NO-FIT",
            f"no pose explains the cloud: the best leaves {best.score_frac:.2%} of the diagonal (rms), covers "
            f"{best.coverage_frac:.0%} of the target and explains {best.explained_frac:.0%} of the points",
            hint="is it the right target and cloud, and is the specimen's own cloud large enough?",
        )
    if status == "mirrored":
        yield Finding(
            "SCAN-MIRROR",
            f"the cloud is the mirror image of the target (fits to {best.score_frac:.2%} of the diagonal): the "
            "specimen was deployed to the other side, or cut from the mirrored pattern",
            hint="snap it to the other side, or compare with the mirrored target",
        )
    if status == "ambiguous":
        worst = max(a.score_frac for a in alternatives) / best.score_frac - 1
        yield Finding(
            "SCAN-AMBIGUOUS",
            f"{len(alternatives)} other poses fit within {worst:.1%} of the best; geometry cannot decide",
            hint="give three datum points (--datum), markers, or scan more of the specimen",
        )
    if status == "symmetric":
        for line in symmetries.describe():
            yield Finding(
                "SCAN-SYMMETRY",
                f"the target has a symmetry, so the pose is known only up to it: {line}",
                level="warning",
                hint="datum points (--datum) decide; the numbers hold for every such pose listed",
            )
    if status in ("aligned", "symmetric", "ambiguous") and cleaned.table is not None:
        up = best.pose.rotation @ cleaned.table.normal
        area = target.mesh.face_areas_mm2()
        a, b, c = (target.mesh.vertices_mm[target.mesh.faces[:, k]] for k in range(3))
        facing = np.cross(b - a, c - a).sum(axis=0) / (2 * area.sum())
        if float(facing @ up) < -0.3:
            yield Finding(
                "SCAN-OTHER-SIDE",
                "on its table the specimen shows its back: it lies upside down or was deployed to the other side",
                level="warning",
                hint="look which face is marked; for a target that is its own mirror image geometry cannot tell",
            )
