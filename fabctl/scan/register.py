"""From a cleaned cloud to a pose one can trust, or an honest no.

Search globally, refine what survives, judge every pose on the same measure in both directions, and compare the best
with all others modulo the target's own symmetries. A pose within `RIVAL_RATIO` of the best that no symmetry explains
makes the answer ambiguous; points that a person or a marker gives may then decide. Where the surface itself hardly
holds the pose, it is pushed along those motions and must come back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from design.findings import Finding
from fabctl.events import Emit, Event, silent
from fabctl.scan.borders import Circle, circle, rim_axis, turn_motion
from fabctl.scan.clean import Cleaned, Part
from fabctl.scan.coarse import search, search_cloud
from fabctl.scan.decide import HELD_FRAC, Datums, decide_by_border, decide_by_datums, decide_by_paint
from fabctl.scan.edges import edge_finder
from fabctl.scan.judge import Judged, judge, thin
from fabctl.scan.paint import Paint
from fabctl.scan.refine import Options, is_weak, moved_by, refine, weak_motions
from fabctl.scan.rim import Rest
from fabctl.scan.said import Status, findings_of
from fabctl.scan.similarity import Similarity
from fabctl.scan.symmetry import Symmetries, find_mirrors
from fabctl.scan.target import Closest, Target

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

RIVAL_RATIO = 1.10  # poses that fit within this of the best are listed, and must be explained
SEARCH_POINTS = 4000
FIT_POINTS = 8_000  # for judging poses; the chosen one is refined with FINAL_POINTS
ROUGH_POINTS, FINAL_POINTS = 20_000, 150_000  # the statistics of the points show in the scale
DENSE_POINTS = 60_000
JUDGE_POINTS = 4000
CANDIDATES = 6
LEAST_MEMBERS = 200
MIRROR_BETTER_RATIO = 0.7
MIRROR_DOUBT_FRAC = 0.005
SAME_POSE_FRAC, NEAR_POSE_FRAC = 0.004, 0.06
FINAL_ROUNDS, SETTLED_FRAC = 2, 1e-4  # of the diagonal
PUSHES_FRAC = (-0.04, -0.015, 0.015, 0.04)

NO_SYMMETRIES = Symmetries((), None, None)


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


@dataclass(frozen=True)
class Task:
    """What is to be registered, and what is known beforehand; `scale_ratio` is mm per cloud unit where it is known."""

    points: Floats  # (n, 3), the cloud as read
    cleaned: Cleaned
    target: Target
    symmetries: Symmetries
    scale_ratio: float | None = None
    datums: Datums | None = None
    colours: NDArray[np.uint8] | None = None  # (n, 3), of the cloud
    paint: Paint | None = None  # what the specimen looks like, in the target's frame
    seed: int = 0
    emit: Emit = field(default=silent)

    @property
    def options(self) -> Options:
        """Return how poses are refined."""
        table = self.cleaned.table
        return Options(
            free_scale=self.scale_ratio is None,
            still=self.symmetries.still(self.target),
            rest=None if table is None else Rest(table, self.cleaned.table_top_cu),
        )


@dataclass(frozen=True)
class Body:
    """The points of one part of the cloud, thinned once for all poses that are tried with it."""

    part: Part
    even: Floats
    dense: Floats

    @cached_property
    def tree(self) -> cKDTree:
        """Return the dense points as read, to be asked for neighbours."""
        return cKDTree(self.dense)


def body_of(task: Task, part: Part) -> Body | None:
    """Return the points of the part, or None where there are too few."""
    members = task.points[_members(task.cleaned, part)]
    if len(members) < LEAST_MEMBERS:
        return None
    return Body(part, thin(members, FIT_POINTS, task.seed), members[:: max(1, len(members) // DENSE_POINTS)])


def tried(task: Task, body: Body, start: Similarity, relation: str = "found by the search") -> Judged:
    """Return the pose refined from `start`, and judged."""
    fit = refine(body.even, start, task.target, task.options)
    judged = judge(fit, body.even[:JUDGE_POINTS], body.dense, task.target, relation)
    task.emit(Event("progress", f"a pose {relation}: misfit {judged.score_frac:.2%} of the diagonal"))
    return judged


def poses_of(task: Task, body: Body, *, mirrored: bool = False) -> list[Judged]:
    """Return the refined poses of the body that differ by more than a symmetry, the best first."""
    cloud = search_cloud(thin(body.even, SEARCH_POINTS, task.seed), mirrored=mirrored)
    target, size = task.target, task.target.diagonal_mm
    known = None if task.scale_ratio is None else task.scale_ratio / (size * cloud.entering.scale_ratio)
    found = search(cloud, target.search, known)
    leaving = Similarity(np.eye(3), target.centre_mm, size)
    score = found.score()
    judged: list[Judged] = []
    for k in np.flatnonzero(score < max(2.2 * score[0], score[0] + 0.004))[:CANDIDATES]:
        turn = Similarity(found.rotation[k], found.shift[k], float(found.scale_ratio[k]))
        start = leaving.after(turn).after(cloud.entering)
        if all(task.symmetries.apart_frac(start, j.pose, target) > SAME_POSE_FRAC / 2 for j in judged):
            judged.append(tried(task, body, start))
    return _distinct(task, judged)


def _distinct(task: Task, judged: list[Judged]) -> list[Judged]:
    kept: list[Judged] = []
    for one in sorted(judged, key=lambda j: j.score_frac):
        if all(task.symmetries.apart_frac(one.pose, other.pose, task.target) > SAME_POSE_FRAC for other in kept):
            kept.append(one)
    return kept


def pushed(task: Task, body: Body, best: Judged) -> list[Judged]:
    """Return where the best pose goes when it is pushed along the motions that the surface hardly holds."""
    weak = weak_motions(best.fit, task.target, task.options, HELD_FRAC)
    near = [
        tried(task, body, moved_by(best.pose, push * motion, task.target), "pushed along a weak motion")
        for motion in weak
        for push in PUSHES_FRAC
    ]
    return near + [tried(task, body, start, "turned until the border fits") for start in _turned(task, body, best)]


def _turned(task: Task, body: Body, best: Judged) -> list[Similarity]:
    """Return the pose turned about the rim's axis to where the rest of the border fits, if the surface allows it."""
    turns = _turns(task, body, best)
    return [] if turns is None else turns.likeliest()


