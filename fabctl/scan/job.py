"""One comparison from files to numbers, and its run record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.errors import DONE, OUT_OF_TOLERANCE, REFUSED, UsageError
from fabctl.events import Emit, Event, silent
from fabctl.records.folder import RunFolder
from fabctl.scan.clean import Cleaned, clean
from fabctl.scan.cloud import Cloud, read_cloud, read_labelled, read_painted, write_csv, write_painted, write_ply
from fabctl.scan.colours import colours_of, span_mm
from fabctl.scan.decide import Datums
from fabctl.scan.deviation import Deviation, Statistics, Uncertainty, bootstrap, deviate, statistics
from fabctl.scan.judge import Judged
from fabctl.scan.markers import Scale, scale_from_board
from fabctl.scan.metric import scale_from_bars, scale_from_shots
from fabctl.scan.modes import Mode, aligned_by
from fabctl.scan.paint import Paint, paint_of, read_paint
from fabctl.scan.painted import marks_on_table
from fabctl.scan.refine import Options, refine
from fabctl.scan.register import FINAL_POINTS, Registration, Task, register
from fabctl.scan.symmetry import Symmetries, find_symmetries
from fabctl.scan.target import Target
from fabctl.vision.boards import MarkSheet

Floats = NDArray[np.float64]
ScaleChoice = Literal["free", "known", "markers"]
Verdict = Literal["pass", "fail", "no tolerance given", "undecided"]

PAINTED = 60_000  # points kept with their own colours, for later scans of the same specimen
SHARE_WITHIN_FRAC = 0.95  # of the compared area must lie within the tolerance


@dataclass(frozen=True, slots=True)
class Request:
    """What to compare, and how."""

    cloud: Path
    target: Path
    predicted: Path | None = None
    scale: ScaleChoice = "free"
    unit_mm: float = 1.0  # for a known scale
    markers: Path | None = None  # label,x,y,z in cloud units
    board: Path | None = None  # label,x,y,z in mm
    bars: Path | None = None  # two points in cloud units and their distance in mm, a line each
    model: Path | None = None  # folder of a COLMAP text model
    pictures: Path | None = None  # folder of the pictures it names
    marks: MarkSheet | None = None  # coded marks in these pictures
    datum_cloud: Path | None = None  # label,x,y,z in cloud units
    datum_target: Path | None = None  # label,x,y,z in mm, in the target's frame
    colours: Path | None = None  # coloured PLY in the target's frame; without it the target's own colours, if any
    mode: Mode = "best-fit"
    tolerance_frac: float | None = None
    seed: int = 0

    def files(self) -> list[Path]:
        """Return every file the comparison reads."""
        named = (
            self.cloud,
            self.target,
            self.predicted,
            self.markers,
            self.board,
            self.bars,
            *([self.model / "cameras.txt", self.model / "images.txt"] if self.model else []),
            self.datum_cloud,
            self.datum_target,
            self.colours,
        )
        return [path for path in named if path is not None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Everything that came out; deviation and statistics are None where there is no pose."""

    request: Request
    target: Target
    cloud: Cloud
    cleaned: Cleaned
    registration: Registration
    scale: Scale | None
    deviation: Deviation | None = None
    statistics: Statistics | None = None
    uncertainty: Uncertainty | None = None
    alternative_rms_mm: tuple[float, ...] = ()
    foreseen: Target | None = None  # the predicted deployed shape, where there is one
    predicted: Predicted | None = None
    verdict: Verdict = "undecided"
    findings: tuple[Finding, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """Return what the command line ends with."""
        if self.verdict == "undecided":
            return REFUSED
        return OUT_OF_TOLERANCE if self.verdict == "fail" else DONE


@dataclass(frozen=True, slots=True)
class Predicted:
    """The same scan against the shape the model foresaw: what it knew of the deviation and what it did not."""

    statistics: Statistics
    known_frac: float  # share of the mean square deviation from the target that the prediction explains


def read_target(path: Path) -> Target:
    """Return the target in the file; raises the errors of `design.meshfiles.read_mesh`."""
    from design.meshfiles import read_mesh

    if not path.is_file():
        raise UsageError(f"{path}: no such file")
    return Target(read_mesh(path)[0], path.name)


def compare(request: Request, emit: Emit = silent) -> Comparison:
    """Return the comparison that is asked for; the same files, options and seed give the same numbers."""
    target = read_target(request.target)
    foreseen = None if request.predicted is None else read_target(request.predicted)
    emit(Event("stage", f"reading {request.cloud}"))
    cloud = read_cloud(request.cloud, request.seed)
    paint = _paint(request, cloud)
    emit(Event("stage", f"cleaning {len(cloud.points)} points"))
    cleaned = clean(cloud.points, request.seed)
    scale = known_scale(request, cloud, cleaned)
    emit(Event("stage", "looking for the target's own symmetries"))
    symmetries = find_symmetries(target)
    task = Task(
        cloud.points,
        cleaned,
        target,
        symmetries,
        None if scale is None else scale.unit_mm,
        read_datums(request),
        cloud.colours,
        paint,
        request.seed,
        emit,
    )
    registration = register(task)
    registration = _by_mode(request.mode, task, registration)
    made = Comparison(request, target, cloud, cleaned, registration, scale, foreseen=foreseen)
    findings = [*cloud.findings, *(scale.findings if scale is not None else ()), *registration.findings]
    if registration.status not in ("aligned", "symmetric") or registration.best is None:
        return replace(made, findings=tuple(findings))
    emit(Event("stage", "measuring deviations"))
    return _measured(made, symmetries, findings, emit)


def _by_mode(mode: Mode, task: Task, found: Registration) -> Registration:
    """Return the registration with the pose that the alignment mode asks for."""
    if mode == "best-fit" or found.best is None or found.status not in ("aligned", "symmetric"):
        return found
    fit = aligned_by(mode, task, task.points[found.specimen], found.best.fit)
    return replace(found, best=replace(found.best, fit=fit))


def known_scale(request: Request, cloud: Cloud, cleaned: Cleaned) -> Scale | None:
    """Return the scale that is known beforehand, or None where geometry must find it.

    Without a file of markers the coded marks on the table are looked for in the cloud's own colours.
    """
    if request.scale == "known":
        return Scale(request.unit_mm, 0.0, 0)
    if request.scale == "free":
        return None
    if request.bars is not None:
        return scale_from_bars(request.bars)
    if request.model is not None and request.pictures is not None and request.marks is not None:
        return scale_from_shots(request.model, request.pictures, request.marks)
    if request.board is None:
        raise UsageError("--scale markers needs --board (as measured, mm), and --markers or a coloured cloud")
    if request.markers is not None:
        return scale_from_board(read_labelled(request.markers), read_labelled(request.board))
    if cloud.colours is None:
        raise UsageError("--scale markers without --markers needs a cloud with colours, to find the marks in it")
    return scale_from_board(marks_on_table(cloud.points, cloud.colours, cleaned), read_labelled(request.board))


def _paint(request: Request, cloud: Cloud) -> Paint | None:
    """Return what the specimen looks like: as the file asked for says, or the target's own colours, if it has any."""
    asked = None if request.colours is None else read_paint(request.colours)
    if asked is not None or cloud.colours is None:
        return asked
    if request.target.suffix.lower() != ".ply":
        return None
    points, colours = read_painted(request.target)
    return None if colours is None else paint_of(points, colours)


def read_datums(request: Request) -> Datums | None:
    """Return the datum points that both files name, or None where none are given."""
    if request.datum_cloud is None and request.datum_target is None:
        return None
    if request.datum_cloud is None or request.datum_target is None:
        raise UsageError("datum points need both their places in the scan and on the target")
    seen, meant = read_labelled(request.datum_cloud), read_labelled(request.datum_target)
    labels = tuple(sorted(set(seen) & set(meant)))
    if len(labels) < 3:
        raise UsageError(f"three datum points or more must be named in both files; common are: {', '.join(labels)}")
    return Datums(labels, np.array([seen[k] for k in labels]), np.array([meant[k] for k in labels]))


def _measured(made: Comparison, symmetries: Symmetries, findings: list[Finding], emit: Emit) -> Comparison:
    registration, target, request = made.registration, made.target, made.request
    best = registration.best
    assert best is not None
    points = made.cloud.points[registration.specimen]
    deviation = deviate(points, best.pose, target)
    numbers = statistics(deviation, target)
    emit(Event("stage", "finding how sure they are"))
    spread = bootstrap(best.fit, target, request.seed, free_scale=made.scale is None, still=symmetries.still(target))
    some = points[:: max(1, len(points) // 60_000)]
    others = [statistics(deviate(some, a.pose, target), target) for a in registration.alternatives]
    verdicts = {_verdict(s, request.tolerance_frac) for s in (numbers, *others)}
    verdict: Verdict = _verdict(numbers, request.tolerance_frac)
    if len(verdicts) > 1:
        verdict = "undecided"
        findings.append(
            Finding(
                "SCAN-VERDICT",
                "symmetric poses lead to different verdicts, so there is none",
                hint="give datum points (--datum)",
            )
        )
    return replace(
        made,
        deviation=deviation,
        statistics=numbers,
        uncertainty=spread,
        alternative_rms_mm=tuple(s.rms_mm for s in others),
        predicted=_against_predicted(made, best, points, numbers),
        verdict=verdict,
        findings=tuple(findings),
    )


def _verdict(numbers: Statistics, tolerance_frac: float | None) -> Verdict:
    if tolerance_frac is None:
        return "no tolerance given"
    return "pass" if numbers.within(tolerance_frac) >= SHARE_WITHIN_FRAC else "fail"


def _against_predicted(made: Comparison, best: Judged, points: Floats, numbers: Statistics) -> Predicted | None:
    """Return the comparison with the predicted shape, aligned to it from the pose on the target."""
    shape = made.foreseen
    if shape is None:
        return None
    options = Options(free_scale=made.scale is None)
    fit = refine(points[:: max(1, len(points) // FINAL_POINTS)], best.pose, shape, options)
    found = statistics(deviate(points, fit.pose, shape), shape)
    known = 1.0 - (found.rms_mm / numbers.rms_mm) ** 2 if numbers.rms_mm > 0 else 0.0
    return Predicted(found, known)


def result(made: Comparison) -> dict[str, Any]:
    """Return the numbers as plain JSON, lengths with their unit in the key."""
    registration, size = made.registration, made.target.diagonal_mm
    body: dict[str, Any] = {
        "verdict": made.verdict,
        "status": registration.status,
        "decided_by": registration.decided_by,
        "mode": made.request.mode,
        "tolerance_frac": made.request.tolerance_frac,
        "share_within_required_frac": SHARE_WITHIN_FRAC,
        "target": {"name": made.target.name, "diagonal_mm": size, "symmetries": registration.symmetries.describe()},
        "cloud": cloud_facts(made),
        "findings": [finding.as_dict() for finding in made.findings],
    }
    if registration.best is not None:
        body["pose"] = _pose_facts(registration.best, made)
        body["alternatives"] = [
            {**_pose_facts(a, made), "ratio": a.score_frac / registration.best.score_frac, "deviation_rms_mm": rms}
            for a, rms in zip(
                registration.alternatives,
                made.alternative_rms_mm or (None,) * len(registration.alternatives),
                strict=True,
            )
        ]
    if made.statistics is not None:
        body["deviation"] = statistics_facts(made.statistics)
        if made.request.tolerance_frac is not None:
            body["within_tolerance_frac"] = made.statistics.within(made.request.tolerance_frac)
    if made.uncertainty is not None:
        body["uncertainty"] = {k: _finite(v) for k, v in asdict(made.uncertainty).items()}
    if made.scale is not None:
        body["scale"] = {**asdict(made.scale), "findings": [finding.as_dict() for finding in made.scale.findings]}
        body["scale"]["sigma_frac"] = _finite(made.scale.sigma_frac)
    if made.predicted is not None:
        body["against_predicted"] = {
            **statistics_facts(made.predicted.statistics),
            "known_frac": made.predicted.known_frac,
        }
    return body


def cloud_facts(made: Comparison) -> dict[str, Any]:
    """Return how many points the cloud has and what became of them."""
    of = made.cleaned.cells.of_point
    inside = of >= 0
    sparse = np.zeros(len(of), dtype=bool)
    sparse[inside] = made.cleaned.sparse[of[inside]]
    specimen, table = made.registration.specimen, made.cleaned.is_table & ~made.registration.specimen
    sparse &= ~specimen & ~table
    return {
        "points_count": len(of),
        "specimen_count": int(specimen.sum()),
        "table_count": int(table.sum()),
        "stray_count": int(sparse.sum()),
        "background_count": int((~specimen & ~table & ~sparse).sum()),
        "part": None if made.registration.part is None else made.registration.part.name,
        "has_table": made.cleaned.table is not None,
        "cell_cu": made.cleaned.cells.size_cu,
    }


def _pose_facts(judged: Judged, made: Comparison) -> dict[str, Any]:
    return {
        "matrix": judged.pose.matrix(),
        "unit_mm": judged.pose.scale_ratio,
        "misfit_frac": judged.score_frac,
        "cloud_rms_frac": judged.cloud_rms_frac,
        "target_rms_frac": judged.target_rms_frac,
        "coverage_frac": judged.coverage_frac,
        "explained_frac": judged.explained_frac,
        "relation": judged.relation,
        "steps_count": judged.fit.steps_count,
        "last_step_frac": _finite(judged.fit.last_step_frac),
        "patch_sigma_frac": judged.fit.patch_sigma_frac,
        "patches_left_out_frac": float((judged.fit.weight < 0.1).mean()) if len(judged.fit.weight) else 0.0,
    }


def statistics_facts(numbers: Statistics) -> dict[str, Any]:
    """Return the statistics with every length also as a fraction of the diagonal."""
    body: dict[str, Any] = {}
    facts: Mapping[str, Any] = asdict(numbers)
    for key, value in facts.items():
        if key == "abs_quantiles_mm":
            continue
        body[key] = value
        if key.endswith("_mm") and isinstance(value, float) and key != "diagonal_mm":
            body[key.removesuffix("_mm") + "_frac"] = numbers.frac(value)
    return body


def _finite(value: Any) -> Any:
    return value if not isinstance(value, float) or math.isfinite(value) else None


def record(run: RunFolder, made: Comparison) -> dict[str, Any]:
    """Write result, CSV, coloured PLY, map and pictures into the run folder; return the result."""
    from fabctl.scan.pictures import cleaning_picture, kinds

    body = result(made)
    up = None if made.cleaned.table is None else made.cleaned.table.normal
    cleaning_picture(made.cloud.points, kinds(made.cleaned, made.registration.specimen), up).save(
        run.artefact("cleaning.png")
    )
    if made.deviation is not None:
        body["colour_span_mm"] = _record_deviation(run, made, made.deviation)
    run.write_result(body)
    return body


def _record_deviation(run: RunFolder, made: Comparison, found: Deviation) -> float:
    """Write points, map and pictures of the deviation; return the span of their colours."""
    from fabctl.scan.pictures import SIDES, histogram_svg, map_picture, write_bar

    span, mesh, size = span_mm(found), made.target.mesh, made.target.diagonal_mm
    write_csv(run.artefact("deviation.csv"), found.points_mm, found.value_mm, found.area_weight, found.counts)
    write_ply(run.artefact("deviation.ply"), found.points_mm, found.value_mm, colours_of(found.value_mm, span))
    if made.cloud.colours is not None:
        chosen = np.flatnonzero(made.registration.specimen)[:: max(1, int(made.registration.specimen.sum()) // PAINTED)]
        best = made.registration.best
        assert best is not None
        write_painted(run.artefact("colours.ply"), best.pose(made.cloud.points[chosen]), made.cloud.colours[chosen])
    np.savez_compressed(
        run.artefact("map.npz"), vertices_mm=mesh.vertices_mm, faces=mesh.faces, deviation_mm=found.vertex_mm
    )
    for side in SIDES:
        map_picture(mesh, found.vertex_mm, span, side).save(run.artefact(f"map-{side}.png"))
    text = histogram_svg(found, span, size, made.request.tolerance_frac)
    run.artefact("histogram.svg").write_text(text, encoding="utf-8")
    write_bar(run.artefact("bar.svg"), span, size)
    return span
