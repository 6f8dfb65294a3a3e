"""`fabctl kerf`: cut a coupon of slits, measure a picture of it, and write the material's kerf."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import MATERIAL, bench_option, json_option, lab, say, show
from fabctl.cli.cut_camera import plain_job, plain_job_options
from fabctl.cli.finite import numbers
from fabctl.cli.paths import InFile, InFolder, OutFolder

if TYPE_CHECKING:
    from drivers.camera import Frame
    from fabctl.vision.coupon import Coupon
    from fabctl.vision.kerf import KerfMeasurement


@click.group("kerf")
def command() -> None:
    """Cut and measure kerf coupons."""


@command.command("coupon")
@click.option(
    "--material", type=MATERIAL, required=True, help="Material file or its name; its preset gives speed and passes."
)
@click.option("--powers", default=None, metavar="0.4,0.5,…", help="Power steps; around the preset's when not given.")
@click.option(
    "-o", "--output", type=OutFolder(), default=Path("coupon"), show_default=True, help="Folder to write into."
)
@bench_option
@json_option
def coupon(material: str, powers: str | None, output: Path, bench_name: str, as_json: bool) -> None:
    """Make a coupon for `kerf cut`: slits along x and y and open squares at several powers, with marks around."""
    from design.export.dxf import dxf
    from design.export.gcode import GcodeOptions
    from design.pattern.paths import LayerPreset
    from fabctl.config.bench import load_bench
    from fabctl.config.material import load_material
    from fabctl.errors import UsageError
    from fabctl.records.folder import as_json as text_of
    from fabctl.records.folder import write_atomically
    from fabctl.vision import coupon as coupons

    stuff = load_material(material, lab().root)
    if stuff.danger or stuff.laser is None:
        raise UsageError(f"{stuff.name}: {stuff.danger or 'no laser preset'}; it is not cut")
    laser = load_bench(bench_name, lab().root).laser
    if laser is None:
        raise UsageError(f"bench {bench_name} has no laser")
    slit, engrave = stuff.laser.slit, stuff.laser.engrave
    steps = (
        numbers(powers, "--powers")
        if powers
        else [round(slit.power_frac * k, 4) for k in (0.8, 1.0, 1.2) if slit.power_frac * k <= 1]
    )
    made = coupons.make_coupon(steps, slit.feed_mm_s, slit.passes_count)
    options = GcodeOptions(origin_mm=laser.origin_mm)
    preset = LayerPreset(engrave.power_frac, engrave.feed_mm_s, engrave.passes_count)
    lines = coupons.coupon_gcode(made, preset, laser.spot_mm, options)
    strokes = [stroke for power in steps for stroke in coupons.strokes_at(made, power)]
    output.mkdir(parents=True, exist_ok=True)
    write_atomically(output / "coupon.json", text_of({**coupons.coupon_data(made), "material": stuff.name}))
    write_atomically(output / "coupon.nc", "\n".join(lines) + "\n")
    write_atomically(output / "coupon.dxf", dxf([*coupons.mark_strokes(made, laser.spot_mm), *strokes], made.size_mm))
    w, h = made.size_mm
    data = {"folder": str(output), "powers_frac": steps, "size_mm": [w, h], "lines_count": len(lines)}
    text = f"{output}: {w:g} x {h:g} mm, powers {', '.join(f'{p:g}' for p in steps)}"
    show(data, as_json, [text, f"fabctl kerf cut {output}"])


@command.command("cut")
@click.argument("folder", type=InFolder())
@plain_job_options
def cut_coupon(folder: Path, origin: str, dry_run: bool, bench_name: str, yes: bool, as_json: bool) -> None:
    """Cut the coupon in FOLDER: the same checks, the same question and the same record as any cut."""
    from design.export.gcode import GcodeOptions
    from design.pattern.font import text_strokes
    from fabctl.config.bench import load_bench
    from fabctl.config.material import load_material
    from fabctl.cut.compose import code_strokes, presets_of
    from fabctl.cut.job import CutOrder, laser_config_of
    from fabctl.vision.coupon import coupon_gcode, id_places

    file = folder / "coupon.json"
    made, material = read_coupon(file)
    stuff = load_material(material, lab().root)
    spot_mm = laser_config_of(load_bench(bench_name, lab().root)).spot_mm
    anchor, box = id_places(made)

    def compose(specimen: str, s_max_count: float) -> tuple[str, ...]:
        strokes = [*text_strokes(specimen, anchor), *code_strokes(specimen, box, spot_mm)]
        return coupon_gcode(made, presets_of(stuff)["engrave"], spot_mm, GcodeOptions(s_max_count=s_max_count), strokes)

    order = CutOrder(file, compose, stuff, origin=origin, kind="kerf-coupon")  # type: ignore[arg-type]  # click.Choice has checked it
    done = plain_job(order, bench_name, f"coupon {folder.name}", yes, dry_run)
    facts = {"coupon": str(file), "specimen": None, "run": None, **done.result}
    if done.run is None or done.specimen is None:
        show(facts, as_json, [f"checked: {facts['lines_count']} lines"])
        return
    facts |= {"specimen": done.specimen.name, "run": done.run.run_id}
    done.run.artefact("coupon.json").write_bytes(file.read_bytes())
    advice = "let the squares fall out, photograph it over a light table at 0.05 mm a pixel or finer, then:"
    told = f"the coupon {done.specimen.name} is cut; run {done.run.run_id}"
    show(facts, as_json, [told, advice, "fabctl kerf measure PICTURE --write"])


def read_coupon(path: Path) -> tuple[Coupon, str]:
    """Return the coupon in a `coupon.json`, and the material it is for; raise `UsageError` where it is none."""
    from fabctl.errors import UsageError
    from fabctl.files import json_of, why_not
    from fabctl.vision.coupon import coupon_from

    facts = json_of(path, "the coupon.json of `fabctl kerf coupon`")
    try:
        return coupon_from(facts, str(path)), str(facts["material"])
    except (KeyError, TypeError, ValueError) as fault:
        raise UsageError(f"{path}: not a coupon: {why_not(fault)}; `fabctl kerf coupon` makes one") from fault


def _coupon_in(frame: Frame, file: Path | None) -> tuple[str | None, Coupon, str]:
    """Return the id of the coupon in the picture, the coupon and its material.

    Raises `RefusedError` where `file` says otherwise than the coupon was cut, `UsageError` where nothing tells it.
    """
    from design.findings import Finding
    from fabctl.errors import RefusedError, UsageError
    from fabctl.vision.ids import read_ids

    told = read_coupon(file) if file is not None else None
    for name in [engraved.specimen for engraved in read_ids(frame.image)]:
        own = lab().specimens / name / "design" / "coupon.json"
        if not own.is_file():
            say(f"the id {name} is engraved there, of no coupon that was cut here")
            continue
        cut = read_coupon(own)
        if told not in (None, cut):
            text = f"the picture shows {name}, which was not cut as {file} says"
            found = Finding("KERF-COUPON", text, where=frame.source, hint="without --coupon its own is taken")
            raise RefusedError("the kerf would be told of other powers", [found])
        return name, *cut
    if told is None:
        raise UsageError(f"{frame.source}: no id of a coupon that was cut here is seen; give --coupon coupon.json")
    return None, *told


@command.command("measure")
@click.argument("image", type=InFile())
@click.option(
    "--coupon", "coupon_file", type=InFile(), help="The coupon.json of the coupon in the picture  [its id's own]."
)
@click.option("--write", is_flag=True, help="Write the kerf into the lab's material file.")
@click.option(
    "--gamma",
    type=click.Choice(["srgb", "linear"]),
    default="srgb",
    show_default=True,
    help="How the picture's grey follows light.",
)
@json_option
def measure(image: Path, coupon_file: Path | None, write: bool, gamma: str, as_json: bool) -> None:
    """Measure the kerf per power and direction in a picture of the coupon, with its uncertainty."""
    from fabctl.config.material import load_material
    from fabctl.errors import UsageError
    from fabctl.files import picture_of
    from fabctl.vision import kerf as kerfs

    frame = picture_of(image)
    specimen, made, material = _coupon_in(frame, coupon_file)
    found = kerfs.measure(frame.image, frame.source, made, gamma)
    data, lines = _table(found)
    data["specimen"] = specimen
    if write:
        stuff = load_material(material, lab().root)
        if stuff.laser is None:
            raise UsageError(f"{stuff.name} has no laser preset")
        kerf_mm, doubt_mm = kerfs.kerf_at(found, stuff.laser.slit.power_frac)
        path = _write_kerf(stuff.name, material, kerf_mm)
        data |= {"material": stuff.name, "file": str(path), "kerf_mm": kerf_mm, "uncertainty_mm": doubt_mm}
        lines.append(f"{path}: kerf {stuff.laser.kerf_mm:g} mm, now {kerf_mm:.4f} ± {doubt_mm:.4f} mm")
    show(data, as_json, lines)


def _table(found: KerfMeasurement) -> tuple[dict[str, Any], list[str]]:
    rows = [
        {
            "power_frac": w.power_frac,
            "axis": w.axis,
            "kerf_mm": w.kerf_mm,
            "uncertainty_mm": w.uncertainty_mm,
            "spread_mm": w.spread_mm,
            "slits_count": w.slits_count,
            "through": w.through,
        }
        for w in found.widths
    ]
    data: dict[str, Any] = {
        "widths": rows,
        "window_kerf_mm": {f"{power:g}": kerf for power, kerf in found.window_kerf_mm.items()},
        "mm_per_px": found.mm_per_px,
        "findings": [finding.as_dict() for finding in found.findings],
    }
    lines = [
        f"power {w.power_frac:<5g} along {w.axis}: {w.kerf_mm:.4f} ± {w.uncertainty_mm:.4f} mm"
        + ("" if w.through else "  not through")
        for w in found.widths
    ]
    return data, [*lines, *map(str, found.findings)]


def _write_kerf(name: str, known_as: str, kerf_mm: float) -> Path:
    """Write the kerf into the lab's own material file, every other line kept; return its path."""
    import re

    from fabctl.config.bench import find
    from fabctl.config.loader import parse
    from fabctl.config.material import MaterialConfig
    from fabctl.errors import UsageError
    from fabctl.records.folder import write_atomically

    source = find("materials", known_as, lab().root)
    text = source.read_text(encoding="utf-8")
    changed, count = re.subn(r"(?m)^(\s*kerf_mm:\s*)[^\s#]+", rf"\g<1>{kerf_mm:.4f}", text)
    if count != 1:
        raise UsageError(
            f"{source}: {count} lines say kerf_mm, one was expected; write kerf_mm: {kerf_mm:.4f} yourself"
        )
    own = lab().root / "configs" / "materials"
    path = source if own in source.parents or (source.suffix and Path(known_as) == source) else own / source.name
    parse(changed, MaterialConfig, str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, changed)
    return path