def _open_turns(task: Task, body: Body, best: Judged) -> list[Similarity]:
    """Return turns well away from the pose that neither surface nor border speak against: no rival was better."""
    turns = _turns(task, body, best)
    return turns.likeliest() if turns is not None and turns.open_elsewhere() else []


def _turns(task: Task, body: Body, best: Judged) -> Circle | None:
    axis = rim_axis(task.target)
    if axis is None or task.symmetries.continuous:
        return None
    finder = edge_finder(body.dense, best.pose, task.target)
    if finder is None or not is_weak(turn_motion(axis, task.target), best.fit, task.target, HELD_FRAC):
        return None
    return circle(body.tree, finder, best.pose, axis)


def register(task: Task) -> Registration:
    """Return the pose of the cloud on the target, or why there is none; same input and seed, same answer."""
    fits: list[tuple[Body, list[Judged]]] = []
    for part in task.cleaned.parts:
        body = body_of(task, part)
        if body is None:
            continue
        task.emit(Event("stage", f"aligning: {part.name}"))
        found = poses_of(task, body)
        fits += [(body, found)] if found else []
        if found and found[0].sure():
            break
    if not fits:
        finding = Finding("SCAN-EMPTY", "nothing in the cloud can be the specimen", hint="is the file the right one?")
        none = np.zeros(len(task.points), dtype=bool)
        return Registration("failed", None, (), None, none, task.symmetries, (finding,))
    body, found = min(fits, key=lambda t: (not t[1][0].plausible(), _merit(t[1][0])))
    if found[0].score_frac > MIRROR_DOUBT_FRAC or not found[0].plausible():
        # Where no part fits as it is, the merit of their poses says nothing about which one is the specimen.
        doubtful = [body] if found[0].plausible() else [b for b, _ in fits]
        for other in doubtful:
            image, proper = _mirrored(task, other, found[0])
            if image is not None and proper is None:
                return _finished(task, "mirrored", image, (), other)
            if proper is not None:
                body, found = other, _distinct(task, [*(found if other is body else ()), proper])
                break
    if not found[0].plausible():
        return _finished(task, "failed", found[0], (), body)
    found = _distinct(task, [*found, *pushed(task, body, found[0])])
    return _decided(task, body, found)


