"""`fabctl target`: make the project's own target surfaces, and look at a mesh file."""

from __future__ import annotations

import inspect
import math
from pathlib import Path
from typing import Any

import click

from fabctl.cli.common import json_option, show
from fabctl.cli.paths import InFile, OutFile
from fabctl.errors import UsageError


@click.group()
def command() -> None:
    """Make target surfaces, and check a mesh before designing with it."""


@command.command("list")
@json_option
def list_targets(as_json: bool) -> None:
    """List the surfaces `fabctl target make` knows."""
    from design.targets import TARGETS

    says = {name: (make.__doc__ or "").split("\n")[0] for name, make in TARGETS.items()}
    show({"targets": says}, as_json, [f"{name:12} {text}" for name, text in says.items()])


@command.command("make")
@click.argument("name")
@click.option(
    "-o",
    "--output",
    type=OutFile((".obj", ".ply", ".stl"), "a mesh"),
    required=True,
    help="OBJ, PLY or STL file to write.",
)
@click.option("--radius-mm", type=click.FloatRange(1, 10_000), help="Radius of the sphere, disk or tube.")
@click.option("--height-mm", type=click.FloatRange(0, 10_000), help="Height of the hills or of the tube.")
@click.option("--half-angle-deg", type=click.FloatRange(5, 150), help="Half-angle of a cap.")
@click.option("--edge-mm", type=click.FloatRange(0.05, 10_000), help="Edge length of the mesh.")
@json_option
def make_target(
    name: str,
    output: Path,
    radius_mm: float | None,
    height_mm: float | None,
    half_angle_deg: float | None,
    edge_mm: float | None,
    as_json: bool,
) -> None:
    """Write the surface NAME as a mesh in mm."""
    from design.meshfiles import write_mesh
    from design.targets import TARGETS

    if name not in TARGETS:
        raise UsageError(f"there is no target `{name}`; there are {', '.join(TARGETS)}")
    asked = {"radius_mm": radius_mm, "height_mm": height_mm, "edge_mm": edge_mm}
    asked["half_angle_rad"] = None if half_angle_deg is None else math.radians(half_angle_deg)
    wanted = {key: value for key, value in asked.items() if value is not None}
    foreign = [key for key in wanted if key not in inspect.signature(TARGETS[name]).parameters]
    if foreign:
        raise UsageError(f"`{name}` does not know {', '.join(foreign)}")
    mesh = TARGETS[name](**wanted)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_mesh(output, mesh)
    facts = _facts(mesh)
    show({"target": name, "path": str(output), **facts}, as_json, [f"{output}: {_sentence(facts)}"])


@command.command("check")
@click.argument("path", type=InFile())
@json_option
def check_target(path: Path, as_json: bool) -> None:
    """Read a mesh file as a target and say everything that is wrong or doubtful about it."""
    from design.meshfiles import read_mesh

    mesh, findings = read_mesh(path)
    facts = _facts(mesh)
    data = {"path": str(path), **facts, "findings": [finding.as_dict() for finding in findings]}
    show(data, as_json, [f"{path}: {_sentence(facts)}", *map(str, findings)])


def _facts(mesh: Any) -> dict[str, Any]:
    from design.surface import boundary_loops, loop_length_mm

    return {
        "vertices_count": len(mesh.vertices_mm),
        "faces_count": len(mesh.faces),
        "size_mm": [round(float(s), 3) for s in mesh.vertices_mm.max(axis=0) - mesh.vertices_mm.min(axis=0)],
        "area_mm2": round(float(mesh.face_areas_mm2().sum()), 2),
        "boundary_mm": [round(loop_length_mm(mesh, loop), 2) for loop in boundary_loops(mesh)],
    }


def _sentence(facts: dict[str, Any]) -> str:
    size = " x ".join(f"{s:g}" for s in facts["size_mm"])
    return f"{facts['vertices_count']} vertices, {facts['faces_count']} faces, {size} mm"
