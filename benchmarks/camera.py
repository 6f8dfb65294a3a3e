"""What the camera measures, against simulated pictures whose truth is known.

`python -m benchmarks camera [--quick] [PART | PART=N …]`; `--quick` takes a tenth of the pictures, N says how many:
`bed` cameras, `kerf` coupons, `inspection` sheets, `scale` scans, pictures with `nothing`, `ids`; and `refusals`.
Each part's figures go to the error stream as soon as it ends, and a part
that breaks off is one missed figure, so that none costs another its figures. Nothing here is fitted to the truth: each
figure runs the product's own path from pictures to millimetres, the lens calibration included.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import Figure
from benchmarks._camera_pictures import Condition, draw_id, no_marker, photograph, photograph_coupon, trace_of
from design.pattern.paths import CutPath
from drivers.camera import snapshot
from drivers.errors import DeviceError
from fabctl.errors import RefusedError
from fabctl.vision import boards
from fabctl.vision.align import Alignment, align
from fabctl.vision.coupon import make_coupon
from fabctl.vision.ids import read_ids
from fabctl.vision.inspect import inspect
from fabctl.vision.kerf import measure as measure_kerf
from fabctl.vision.lens import Lens, calibrate, find_board
from fabctl.vision.markers import find_markers
from fabctl.vision.register import apply, register
from fabctl.vision.scale import ShotPose, scale_by_shots
from simulators.camera import scene as scenes
from simulators.camera.burn import kerf_mm, to_machine
from simulators.camera.optics import View, compose, develop, flat_layer, view_of
from simulators.camera.picture import Studio

WHEN = "2026-11-22T00:00:00+00:00"
F64 = NDArray[np.float64]
Picture = NDArray[np.uint8]
BOARD = boards.Charuco("lens", 10, 7, 20.0, 15.0)
BED = boards.bed_marks((300.0, 200.0))
SHEET_MARKS = boards.registration_marks((150.0, 100.0))
THICKNESS_MM = 2.3


def measure(words: list[str]) -> list[Figure]:
    """Return every figure of the camera, or of the named parts."""
    parts: dict[str, tuple[Callable[[int], list[Figure]], int]] = {
        "bed": (_bed, 5),
        "kerf": (_kerf, 4),
        "inspection": (_inspection, 3),
        "scale": (_scale, 5),
        "nothing": (_nothing, 1000),
        "ids": (_ids, 1000),
        "refusals": (_refusals, 1),
    }
    quick = "--quick" in words
    asked = [word.partition("=") for word in words if word != "--quick"] or [(name, "", "") for name in parts]
    if wrong := [name for name, _, n in asked if name not in parts or not (n or "1").isdigit() or n == "0"]:
        raise SystemExit(f"no such part: {', '.join(wrong)}; PART or PART=N of {', '.join(parts)}, and --quick")
    figures = []
    for name, _, n in asked:
        run, usual = parts[name]
        figures += _told(name, run, int(n) if n else max(usual // 10, 1) if quick else usual)
    return figures


def _told(name: str, part: Callable[[int], list[Figure]], count: int) -> list[Figure]:
    """Return a part's figures, or the one that says why there are none; tell them on the error stream as well."""
    began_s = time.process_time()
    try:
        figures = part(count)
    except (RefusedError, DeviceError) as fault:
        figures = [Figure(f"{name}: broken off", str(fault), "", "no refusal", False, 0)]
    took = f"{name}, {time.process_time() - began_s:.0f} s of processor"
    for figure in figures:
        print(f"[{took}] {figure.name}: {figure.value} {figure.unit} n={figure.n} met={figure.met}", file=sys.stderr)
    return figures


def _camera(seed: int) -> scenes.Camera:
    rng = np.random.default_rng([seed, 1])
    return scenes.Camera(
        distortion_ratio=(float(rng.uniform(-0.22, 0.08)), float(rng.uniform(-0.03, 0.06)), 0.0006, -0.0005, 0.0),
        tilt_rad=float(rng.uniform(0.0, 0.12)),
        tilt_to_rad=float(rng.uniform(0, 6)),
        turn_rad=float(rng.uniform(-0.05, 0.05)),
        blur_px=float(rng.uniform(0.7, 1.3)),
        slope_frac=0.3,
    )


