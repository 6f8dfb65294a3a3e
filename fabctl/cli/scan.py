"""`fabctl scan`: lay a cloud on its target and say how far it is off."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import bench_option, json_option, lab, progress, say, seed_option, show
from fabctl.cli.paths import RUN, SPECIMEN_OR_FILE, InFile, InFolder, config_names
from fabctl.cli.refusal import finding_of
from fabctl.errors import REFUSED, FabctlError, RefusedError, Stopped, UsageError
from fabctl.events import Event

if TYPE_CHECKING:
    from fabctl.records.folder import RunFolder
    from fabctl.scan.job import Request
    from fabctl.vision.boards import MarkSheet
    from fabctl.workspace import Specimen, Workspace

unit_option = click.option(
    "--unit-mm",
    type=click.FloatRange(0, 1e9, min_open=True),
    default=1.0,
    show_default=True,
    help="Millimetres in one unit of the cloud, with --scale known.",
)
tolerance_option = click.option(
    "--tolerance-frac",
    type=click.FloatRange(0, 10, min_open=True),
    help="Of the bounding-box diagonal; without it nothing is passed or failed.",
)


@click.group()
def command() -> None:
    """Align a scan with its target and report the deviation."""


@command.command("run")
@click.argument("words", nargs=-1, type=SPECIMEN_OR_FILE, metavar="[SPECIMEN] [CLOUD]")
@click.option("--target", type=InFile(), help="Target mesh, for a cloud without a specimen.")
@click.option(
    "--predicted",
    type=InFile(),
    help="Deployed shape that a model foresaw, compared as well  [the specimen's deployed.ply].",
)
@click.option(
    "--scale",
    type=click.Choice(["free", "known", "markers"]),
    default="free",
    show_default=True,
    help="The cloud's scale: found from geometry, given by --unit-mm, or taken from a measured board.",
)
@unit_option
@click.option(
    "--markers",
    type=InFile(),
    help="Markers as scanned: label,x,y,z in cloud units; without it they are looked for in the cloud's colours.",
)
@click.option("--board", type=InFile(), help="The board as measured: label,x,y,z in mm.")
@click.option("--bars", type=InFile(), help="Scale bars, x1,y1,z1,x2,y2,z2,length_mm: pairs of points in cloud units.")
@click.option("--model", type=InFolder(), help="The scan's COLMAP text model (folder).")
@click.option("--pictures", type=InFolder(), help="Its pictures  [MODEL/images].")
@click.option(
    "--marks",
    type=config_names("boards"),
    default="scale",
    show_default=True,
    help="The board whose coded marks the pictures show.",
)
@click.option("--datum", type=InFile(), help="Three or more points as scanned: label,x,y,z in cloud units.")
@click.option("--datum-target", type=InFile(), help="The same points on the target: label,x,y,z in mm.")
@click.option(
    "--colours", type=InFile(), help="Coloured PLY in the target's frame, e.g. an earlier scan's colours.ply."
)
@click.option(
    "--mode",
    type=click.Choice(["best-fit", "least-squares", "datum", "rim", "gravity-and-rim"]),
    default="best-fit",
    show_default=True,
    help="Rules of the alignment.",
)
@tolerance_option
@seed_option
@bench_option
@json_option
def run_scan(
    words: tuple[str, ...],
    target: Path | None,
    predicted: Path | None,
    scale: str,
    unit_mm: float,
    markers: Path | None,
    board: Path | None,
    bars: Path | None,
    model: Path | None,
    pictures: Path | None,
    marks: str,
    datum: Path | None,
    datum_target: Path | None,
    colours: Path | None,
    mode: str,
    tolerance_frac: float | None,
    seed: int,
    bench_name: str,
    as_json: bool,
) -> None:
    """Compare CLOUD with the target of SPECIMEN, or with --target.

    Without CLOUD the bench's scanner is asked for one. Exit code 3: no pose, or more than one; 6: out of tolerance.
    """
    from fabctl.scan.job import Request

    here = lab()
    specimen, cloud = _named(here, words, target)
    mesh = target if specimen is None else _target_of(specimen)
    if mesh is None:
        raise UsageError("name a specimen, or give --target")
    if scale != "markers" and (bars or model):
        raise UsageError("--bars and --model belong to --scale markers")
    if pictures is not None and model is None:
        raise UsageError(f"--pictures {pictures} belongs to --model, the scan's COLMAP text model")
    if predicted is None and specimen is not None and (specimen.design / "deployed.ply").is_file():
        predicted = specimen.design / "deployed.ply"
    options: dict[str, Any] = {
        "scale": scale,
        "unit_mm": unit_mm,
        "markers": markers,
        "board": board,
        "bars": bars,
        "model": model,
        "pictures": pictures or (model / "images" if model else None),
        "marks": _mark_sheet(here, marks) if model else None,
        "datum_cloud": datum,
        "datum_target": datum_target,
        "colours": colours,
        "mode": mode,
        "tolerance_frac": tolerance_frac,
        "seed": seed,
    }
    if cloud is not None:
        _run(here, Request(cloud, mesh, predicted, **options), specimen, as_json)
        return
    if specimen is None:
        raise UsageError("give the cloud's file")
    fresh, source = _fetch(here, bench_name, specimen, seed)
    _run(here, Request(fresh, mesh, predicted, **options), specimen, as_json, source)


@command.command("batch")
@click.argument("clouds", nargs=-1, required=True, type=InFile())
@click.option("--target", type=InFile(), required=True, help="Target mesh of all the clouds.")
@click.option(
    "--scale",
    type=click.Choice(["free", "known"]),
    default="free",
    show_default=True,
    help="The clouds' scale: found from geometry, or given by --unit-mm.",
)
@unit_option
@tolerance_option
@seed_option
@json_option
def run_batch(
    clouds: tuple[Path, ...],
    target: Path,
    scale: str,
    unit_mm: float,
    tolerance_frac: float | None,
    seed: int,
    as_json: bool,
) -> None:
    """Compare many CLOUDS with one target; a run record each. The exit code is that of the worst."""
    from fabctl.scan.job import Request

    here, worst = lab(), 0
    rows: list[dict[str, Any]] = []
    for cloud in clouds:
        options: dict[str, Any] = {"scale": scale, "unit_mm": unit_mm, "tolerance_frac": tolerance_frac, "seed": seed}
        try:
            run, body, code = _compared(here, Request(cloud, target, **options), None, {})
        except (RefusedError, UsageError) as fault:  # one bad file must not lose the others
            rows.append(
                {"cloud": str(cloud), "verdict": "undecided", "error": str(fault), "exit_code": fault.exit_code}
            )
            worst = max(worst, fault.exit_code)
            continue
        found = body.get("deviation") or {}
        row = {"cloud": str(cloud), "run": run.run_id, "status": body["status"], "verdict": body["verdict"]}
        rows.append({**row, "rms_mm": found.get("rms_mm"), "rms_frac": found.get("rms_frac"), "exit_code": code})
        worst = max(worst, code)
    lines = [
        f"{Path(r['cloud']).name:32} {r['verdict']:18} {r.get('rms_mm') or float('nan'):9.3f} mm rms" for r in rows
    ]
    off = sum(row["exit_code"] != 0 for row in rows)
    show({"scans": rows}, as_json, lines, worst, f"{off} of {len(rows)} scans did not pass")


@command.command("compare")
@click.argument("first", type=RUN)
@click.argument("second", type=RUN)
@json_option
def compare_scans(first: str, second: str, as_json: bool) -> None:
    """Say how well scan run SECOND repeats FIRST: two scans of one specimen, or of one target."""
    from dataclasses import asdict

    from fabctl.scan.repeat import compare_runs

    here = lab()
    runs = [here.run(name) for name in (first, second)]
    found = compare_runs(*runs)
    lines = [
        f"repeatability {found.repeatability_mm:.3f} mm (one scan, bias removed); bias {found.bias_mm:+.3f} mm",
        f"difference rms {found.rms_mm:.3f} mm, 95 % within {found.p95_abs_mm:.3f} mm; "
        f"correlation {found.correlation_ratio:.2f} over {found.common_frac:.0%} of the target",
    ]
    show({"first": first, "second": second, **asdict(found)}, as_json, lines)


def _mark_sheet(here: Workspace, name: str) -> MarkSheet:
    from fabctl.config.boards import load_board

    return load_board(name, here.root).mark_sheet()


def _named(here: Workspace, words: tuple[str, ...], target: Path | None) -> tuple[Specimen | None, Path | None]:
    """Return the specimen and the cloud that the command line names."""
    from fabctl.workspace import SPECIMEN

    if len(words) > 2:
        raise UsageError(f"too many words: {' '.join(words)}")
    if target is not None:
        if len(words) != 1:
            raise UsageError("with --target give the cloud's file and nothing else")
        return None, Path(words[0])
    if not words:
        raise UsageError("name a specimen, or give --target and a cloud")
    if not SPECIMEN.fullmatch(words[0]) and Path(words[0]).is_file():
        raise UsageError(f"{words[0]} is a file; give the specimen first, or --target")
    return here.specimen(words[0]), Path(words[1]) if len(words) == 2 else None


def _target_of(specimen: Specimen) -> Path:
    mesh = specimen.design / "target.ply"
    if not mesh.is_file():
        raise UsageError(f"{specimen.name} was cut without a target surface, as coupons are: nothing to compare with")
    return mesh


def _fetch(here: Workspace, bench_name: str, specimen: Specimen, seed: int) -> tuple[Path, dict[str, Any]]:
    """Ask the bench's scanner for a cloud of the specimen; return its file, and who made it, for the record."""
    from fabctl.bench import open_bench
    from fabctl.config.bench import load_bench

    config = load_bench(bench_name, here.root)
    if config.scan is None:
        raise UsageError(f"bench {config.name} has no scan section; give the cloud's file")
    source = {"bench": config.name, "simulated": config.is_simulated}
    with open_bench(here, config, f"scan of {specimen.name}") as bench:
        if config.scan.inbox is not None:
            return _newest(Path(config.scan.inbox.replace("{state}", str(bench.state)))), source
        assert config.scan.command is not None
        bench.lay(specimen.design)
        out = bench.state / "scans" / f"{specimen.name}-{seed}.ply"
        out.parent.mkdir(exist_ok=True)
        out.unlink(missing_ok=True)
        places = {
            "slot": bench.slot or specimen.design,
            "out": out,
            "seed": seed,
            "truth": bench.state / "truth",
            "state": bench.state,
        }
        asked = [w.format(**places) for w in shlex.split(config.scan.command)]
        asked[0] = sys.executable if asked[0] == "python" else asked[0]
        say(f"scanning: {' '.join(asked[:4])} …")
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
        if done.returncode or not out.is_file():
            raise _ScannerFailed(f"the scanner made no cloud (exit {done.returncode}): {done.stderr.strip()[-500:]}")
        return out, source


