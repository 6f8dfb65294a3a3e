"""The scan comparison as a part of a specimen's page, and as a page of its own; both read the run record alone."""

from __future__ import annotations

import html
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from design.surface import TriMesh
from fabctl.records.folder import RunFolder, status_of
from fabctl.records.words import is_simulated
from fabctl.reports.model import Fact, Figure, Provenance, Report, Step, Word, picture
from fabctl.reports.numbers import COVERAGE, clock, fact, percent, with_half
from fabctl.reports.view3d import script, view

TITLE = "Scan against target"
WORDS: dict[str, Word] = {"pass": "pass", "fail": "fail"}
STATUS = {
    "aligned": "one pose fits, and no other comes near it",
    "symmetric": "one pose fits, up to the target's own symmetry",
    "ambiguous": "several poses fit about as well: ambiguous",
    "failed": "no pose explains the cloud",
    "mirrored": "the cloud is the mirror image of the target",
}


def scan_step(run: RunFolder) -> Step:
    """Return the deviation part of a page: numbers, the view that turns, pictures, histogram."""
    body = run.result() or {}
    found, made_up = body.get("deviation"), bool(is_simulated(run.manifest()))
    if found is None:
        return Step(TITLE, status_of(run), sentence_of(body), (), _cleaning(run), _notes(body), made_up)
    figures = [_view(run, body, f"deviation-{run.run_id}")]
    figures += _pictures(run)
    return Step(TITLE, status_of(run), sentence_of(body), deviation_facts(body), tuple(figures), _notes(body), made_up)


def sentence_of(body: dict[str, Any]) -> str:
    """Return the comparison in one sentence."""
    found = body.get("deviation")
    if found is None:
        faults = [f["message"] for f in body.get("findings", []) if f["level"] == "error"]
        return "; ".join(faults) or "the comparison came to no result"
    text = (
        f"The scan is {found['rms_mm']:.2f} mm RMS ({percent(found['rms_frac'], 2)} of the diagonal) off its target; "
        f"95 % of the seen area lies within {found['p95_abs_mm']:.2f} mm."
    )
    model = body.get("against_predicted")
    if model:
        share = percent(model["rms_mm"] / found["diagonal_mm"], 2)  # of the target's diagonal, like all others
        text += f" Against the predicted shape it is {model['rms_mm']:.2f} mm ({share})."
    return text


def scan_report(run: RunFolder) -> Report:
    """Return the page of one comparison: verdict, deviation, alignment and its alternatives, cleaning, provenance."""
    body, manifest = run.result() or {}, run.manifest()
    found = body.get("deviation")
    verdict = str(body.get("verdict", "undecided"))
    word = WORDS.get(verdict, "incomplete")
    tolerance = body.get("tolerance_frac")
    reasons = [STATUS.get(str(body.get("status")), "")]
    if tolerance is not None and found is not None:
        share = body["within_tolerance_frac"]
        reasons.append(
            f"{percent(share)} of the compared area is within ± {percent(tolerance, 2)} of the diagonal; "
            f"{percent(body['share_within_required_frac'], 0)} is asked"
        )
    elif found is not None:
        reasons.append("no tolerance was given (`--tolerance-frac`), so nothing is passed or failed")
    reasons += [f["message"] for f in body.get("findings", []) if f["level"] != "info"]
    steps = [scan_step(run), _alignment_step(body)] + ([_cleaning_step(run, body)] if found is not None else [])
    return Report(
        title=f"Scan of {manifest.get('specimen') or body.get('target', {}).get('name', 'a target')}",
        subtitle=f"{run.run_id} · target {body.get('target', {}).get('name', '')}",
        word=word,
        sentence=sentence_of(body),
        reasons=tuple(r for r in reasons if r),
        key_facts=_key_facts(body),
        steps=tuple(steps),
        provenance=tuple(_provenance(run, manifest)),
        versions=tuple(Fact(k, str(v)) for k, v in manifest.get("versions", {}).items()),
        made=clock(datetime.now(UTC).isoformat()),
        head=script() if found is not None else "",
    )


