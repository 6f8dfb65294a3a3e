"""`fabctl design`: build a design folder, check a target before that, compare two designs, make a coupon."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import click

from fabctl.cli.common import MATERIAL, json_option, lab, progress, say, show
from fabctl.cli.design_coupon import coupon, coupon_read, library_option
from fabctl.cli.library_parts import CURVE_WHY
from fabctl.cli.paths import TARGET, InFile, InFolder, OutFolder, PictureFile, config_names
from fabctl.events import Event


@click.group()
def command() -> None:
    """Turn a target surface into a cut sheet."""


command.add_command(coupon)
command.add_command(coupon_read)


@command.command()
@click.argument("spec", type=config_names("specs"))
@click.option("--target", type=InFile(), help="Mesh to use instead of the specification's.")
@click.option("--cell-mm", type=click.FloatRange(0.1, 1000), help="Edge of a cell, instead of the specification's.")
@library_option
@click.option("-o", "--output", type=OutFolder(), help="Design folder to write [out/NAME].")
@click.option("--replace", is_flag=True, help="Replace a design that lies in that folder.")
@click.option("--compensate", is_flag=True, help="Change the expansions so that the bent sheet meets the target.")
@json_option
def build(
    spec: str,
    target: Path | None,
    cell_mm: float | None,
    library: Path | None,
    output: Path | None,
    replace: bool,
    compensate: bool,
    as_json: bool,
) -> None:
    """Build the design folder of SPEC, a YAML file or a name in configs/specs."""
    from design.bundle import facts
    from fabctl.config.spec import load_spec
    from fabctl.designing import build_folder

    home = lab().root
    folder = output or home / "out" / load_spec(spec, home, target)[0].name
    design, bundle = build_folder(spec, folder, home, target, cell_mm, replace, progress(), compensate, library)
    for finding in design.findings:
        say(str(finding))
    numbers = facts(design)
    width, height = numbers["sheet_mm"]
    lines = [
        f"{bundle.path}: {numbers['cells_count']} cells on {width:.0f} × {height:.0f} mm",
        f"expansion {numbers['expansion_low_ratio']:.3f} to {numbers['expansion_high_ratio']:.3f}",
        f"cut {numbers['cut_mm'] / 1000:.2f} m, travel {numbers['travel_mm'] / 1000:.2f} m, "
        f"about {numbers['cut_time_s'] / 60:.1f} min without the specimen's id",
    ]
    if "deviation_mean_mm" in numbers:
        lines.append(
            f"deployed: {numbers['deviation_mean_mm']:.2f} mm from the target on average "
            f"({numbers['deviation_mean_frac']:.2%} of its diagonal), {numbers['stiffness_2mm_N_mm']:.4f} N/mm to 2 mm"
        )
    findings = [finding.as_dict() for finding in design.findings]
    show({"folder": str(bundle.path), **numbers, "findings": findings}, as_json, lines)


@command.command()
@click.argument("target", type=TARGET)
@click.option(
    "--material", type=MATERIAL, help="Material file or its name, for a mesh or surface [natural-rubber-2.3]."
)
@click.option("--cell-mm", type=click.FloatRange(0.1, 1000), help="Edge of a cell [the material's].")
@library_option
@click.option("--cells", type=click.Choice(["expanding", "contracting"]),
              help="Kind of cells, for a mesh or surface [expanding].")  # fmt: skip
@click.option("--remedy", type=click.Choice(["none", "cones", "nearest", "both"]),
              help="What to try where no single sheet fits [the specification's, or none].")  # fmt: skip
@click.option(
    "--picture",
    type=PictureFile((".png",)),
    help="PNG of where the surface does not fit, and of its flat in the sheet's size.",
)
@json_option
def check(
    target: str,
    material: str | None,
    cell_mm: float | None,
    library: Path | None,
    cells: str | None,
    remedy: str | None,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Say whether a sheet can become TARGET: a specification, a mesh file, or one of the project's own surfaces.

    A name that is a specification and a surface, such as cap, is the specification, as for `fabctl design build`;
    with --material or --cells it is the surface.
    """
    from design.checking import check as checked
    from design.checking import misfit_png
    from fabctl.designing import inputs_for, progress_of
    from fabctl.errors import DONE, REFUSED
    from fabctl.records.folder import write_atomically

    listen = progress()
    listen(Event("stage", f"reading {target} and the library of cells"))
    inputs = inputs_for(target, material, lab().root, cell_mm, cast(Any, cells), library)
    found = checked(inputs.spec, inputs.mesh, inputs.library, inputs.presets, cast(Any, remedy), progress_of(listen))
    if picture is not None:
        write_atomically(picture, misfit_png(inputs.mesh, found, inputs.spec.name))
    findings = [*inputs.findings, *found.findings]
    for finding in findings:
        say(str(finding))
    low, high = found.report.limits.low_ratio, found.report.limits.high_ratio
    lines = [f"{found.topology}; the library has {low:.3f} to {high:.3f}, a spread of {high / low:.3f}"]
    least, greatest = inputs.library.range_ratio()
    if (f"{least:.3f}", f"{greatest:.3f}") != (f"{low:.3f}", f"{high:.3f}"):
        lines[0] += f" (all its cells {least:.3f} to {greatest:.3f}: {CURVE_WHY})"
    for step in found.report.steps:
        lines.append(
            f"{step.rung:8} spread {step.spread_ratio:.3f}  {'fits' if step.fits else 'too much'}: {step.detail}"
        )
    lines += [finding.message for finding in found.report.findings if finding.code == "FIT-PROVEN"]
    if found.design is not None:
        width, height = found.design.drawing.size_mm
        minutes = found.design.job.time_s / 60
        count = len(found.design.cells.wanted_ratio)
        lines.append(
            f"the sheet: {count} cells on {width:.0f} × {height:.0f} mm, about {minutes:.1f} min to cut, without its id"
        )
    fits = found.design is not None
    lines.append("it fits" if fits else "it does not fit")
    lines += [f"picture {picture}"] if picture is not None else []
    if found.report.best() is None and (remedy or inputs.spec.remedy()) == "none":
        lines.append("--remedy both tries cones, and the nearest surface that fits")
    facts = {"target": target, "fits": fits, **found.as_dict()}
    show(facts, as_json, lines, DONE if fits else REFUSED, f"{target}: no single sheet fits it as it is")


@command.command()
@click.argument("a", type=InFolder())
@click.argument("b", type=InFolder())
@json_option
def compare(a: Path, b: Path, as_json: bool) -> None:
    """Compare two design folders: sheet, cells, cutting, deployed shape and stiffness."""
    from design.bundle import open_bundle
    from design.compared import compare as compared
    from design.compared import compared_lines

    say(f"reading {a} and {b}")
    found = compared(open_bundle(a), open_bundle(b))
    show(found, as_json, [f"A: {a}", f"B: {b}", *compared_lines(found)])