def _decided(task: Task, body: Body, found: list[Judged]) -> Registration:
    """Return the answer from the distinct poses, the best first."""
    found = _settled(task, body, found)
    best = found[0]
    rivals = _rivals(found)
    turned = list(_symmetric(task, body, best))
    if task.datums is not None:
        chosen, single = decide_by_datums([best, *turned, *rivals], task.datums, task.target, task.symmetries)
        if single:
            others = tuple(j for j in (best, *turned, *rivals) if j.fit.patches is not chosen.fit.patches)
            return _finished(task, "aligned", chosen, others, body, "datum points")
    turns = bool(turned) or task.symmetries.continuous
    if task.paint is not None and task.colours is not None and (rivals or turns):
        painted = _by_paint(task, body, [best, *turned, *rivals])
        if painted is not None:
            others = tuple(j for j in (best, *turned, *rivals) if j.fit.patches is not painted.fit.patches)
            return _finished(task, "aligned", painted, others, body, "colour")
    if not rivals and not turns:
        rivals = [tried(task, body, start, "turned: the border allows it") for start in _open_turns(task, body, best)]
    if rivals and not turns:
        finder = edge_finder(body.dense, best.pose, task.target)
        single_out = None if finder is None else decide_by_border(finder, body.tree, [best, *rivals], task.symmetries)
        if single_out is not None:
            others = tuple(j for j in (best, *rivals) if j is not single_out)
            return _finished(task, "aligned", single_out, others, body, "border")
    status: Status = "ambiguous" if rivals else "symmetric" if turns else "aligned"
    return _finished(task, status, best, (*turned, *rivals), body)


def _rivals(found: list[Judged]) -> list[Judged]:
    return [j for j in found[1:] if j.score_frac <= RIVAL_RATIO * found[0].score_frac]


def _settled(task: Task, body: Body, found: list[Judged]) -> list[Judged]:
    """Return the poses, the best first, where those that lie near the best are refined again with all the points.

    A surface that slides in itself is held by its rim alone, and few points show a rim only roughly: what looks like
    two poses may be one.
    """
    best = found[0]
    if rim_axis(task.target) is not None:
        return found  # what a hole holds is decided by its edge; poses sharpened alone would beat the others unfairly
    near = [j for j in _rivals(found) if task.symmetries.apart_frac(best.pose, j.pose, task.target) < NEAR_POSE_FRAC]
    if not near:
        return found
    rest = [j for j in found[1:] if not any(j is n for n in near)]
    # Only their places are sharpened: with a better score they would beat poses farther off that were not.
    sharper = [replace(j, fit=refine(body.dense, j.pose, task.target, task.options)) for j in (best, *near)]
    return _distinct(task, [*sharper, *rest])