def write_scan_report(run: RunFolder) -> Path:
    """Write the page into the run's artefacts; return its path."""
    from fabctl.reports.page import render

    path = run.artefact("report.html")
    path.write_text(render(scan_report(run)), encoding="utf-8")
    return path


def _half(body: dict[str, Any], key: str) -> float | None:
    """Return the half interval of a figure, about 95 %, from its standard deviation."""
    sigma = (body.get("uncertainty") or {}).get(key)
    return None if sigma is None else COVERAGE * float(sigma)


def deviation_facts(body: dict[str, Any]) -> tuple[Fact, ...]:
    """Return the table of a comparison; what has an uncertainty of its own is written to its digits."""
    found = body["deviation"]
    size = found["diagonal_mm"]
    place = ", ".join(f"{x:.1f}" for x in found["max_place_mm"])

    def length(label: str, value_mm: float, note: str = "", sign: str = "", half: float | None = None) -> Fact:
        told = with_half(value_mm, half, "mm", sign) if half else f"{value_mm:{sign}.2f} mm"
        of_it = f"{percent(value_mm / size, 2, sign)} of the diagonal"
        return Fact(label, told, "; ".join(filter(None, (of_it, note, "95 % interval" if half else ""))))

    rows = [
        length("mean", found["mean_mm"], "", "+", _half(body, "mean_mm")),
        length("mean absolute", found["mean_abs_mm"]),
        length("RMS", found["rms_mm"], "", "", _half(body, "rms_mm")),
        length("standard deviation", found["sigma_mm"]),
        *(
            length(f"{int(k[1:])} % of the area below", v, "", "+")
            for k, v in found["percentiles_mm"].items()
            if k in ("p01", "p05", "p50", "p95", "p99")
        ),
        length("largest patch mean", found["max_patch_mm"], "over an even patch", "+"),
        length("largest single point", found["max_mm"], f"at ({place}) mm", "+"),
        *(
            Fact(f"area within ± {percent(float(k), 2)} of the diagonal", percent(v))
            for k, v in found["within_frac"].items()
        ),
        Fact("target seen", percent(found["coverage_frac"]), "of its area"),
        Fact("points compared", f"{found['points_count']:,}"),
        Fact("left out", f"{found['border_count']:,} past the border, {found['lone_count']:,} wrong matches"),
        Fact("bounding-box diagonal", f"{size:.2f} mm", "of the target"),
    ]
    model = body.get("against_predicted")
    if model:
        said = f"RMS; the prediction explains {percent(model['known_frac'], 0)} of the mean square deviation"
        rows.append(length("against the predicted shape", model["rms_mm"], said))
    return tuple(rows)


def _key_facts(body: dict[str, Any]) -> tuple[Fact, ...]:
    found = body.get("deviation")
    if found is None:
        return ()
    rows = (
        ("RMS", "rms", ""),
        ("mean absolute", "mean_abs", ""),
        ("95 % within", "p95_abs", ""),
        ("largest patch", "max_patch", "+"),
    )
    told = [
        Fact(label, f"{found[f'{key}_mm']:{sign}.2f} mm", f"{percent(found[f'{key}_frac'], 2, sign)} of the diagonal")
        for label, key, sign in rows
    ]
    return (*told, Fact("seen", percent(found["coverage_frac"], 0), "of the target's area"))


def _view(run: RunFolder, body: dict[str, Any], ident: str) -> Figure:
    with np.load(run.path / "artefacts" / "map.npz") as made:
        mesh = TriMesh(made["vertices_mm"], made["faces"].astype(np.int64))
        value = made["deviation_mm"]
    caption = "Signed deviation on the target: red on the side the surface pops towards, blue below, grey not seen."
    return view(mesh, value, float(body["colour_span_mm"]), ident, caption)