def _bed(cameras: int) -> list[Figure]:
    grid = np.stack(np.meshgrid(np.linspace(0, 300, 31), np.linspace(0, 200, 21)), axis=-1).reshape(-1, 2)
    errors, sheet_errors, told, truths = [], [], [], []
    for seed in range(cameras):
        camera = _camera(seed)
        glass = _lens(camera, seed)
        for k in range(2):
            rng = np.random.default_rng([seed, k])
            pose = scenes.Pose(0.0, 100 + rng.uniform(-40, 20), 30 + rng.uniform(-10, 20), rng.uniform(-0.2, 0.3))
            pose = replace(
                pose, stretch_x_ratio=1 + rng.uniform(-0.01, 0.01), stretch_y_ratio=1 + rng.uniform(-0.01, 0.01)
            )
            sheet = scenes.Sheet(SHEET_MARKS.size_mm, (pose,), _marks(SHEET_MARKS), thickness_mm=THICKNESS_MM)
            weather = replace(camera, glare_count=k, dust_count=40 * k, smoke_frac=0.2 * k)
            studio = Studio(scenes.Scene(camera=weather, sheet=sheet, seed=10 * seed + k))
            picture = studio.frame()
            made = align(picture, "bed", BED, glass, WHEN)
            seen = studio.view.project(np.column_stack([grid, np.zeros(len(grid))]))
            errors.append(np.linalg.norm(made.to_machine(seen) - grid, axis=1))
            told.append(made.rms_mm)
            truths.append(_rms(errors[-1]))
            sheet_errors.append(_sheet_error(picture, made, pose))
    everything = np.concatenate(errors)
    n = len(errors)
    where = "over 300 x 200 mm at 0.15 mm/px with distortion, blur and uneven light"
    return [
        _most("bed alignment, rms", _rms(everything), "mm", 0.1, f"<= 0.1 mm rms {where}", n),
        _most("bed alignment, worst", float(everything.max()), "mm", 0.3, f"<= 0.3 mm at worst {where}", n),
        Figure("bed alignment, told over true rms", round(float(np.mean(np.array(told) / truths)), 2), "", "", None, n),
        _most("print and cut, worst over the sheet", max(sheet_errors), "mm", 0.15, "<= 0.15 mm", n),
    ]


def _lens(camera: scenes.Camera, seed: int) -> Lens:
    held = scenes.Charuco(BOARD.columns_count, BOARD.rows_count, BOARD.square_mm, BOARD.marker_mm)
    studio = Studio(scenes.Scene(camera=camera, charuco=held, seed=seed))
    views = [find_board(studio.frame(k), BOARD, str(k))[0] for k in range(12)]
    return calibrate([view for view in views if view], camera.size_px, BOARD, WHEN).lens


def _marks(sheet: boards.MarkSheet) -> tuple[scenes.Mark, ...]:
    return tuple(scenes.Mark(m.id, m.x_mm, m.y_mm, m.side_mm) for m in sheet.marks)


def _sheet_error(picture: Picture, alignment: Alignment, pose: scenes.Pose) -> float:
    made = register(picture, "bed", SHEET_MARKS, alignment, THICKNESS_MM, WHEN)
    places = np.stack(np.meshgrid(np.linspace(0, 150, 11), np.linspace(0, 100, 9)), axis=-1).reshape(-1, 2)
    true = to_machine(places, pose, SHEET_MARKS.size_mm)
    return float(np.linalg.norm(apply(made.affine, places) - true, axis=1).max())


def _kerf(coupons: int) -> list[Figure]:
    coupon = make_coupon([0.5, 0.6, 0.75], 25.0)
    errors, covered, front, refused = [], [], [], []
    for seed in range(coupons):
        rng = np.random.default_rng([seed, 3])
        radii = rng.uniform(0.085, 0.12, 2)
        beam = scenes.Beam(float(radii[0]), float(radii[1]), char_at_ratio=float(rng.choice([0.1, 0.2, 0.3])))
        for over_light in (True, False):
            try:
                found = measure_kerf(photograph_coupon(coupon, beam, over_light, seed), "coupon", coupon)
            except RefusedError as fault:
                refused.append(f"coupon {seed}: {fault}")
                continue
            for width in found.widths:
                true = kerf_mm(width.power_frac / 25.0, 0.0 if width.axis == "x" else math.pi / 2, beam)
                error = width.kerf_mm - true
                if over_light:
                    errors.append(error)
                    covered.append(abs(error) <= width.uncertainty_mm)
                else:
                    front.append(error)
    n = len(errors)
    share = round(100 * float(np.mean(covered)), 1)
    return [
        Figure("kerf: pictures refused", "; ".join(refused) or 0, "", "0", not refused, 2 * coupons),
        _most(
            "kerf over a light table, worst error",
            float(np.abs(errors).max()),
            "mm",
            0.01,
            "± 0.01 mm at <= 0.05 mm/px",
            n,
        ),
        Figure("kerf, errors within the stated uncertainty", share, "%", ">= 95 % (k = 2)", share >= 95, n),
        Figure(
            "kerf lit from the front (refused for cutting), worst",
            round(float(np.abs(front).max()), 4),
            "mm",
            "",
            None,
            n,
        ),
    ]