class _ScannerFailed(FabctlError):
    """The bench's scan command ended without a cloud."""

    exit_code = 4


def _newest(inbox: Path) -> Path:
    from fabctl.scan.cloud import FORMATS

    found = [p for p in inbox.iterdir() if p.suffix.lower() in FORMATS] if inbox.is_dir() else []
    if not found:
        raise UsageError(f"{inbox}: no cloud lies there")
    return max(found, key=lambda p: p.stat().st_mtime)


def _run(
    here: Workspace, request: Request, specimen: Specimen | None, as_json: bool, source: dict[str, Any] | None = None
) -> None:
    """Compare, write the run record, show the result; a no ends with its exit code."""
    run, body, code = _compared(here, request, specimen, source or {})
    page = run.artefact("report.html")
    data = {"run": run.run_id, "folder": str(run.path), "report": str(page), **body}
    show(data, as_json, _lines(body, page), code, _sentence(body))


def _compared(
    here: Workspace, request: Request, specimen: Specimen | None, source: dict[str, Any]
) -> tuple[RunFolder, dict[str, Any], int]:
    """Compare and write the run record; return it with the result and the exit code."""
    from fabctl.events import Event
    from fabctl.records.folder import start_run
    from fabctl.reports.scan import write_scan_report
    from fabctl.scan.job import compare, record

    missing = [str(p) for p in request.files() if not p.is_file()]
    if missing:
        raise UsageError(f"no such file: {', '.join(missing)}")
    name = None if specimen is None else specimen.name
    config = {k: getattr(request, k) for k in ("scale", "unit_mm", "mode", "tolerance_frac")} | source
    run = start_run(here.runs, "scan", specimen=name, inputs=request.files(), config=config, seed=request.seed)
    log, live = run.log_events(), progress()

    def emit(event: Event) -> None:
        log(event)
        live(event)

    try:
        made = compare(request, emit)
        emit(Event("stage", "drawing the pictures and writing the report"))
        body = record(run, made)
    except KeyboardInterrupt:
        run.finish("stopped", "stopped by the operator")
        raise Stopped("stopped") from None
    except Exception as fault:  # whatever it was, the record says how the run ended
        run.finish("refused" if isinstance(fault, RefusedError) else "failed", str(fault))
        raise
    run.finish("refused" if made.exit_code == REFUSED else "done", _sentence(body), verdict=body["verdict"])
    write_scan_report(run)
    return run, body, made.exit_code