def _by_paint(task: Task, body: Body, candidates: list[Judged]) -> Judged | None:
    assert task.paint is not None and task.colours is not None
    chosen = np.flatnonzero(_members(task.cleaned, body.part))
    some = chosen[:: max(1, len(chosen) // DENSE_POINTS)]
    return decide_by_paint(candidates, task.paint, task.points[some], task.colours[some], task.target, task.symmetries)


def _mirrored(task: Task, body: Body, best: Judged) -> tuple[Judged | None, Judged | None]:
    """Return the mirror image's pose where it fits much better, and the proper pose it amounts to, if there is one.

    A target that is its own mirror image turns a mirrored pose into a proper one that the search had missed.
    """
    task.emit(Event("stage", "aligning: the mirror image, to see whether it fits better"))
    image = poses_of(task, body, mirrored=True)
    better = image and image[0].plausible() and image[0].score_frac < MIRROR_BETTER_RATIO * best.score_frac
    if not better:
        return None, None
    mirrors = find_mirrors(task.target, task.symmetries)
    if not mirrors:
        return replace(image[0], relation="mirror image"), None
    return image[0], tried(task, body, mirrors[0].motion.after(image[0].pose))


def _merit(judged: Judged) -> float:
    return judged.score_frac / max(judged.coverage_frac * judged.explained_frac, 1e-3)


def _members(cleaned: Cleaned, part: Part) -> Mask:
    of = cleaned.cells.of_point
    held = np.zeros(len(of), dtype=bool)
    inside = of >= 0
    held[inside] = part.cells[of[inside]]
    return held if "plane kept" in part.name else held & ~cleaned.is_table


def _symmetric(task: Task, body: Body, best: Judged) -> Iterator[Judged]:
    """Yield the pose under every symmetry of the target, refined and judged in its own right."""
    for symmetry in task.symmetries.turns:
        start = symmetry.motion.after(best.pose)
        found = tried(task, body, start, f"symmetry: {symmetry.describe()}")
        if found.score_frac <= RIVAL_RATIO * best.score_frac:
            yield found


def _finished(
    task: Task,
    status: Status,
    best: Judged,
    alternatives: tuple[Judged, ...],
    body: Body,
    decided_by: str = "geometry",
) -> Registration:
    specimen, options = specimen_points(task, body.part, best.pose), task.options
    if status in ("aligned", "symmetric") and specimen.sum() > 500:
        for most in (ROUGH_POINTS, *(FINAL_POINTS,) * FINAL_ROUNDS):  # which points count hangs a little on the pose
            chosen, before = task.points[specimen], best.pose
            final = refine(chosen[:: max(1, len(chosen) // most)], before, task.target, options)
            best, options = replace(best, fit=final), replace(options, slides=False)
            specimen = specimen_points(task, body.part, best.pose)
            settled = NO_SYMMETRIES.apart_frac(before, best.pose, task.target) < SETTLED_FRAC
            if settled and most == FINAL_POINTS:
                break
    findings = tuple(findings_of(status, best, alternatives, body.part, task.cleaned, task.symmetries, task.target))
    return Registration(status, best, alternatives, body.part, specimen, task.symmetries, findings, decided_by)


def specimen_points(task: Task, part: Part, pose: Similarity) -> Mask:
    """Return which points are the specimen, given the pose: dense cells near the target, table left out."""
    cleaned, target = task.cleaned, task.target
    band_mm = 0.05 * target.diagonal_mm
    cells = cleaned.cells
    near = np.zeros(len(cells.count), dtype=bool)
    dense = ~cleaned.sparse
    placed = pose(cells.centre[dense])
    found = target.closest(placed)
    near[dense] = np.linalg.norm(placed - found.points_mm, axis=1) < band_mm
    held = np.zeros(len(task.points), dtype=bool)
    inside = cells.of_point >= 0
    held[inside] = (near & ((cleaned.cluster >= 0) | part.cells))[cells.of_point[inside]]
    if "plane kept" in part.name:
        return held
    held &= ~cleaned.is_table
    if cleaned.table is not None:
        low = np.zeros(len(cells.count), dtype=bool)
        low[dense] = _too_low(found, pose, cleaned, room_cu=2 * cells.size_cu)
        # A cell's middle lies where noise put it; which points are too low their own feet must say.
        asked = np.flatnonzero(held)
        asked = asked[low[cells.of_point[asked]]]
        held[asked] = ~_too_low(target.closest(pose(task.points[asked])), pose, cleaned)
    return held


def _too_low(found: Closest, pose: Similarity, cleaned: Cleaned, room_cu: float = 0.0) -> Mask:
    """Return where the target lies so near to the table that only points with upward noise were kept as specimen.

    There the scan would seem to deviate upwards. The more level the surface, the more of the noise is upwards.
    """
    assert cleaned.table is not None
    back = pose.inverse()
    height = cleaned.table.height(back(found.points_mm))
    level = np.abs((found.normals @ pose.rotation) @ cleaned.table.normal)
    return np.asarray(height < cleaned.table_top_cu * (1 + 0.9 * level) + room_cu)