def _pictures(run: RunFolder) -> list[Figure]:
    folder = run.path / "artefacts"
    names = (
        ("map-oblique.png", "The same from obliquely above.", False),
        ("map-top.png", "The same from above.", False),
        ("map-front.png", "The same from the front.", False),
        (
            "histogram.svg",
            "Share of the compared area by deviation; dashed: the tolerance, where it is as near.",
            False,
        ),
        ("bar.svg", "Colours of the map and the histogram, in mm and in percent of the diagonal.", True),
    )
    return [picture(folder / name, text, wide) for name, text, wide in names if (folder / name).is_file()]


def _cleaning(run: RunFolder) -> tuple[Figure, ...]:
    path = run.path / "artefacts" / "cleaning.png"
    text = "Every point by what it was taken for, from above and from the side: green specimen, brown table, grey "
    return (picture(path, text + "background, red stray.", wide=True),) if path.is_file() else ()


def _cleaning_step(run: RunFolder, body: dict[str, Any]) -> Step:
    cloud = body["cloud"]
    total = max(cloud["points_count"], 1)
    facts = tuple(
        Fact(name, f"{cloud[f'{name}_count']:,}", percent(cloud[f"{name}_count"] / total))
        for name in ("specimen", "table", "background", "stray")
    )
    said = f"{cloud['points_count']:,} points were read; the specimen is: {cloud['part']}."
    return Step("Cleaning", "done", said, facts, _cleaning(run))


def _alignment_step(body: dict[str, Any]) -> Step:
    pose = body.get("pose")
    if pose is None:
        return Step("Alignment", "failed", "There is no pose.")
    spread = body.get("uncertainty") or {}
    unit_mm, half = pose["unit_mm"], _half(body, "scale_frac")
    facts = [
        Fact("status", str(body["status"]), STATUS[str(body["status"])]),
        Fact("decided by", str(body["decided_by"])),
        Fact("mode", str(body.get("mode", "best-fit"))),
        Fact(
            "scale",
            f"{with_half(unit_mm, half and half * unit_mm, 'mm')} a cloud unit",
            "95 % interval" if half else "",
        ),
        Fact("misfit, both ways", percent(pose["misfit_frac"], 2), "of the diagonal"),
        Fact("patches left out", percent(pose["patches_left_out_frac"]), "they deviate, and must not drag the fit"),
    ]
    if spread.get("motion_frac") is not None:
        facts.append(
            Fact(
                "pose uncertainty", percent(COVERAGE * spread["motion_frac"], 2), "of the diagonal, 95 %, by bootstrap"
            )
        )
    rows: list[tuple[str, ...]] = [
        (str(a["relation"]), percent(a["misfit_frac"], 2), f"{a['ratio']:.3f}", _rms_text(a.get("deviation_rms_mm")))
        for a in body.get("alternatives", [])
    ]
    table = _table(("other pose", "misfit", "to the best", "RMS"), rows)
    figures = (Figure(table, "Every pose within 10 % of the best."),)
    symmetries = body["target"]["symmetries"] or ["none found"]
    notes = tuple(f"symmetry of the target: {line}" for line in symmetries)
    said = STATUS[str(body["status"])]
    return Step("Alignment", "done", said[:1].upper() + said[1:] + ".", tuple(facts), figures if rows else (), notes)


def _rms_text(rms_mm: float | None) -> str:
    return "" if rms_mm is None else f"{rms_mm:.2f} mm"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    heads = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    return f"<table><tr>{heads}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def _notes(body: dict[str, Any]) -> tuple[str, ...]:
    return tuple(
        f"{f['level']} {f['code']}: {f['message']}" + (f" ({f['hint']})" if f["hint"] else "")
        for f in body.get("findings", [])
    )


def _provenance(run: RunFolder, manifest: dict[str, Any]) -> list[Provenance]:
    rows = [
        Provenance("input", Path(str(item["path"])).name, "", str(item["sha256"]), f"{item['bytes']:,} bytes")
        for item in manifest.get("inputs", [])
    ]
    asked = {**manifest.get("config", {}), "seed": manifest.get("seed")}
    detail = ", ".join(" ".join(fact(key, value)) for key, value in asked.items() if value is not None)
    return [*rows, Provenance("run", run.run_id, clock(str(manifest.get("started_utc", ""))), "", detail)]