def _sentence(body: dict[str, Any]) -> str:
    found = body.get("deviation")
    if found is None:
        return f"{body['status']}: " + "; ".join(f["message"] for f in body["findings"] if f["level"] == "error")
    verdict = body["verdict"] + (" (--tolerance-frac)" if body["tolerance_frac"] is None else "")
    return (
        f"{verdict}: rms {found['rms_mm']:.3f} mm ({found['rms_frac']:.3%} of the diagonal), "
        f"95 % of the area within {found['p95_abs_mm']:.3f} mm"
    )


def _lines(body: dict[str, Any], page: Path) -> list[str]:
    lines = [_sentence(body)]
    found = body.get("deviation")
    if found is not None:
        place = ", ".join(f"{x:.1f}" for x in found["max_place_mm"])
        lines += [
            f"mean {found['mean_mm']:+.3f} mm, mean absolute {found['mean_abs_mm']:.3f} mm, "
            f"largest {found['max_mm']:+.3f} mm at ({place})",
            f"{found['coverage_frac']:.0%} of the target seen; {found['border_count']} points past its border and "
            f"{found['lone_count']} wrong matches left out of {found['points_count']}",
            f"scale {body['pose']['unit_mm']:.6g} mm a unit; pose decided by {body['decided_by']}",
        ]
    if body.get("against_predicted"):
        model = body["against_predicted"]
        lines.append(
            f"against the predicted shape: rms {model['rms_mm']:.3f} mm; "
            f"it knew {model['known_frac']:.0%} of the deviation"
        )
    lines += [str(finding_of(row)) for row in body["findings"]]
    return [*lines, f"report: {page}"]
