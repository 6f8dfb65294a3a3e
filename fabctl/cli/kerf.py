"""`fabctl kerf`: cut a coupon of slits, measure a picture of it, and write the material's kerf."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fabctl.cli.common import bench_option, json_option, lab, show
from fabctl.cli.finite import numbers

if TYPE_CHECKING:
    from fabctl.vision.kerf import KerfMeasurement

PATH = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.group("kerf")
def command() -> None:
    """Cut and measure kerf coupons."""


@command.command("coupon")
@click.option("--material", required=True, help="Material file or its name; its preset gives speed and passes.")
@click.option("--powers", default=None, metavar="0.4,0.5,…", help="Power steps; around the preset's when not given.")
@click.option("-o", "--output", type=PATH, default=Path("coupon"), show_default=True, help="Folder to write into.")
@bench_option
@json_option
def coupon(material: str, powers: str | None, output: Path, bench_name: str, as_json: bool) -> None:
    """Make a coupon: slits along x and y and open squares at several powers, with marks around."""
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
    advice = "cut coupon.nc, let the squares fall out, photograph it over a light table at 0.05 mm a pixel or finer"
    show(data, as_json, [text, advice, f"fabctl kerf measure PICTURE --coupon {output / 'coupon.json'}"])


@command.command("measure")
@click.argument("image", type=FILE)
@click.option("--coupon", "coupon_file", type=FILE, required=True, help="The coupon.json of the coupon in the picture.")
@click.option("--write", is_flag=True, help="Write the kerf into the lab's material file.")
@click.option("--gamma", type=click.Choice(["srgb", "linear"]), default="srgb", show_default=True)
@json_option
def measure(image: Path, coupon_file: Path, write: bool, gamma: str, as_json: bool) -> None:
    """Measure the kerf per power and direction in a picture of the coupon, with its uncertainty."""
    from drivers.camera import read_picture
    from fabctl.config.material import load_material
    from fabctl.errors import UsageError
    from fabctl.vision import kerf as kerfs
    from fabctl.vision.coupon import coupon_from

    try:
        facts = json.loads(coupon_file.read_text(encoding="utf-8"))
    except ValueError as fault:
        raise UsageError(f"{coupon_file}: not JSON: {fault}") from fault
    frame = read_picture(image)
    found = kerfs.measure(frame.image, frame.source, coupon_from(facts, str(coupon_file)), gamma)
    data, lines = _table(found)
    if write:
        stuff = load_material(facts["material"], lab().root)
        if stuff.laser is None:
            raise UsageError(f"{stuff.name} has no laser preset")
        kerf_mm, doubt_mm = kerfs.kerf_at(found, stuff.laser.slit.power_frac)
        path = _write_kerf(stuff.name, facts["material"], kerf_mm)
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