def _inspection(sheets: int) -> list[Figure]:
    wrong, total, offsets = 0, 0, []
    for seed in range(sheets):
        rng = np.random.default_rng([seed, 4])
        job = [_slit(c, r, rng) for r in range(9) for c in range(14)]
        states = rng.choice(["cut", "missing", "not_through", "displaced"], len(job), p=[0.85, 0.05, 0.05, 0.05])
        strokes = [
            (
                replace(path, points_mm=path.points_mm + (_aside(path) * 0.35 if state == "displaced" else 0.0)),
                power,
                25.0,
            )
            for path, state in zip(job, states, strict=True)
            if state != "missing"
            for power in [0.25 if state == "not_through" else 0.6]
        ]
        camera = replace(_camera(seed), size_px=(1000, 700), looks_at_mm=(70.0, 48.0))
        sheet = scenes.Sheet((140.0, 96.0), thickness_mm=THICKNESS_MM)
        studio = Studio(scenes.Scene(camera=camera, bed=scenes.Bed((140.0, 96.0)), sheet=sheet, seed=seed))
        picture = studio.frame(0, trace_of(strokes))

        def to_pixels(points_mm: F64, view: View = studio.view) -> F64:
            return view.project(np.column_stack([points_mm, np.full(len(points_mm), THICKNESS_MM)]))

        found = inspect(picture, job, to_pixels, 0.15)
        wrong += sum(path.state != state for path, state in zip(found.paths, states, strict=True))
        total += len(job)
        offsets += [p.offset_mm for p, s in zip(found.paths, states, strict=True) if s == "displaced" and p.offset_mm]
    error = float(np.abs(np.array(offsets) - 0.35).max())
    return [
        Figure(
            "inspection: slits judged wrongly",
            wrong,
            "",
            "0 (missing, not through, displaced by 0.35 mm)",
            wrong == 0,
            total,
        ),
        Figure("inspection: worst error of a displacement", round(error, 3), "mm", "", None, len(offsets)),
    ]


def _slit(column: int, row: int, rng: np.random.Generator) -> CutPath:
    middle = np.array([8.0 + 9.5 * column, 8.0 + 10 * row])
    angle = rng.choice([0.1, math.pi / 3 + 0.1, 2 * math.pi / 3 + 0.1])
    arm = 3.5 * np.array([math.cos(angle), math.sin(angle)])
    return CutPath("slit", np.array([middle - arm, middle + arm]))


def _aside(path: CutPath) -> F64:
    along = path.points_mm[1] - path.points_mm[0]
    return np.array([-along[1], along[0]]) / float(np.linalg.norm(along))


def _scale(scans: int) -> list[Figure]:
    errors, covered = [], []
    for seed in range(scans):
        made = scale_by_shots(_shots(seed), boards.scale_marks((300.0, 200.0)))
        errors.append(made.mm_per_unit_ratio / UNIT_MM - 1)
        covered.append(abs(errors[-1]) <= made.uncertainty_ratio)
    note = "<= 0.02 % (12 pictures, poses as a bundle adjustment leaves them)"
    told = f">= 90 % (k = 2: 95 %, less what {scans} scans leave open)"
    return [
        _most("scan scale by marks, worst error", 100 * float(np.abs(errors).max()), "%", 0.02, note, scans),
        Figure(
            "scan scale, errors within the stated uncertainty",
            round(100 * sum(covered) / scans, 1),
            "%",
            told,
            sum(covered) >= 0.9 * scans,
            scans,
        ),
    ]


UNIT_MM = 37.0  # of the scan's own unit
POSE_NOISE_RAD = 5e-5  # a tenth of a pixel at 1800 px focal length


def _shots(seed: int) -> list[tuple[ShotPose, dict[int, F64]]]:
    """Return twelve rendered pictures around a sheet of marks, markers found in them, poses in a frame of UNIT_MM."""
    marks = boards.scale_marks((300.0, 200.0))
    bed = scenes.Bed((300.0, 200.0), marks=_marks(marks))
    camera = scenes.Camera(size_px=(1600, 1200), focal_px=1800.0, mm_per_px=0.25, blur_px=1.0)
    studio = Studio(scenes.Scene(camera=camera, bed=bed, seed=seed, texel_mm=0.1))
    from simulators.camera.optics import bed_texture

    texture = bed_texture(studio.scene, 0.1)
    shots = []
    for k in range(12):
        rng = np.random.default_rng([seed, 5, k])
        view = view_of(replace(camera, tilt_rad=0.6, tilt_to_rad=k * math.pi / 6, turn_rad=float(rng.uniform(-1, 1))))
        picture = develop(compose(view, camera.size_px, [flat_layer(view, texture, 0.1, 0.0)]), camera, rng)
        wobble = cv2.Rodrigues(rng.normal(0, POSE_NOISE_RAD, 3))[0]
        # X_mm = UNIT_MM X: in front of the lens the whole scene shrinks, directions stay.
        pose = ShotPose(view.K, view.distortion[:4], wobble @ view.R, wobble @ view.t_mm / UNIT_MM)
        shots.append((pose, {m.id: m.centre_px for m in find_markers(picture) if marks.mark(m.id)}))
    return shots


