"""`fabctl design`: build a design folder, check a target before that, compare two designs, make a coupon."""

from __future__ import annotations

from pathlib import Path

import click

from fabctl.cli.common import json_option, lab, progress, say, show


@click.group()
def command() -> None:
    """Turn a target surface into a cut sheet."""


@command.command()
@click.argument("spec")
@click.option("--target", type=click.Path(path_type=Path), help="Mesh to use instead of the specification's.")
@click.option("--cell-mm", type=click.FloatRange(0.1), help="Edge of a cell, instead of the specification's.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Design folder to write [out/NAME].")
@click.option("--replace", is_flag=True, help="Replace a design that lies in that folder.")
@json_option
def build(
    spec: str, target: Path | None, cell_mm: float | None, output: Path | None, replace: bool, as_json: bool
) -> None:
    """Build the design folder of SPEC, a YAML file or a name in configs/specs."""
    from design.bundle import facts
    from fabctl.config.spec import load_spec
    from fabctl.designing import build_folder

    home = lab().root
    folder = output or home / "out" / load_spec(spec, home)[0].name
    design, bundle = build_folder(spec, folder, home, target, cell_mm, replace, progress())
    for finding in design.findings:
        say(str(finding))
    numbers = facts(design)
    width, height = numbers["sheet_mm"]
    lines = [
        f"{bundle.path}: {numbers['cells_count']} cells on {width:.0f} × {height:.0f} mm",
        f"expansion {numbers['expansion_low_ratio']:.3f} to {numbers['expansion_high_ratio']:.3f}",
        f"cut {numbers['cut_mm'] / 1000:.2f} m, travel {numbers['travel_mm'] / 1000:.2f} m, "
        f"about {numbers['cut_time_s'] / 60:.1f} min",
    ]
    if "deviation_mean_mm" in numbers:
        lines.append(
            f"deployed: {numbers['deviation_mean_mm']:.2f} mm from the target on average "
            f"({numbers['deviation_mean_frac']:.2%} of its diagonal), {numbers['stiffness_2mm_N_mm']:.4f} N/mm to 2 mm"
        )
    findings = [finding.as_dict() for finding in design.findings]
    show({"folder": str(bundle.path), **numbers, "findings": findings}, as_json, lines)
