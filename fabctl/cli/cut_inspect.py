"""`fabctl cut inspect`: compare the bed picture after a cut with the design."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fabctl.cli.common import bench_option, json_option, lab, show
from fabctl.cli.paths import SPECIMEN, InFile, PhotoFile

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from drivers.camera import Frame
    from fabctl.records.folder import RunFolder


@click.command("inspect")
@click.argument("specimen", type=SPECIMEN)
@click.option(
    "--thickness-mm", type=click.FloatRange(0, 100), default=None, help="The sheet's; its material's when not given."
)
@click.option("--registration", type=InFile(), help="Where the sheet lies now, if it was moved since the cut.")
@click.option(
    "-o", "--output", type=PhotoFile(), default=Path("inspection.png"), show_default=True, help="Annotated picture."
)
@click.option("--image", type=InFile(), help="A picture of the bed, instead of the bench's camera.")
@bench_option
@json_option
def inspect_command(
    specimen: str,
    thickness_mm: float | None,
    registration: Path | None,
    output: Path,
    image: Path | None,
    bench_name: str,
    as_json: bool,
) -> None:
    """Look at SPECIMEN on the bed after its cut: slits missing, not through, displaced. Exit code 6 if any is."""
    import numpy as np

    from fabctl.cli.camera import bed_picture, bench_and_state, read_paths
    from fabctl.errors import DONE, OUT_OF_TOLERANCE
    from fabctl.vision import inspect as inspecting
    from fabctl.vision.bed import checked_alignment
    from fabctl.vision.overlay import inspection_on_bed, write_picture
    from fabctl.vision.register import apply, read_registration

    place = lab().specimen(specimen)
    run = _last_cut(specimen)
    affine = read_registration(registration).affine if registration else _placement(run)
    height_mm = _thickness(run) if thickness_mm is None else thickness_mm
    paths = read_paths(place.design / "paths.json")
    frame = bed_picture(bench_name, image)
    _refuse_older(frame, run)
    alignment, doubts = checked_alignment(bench_and_state(bench_name)[1], frame)

    def to_pixels(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return alignment.to_pixels(apply(affine, points_mm), height_mm)

    middle = apply(affine, np.vstack([path.points_mm for path in paths]).mean(axis=0)[None])[0]
    found = inspecting.inspect(frame.image, paths, to_pixels, alignment.mm_per_px(middle))
    findings = [*doubts, *inspecting.inspection_findings(found)]
    write_picture(str(output), inspection_on_bed(frame.image, paths, found, to_pixels))
    states = [path.state for path in found.paths]
    counts = {state: states.count(state) for state in ("cut", "missing", "not_through", "displaced", "unseen")}
    faulty = [
        {"path": p.index, "cell": p.cell, "state": p.state, "dark_ratio": p.dark_ratio, "offset_mm": p.offset_mm}
        for p in found.faulty()
    ]
    data = {
        "specimen": specimen,
        "run": run.run_id,
        "picture": str(output),
        "paths_count": counts,
        "faulty": faulty,
        "shift_mm": list(found.shift_mm),
        "findings": [finding.as_dict() for finding in findings],
    }
    text = ", ".join(f"{count} {state.replace('_', ' ')}" for state, count in counts.items() if count)
    bad = any(finding.level == "error" for finding in findings)
    lines = [f"{specimen}: {text}", f"{output}: what was seen", *map(str, findings)]
    show(data, as_json, lines, OUT_OF_TOLERANCE if bad else DONE, f"{specimen} is not cut as designed: {text}")


def _refuse_older(frame: Frame, run: RunFolder) -> None:
    """Raise `RefusedError` where the picture was taken before the cut had ended: it shows another state."""
    from datetime import datetime, timedelta

    from design.findings import Finding
    from fabctl.errors import RefusedError

    ended = (run.outcome() or {}).get("finished_utc")
    grace = timedelta(seconds=1)  # file systems keep time coarsely
    if ended is None or datetime.fromisoformat(frame.taken_utc) + grace >= datetime.fromisoformat(ended):
        return
    text = f"the picture is of {frame.taken_utc[:19]}, the cut ended {ended[:19]} (UTC)"
    found = Finding("PICTURE-OLD", text, where=frame.source, hint="take a picture of the bed after the cut")
    raise RefusedError("this picture does not show the cut", [found])


def _last_cut(specimen: str) -> RunFolder:
    from fabctl.errors import UsageError

    runs = lab().runs_of(specimen, "cut")
    if not runs:
        raise UsageError(f"{specimen} was never cut here, so where its slits ought to be is not known")
    return runs[-1]


def _placement(run: RunFolder) -> NDArray[np.float64]:
    import numpy as np

    from fabctl.errors import RecordError

    rows = np.array(run.manifest()["config"].get("placement", []), dtype=np.float64)
    if rows.shape != (2, 3):
        raise RecordError(f"{run.path}: the run does not say where the sheet lay")
    return rows


def _thickness(run: RunFolder) -> float:
    from fabctl.errors import UsageError

    material = run.manifest()["config"].get("material") or {}
    if "thickness_mm" not in material:
        raise UsageError(f"{run.path}: the run names no thickness; give --thickness-mm")
    return float(material["thickness_mm"])