def _nothing(count: int) -> list[Figure]:
    rng = np.random.default_rng(26)
    marks = ids = 0
    for k in range(count):
        picture = no_marker(k, rng)
        marks += len(find_markers(picture)) > 0
        ids += len(read_ids(picture, upscale=1)) > 0
    return [
        Figure("pictures without a marker in which one is found", marks, "", "0 of 1,000", marks == 0, count),
        Figure("pictures without an id in which one is read", ids, "", "0 of 1,000", ids == 0, count),
    ]


def _ids(count: int) -> list[Figure]:
    rng = np.random.default_rng(27)

    def inside() -> Condition:
        return Condition(
            rng.uniform(3, 6),
            rng.uniform(0.5, 1.5),
            rng.uniform(0, math.pi / 4),
            rng.uniform(0.3, 0.9),
            *rng.uniform(0, 6, 2),
        )

    def corner() -> Condition:
        return Condition(3.0, 1.5, math.pi / 4, 0.3, *rng.uniform(0, 6, 2))

    def corner_as_seen() -> Condition:
        return replace(corner(), module_px=3.0 * math.sqrt(2))

    limits = ">= 99 % with a module of >= 3 px, blur <= 1.5 px, tilt <= 45°, contrast >= 30 %"
    rows = (
        ("ids read, conditions drawn evenly", inside, limits, count),
        ("ids read, all at the limit, module 3 px as seen in the picture", corner_as_seen, limits, count // 2 or 1),
        ("ids read, all at the limit, module 3 px before the tilt", corner, limits, count // 2 or 1),
    )
    return [figure for name, draw, target, n in rows for figure in _read_share(name, draw, target, n, rng)]


def _read_share(
    name: str, draw: Callable[[], Condition], target: str, count: int, rng: np.random.Generator
) -> list[Figure]:
    good = wrong = 0
    for _ in range(count):
        specimen = f"S-{int(rng.integers(0, 15000)):04d}"
        found = [engraved.specimen for engraved in read_ids(photograph(draw_id(specimen), draw(), rng))]
        good += found == [specimen]
        wrong += any(other != specimen for other in found)
    share = round(100 * good / count, 2)
    return [
        Figure(name, share, "%", target, share >= 99 if target else None, count),
        Figure(f"{name}: read wrongly", wrong, "", "0", wrong == 0, count),
    ]


def _refusals(_: int) -> list[Figure]:
    camera = scenes.Camera(size_px=(1050, 725), mm_per_px=0.3, focal_px=1100.0)
    glass = _lens(camera, 1)
    scene = scenes.Scene(camera=camera)
    picture = Studio(scene).frame()
    made = align(picture, "bed", BED, glass, WHEN)
    half = picture.copy()
    half[:, 400:] = 90
    larger = replace(BED, marks=tuple(replace(m, side_mm=13.0) for m in BED.marks))
    burnt = Studio(replace(scene, camera=replace(camera, exposure_ratio=8.0))).frame()
    attempts: dict[str, Callable[[], object]] = {
        "wrong board": lambda: align(picture, "bed", SHEET_MARKS, glass, WHEN),
        "wrong size": lambda: align(picture, "bed", larger, glass, WHEN),
        "too few markers": lambda: align(half, "bed", BED, glass, WHEN),
        "saturated": lambda: align(burnt, "bed", BED, glass, WHEN),
        "empty": lambda: align(np.zeros_like(picture), "bed", BED, glass, WHEN),
        "no sheet": lambda: register(picture, "bed", SHEET_MARKS, made, THICKNESS_MM, WHEN),
        "unplugged": lambda: snapshot("/dev/video77"),
    }
    refused = sum(_refuses(attempt) for attempt in attempts.values())
    text = f"all: {', '.join(attempts)}"
    return [
        Figure(
            "refused with a clear message",
            refused,
            f"of {len(attempts)}",
            text,
            refused == len(attempts),
            len(attempts),
        )
    ]


def _refuses(attempt: Callable[[], object]) -> bool:
    try:
        attempt()
    except (RefusedError, DeviceError) as fault:
        return len(str(fault)) > 20
    return False


def _rms(values: F64) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _most(name: str, value: float, unit: str, limit: float, target: str, n: int) -> Figure:
    return Figure(name, round(value, 5), unit, target, value <= limit, n)
