"""`fabctl specimen`: the sheets that were cut, facts about them, and reading an engraved id."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import json_option, lab, show
from fabctl.cli.paths import SPECIMEN, InFile

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from design.findings import Finding
    from fabctl.workspace import Specimen


@click.group("specimen")
def command() -> None:
    """List specimens, note facts, read an engraved id."""


@command.command("list")
@json_option
def list_specimens(as_json: bool) -> None:
    """List the specimens with the runs of each."""
    place = lab()
    names = sorted(p.parent.name for p in place.specimens.glob("S-*/specimen.json"))
    runs = place.all_runs()
    kinds = {name: [r.manifest()["kind"] for r in runs if r.manifest().get("specimen") == name] for name in names}
    rows = [{**_record_or_fault(place.specimen(name)), "runs": kinds[name]} for name in names]
    lines = [f"{row['id']}  {row['made_utc'][:16]}  {', '.join(row['runs']) or 'no runs'}" for row in rows]
    show({"specimens": rows}, as_json, lines or ["no specimens yet; `fabctl cut run` gives the first id"])


def _record_or_fault(specimen: Specimen) -> dict[str, Any]:
    from fabctl.errors import RecordError

    try:
        return specimen.record()
    except RecordError as fault:  # one damaged record must not hide the others
        return {"id": specimen.name, "made_utc": "broken", "fault": str(fault)}


@command.command("show")
@click.argument("name", type=SPECIMEN)
@json_option
def show_specimen(name: str, as_json: bool) -> None:
    """Show what is written about a specimen, and its runs."""
    from fabctl.records.folder import status_of

    place = lab()
    record = place.specimen(name).record()
    runs = [{"run": r.run_id, "status": status_of(r)} for r in place.runs_of(name)]
    lines = [f"{key}: {value}" for key, value in record.items()] + [f"{r['run']}: {r['status']}" for r in runs]
    show({**record, "runs": runs}, as_json, lines)


@command.command("note")
@click.argument("name", type=SPECIMEN)
@click.argument("facts", nargs=-1, required=True, metavar="KEY=VALUE…")
@click.option("--free", is_flag=True, help="Allow other keys than the known ones; no run or report reads them.")
@json_option
def note(name: str, facts: tuple[str, ...], free: bool, as_json: bool) -> None:
    """Write facts about a specimen: thickness_mm=2.31 batch=B7.

    Known facts are thickness_mm, batch, rest_h, deployed_utc and remark.
    """
    from fabctl.notes import read_notes

    specimen, noted = lab().specimen(name), read_notes(facts, free)
    specimen.note(**noted)
    show(specimen.record(), as_json, [f"{name}: noted {', '.join(noted)}"])


def _why_no_id(image: NDArray[np.uint8], path: Path) -> Finding:
    """Return why the picture shows no id: a mirrored one, or none at all."""
    from design.findings import Finding
    from fabctl.vision.ids import read_ids

    turned = read_ids(image[:, ::-1].copy())
    if turned:
        text = f"{turned[0].specimen} is seen in a mirror: the picture, or the specimen, is the other way round"
        return Finding("ID-MIRRORED", text, where=str(path), hint="photograph the engraved side, without mirroring")
    hint = "nearer (3 px a module at least), sharper, less tilted, no glare"
    return Finding("ID-NONE", "no specimen id in the picture", where=str(path), hint=hint)


@command.command("read")
@click.argument("image", type=InFile())
@json_option
def read(image: Path, as_json: bool) -> None:
    """Read the engraved ids in a picture, and say which runs they have."""
    from design.findings import errors
    from fabctl.errors import RefusedError
    from fabctl.files import picture_of
    from fabctl.vision.ids import read_ids
    from fabctl.vision.quality import picture_findings

    frame = picture_of(image)
    found = picture_findings(frame.image, frame.source)
    ids = [] if errors(found) else read_ids(frame.image)
    if not ids:
        reasons = found if errors(found) else [*found, _why_no_id(frame.image, image)]
        raise RefusedError(f"{image}: nothing to read", reasons)
    place = lab()
    rows = []
    for engraved in ids:
        known = (place.specimens / engraved.specimen / "specimen.json").is_file()
        runs = [run.run_id for run in place.runs_of(engraved.specimen)]
        corners = engraved.corners_px.round(2).tolist()
        rows.append(
            {"id": engraved.specimen, "kind": engraved.kind, "known": known, "runs": runs, "corners_px": corners}
        )
    lines = [f"{r['id']}  {len(r['runs'])} runs{'' if r['known'] else ' (no such specimen here)'}" for r in rows]
    show({"specimens": rows}, as_json, lines)
