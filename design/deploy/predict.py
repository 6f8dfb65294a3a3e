"""What pops up: the deployed mesh of a design, in its target's frame, and how far it is from the target."""

from __future__ import annotations

from dataclasses import dataclass

from design.deploy.compare import Deviation, align, deviation
from design.deploy.equilibrium import Watch, solve_level
from design.deploy.levels import Layout
from design.deploy.newton import Equilibrium
from design.deploy.shell import Reals
from design.surface import TriMesh


@dataclass(frozen=True, slots=True)
class Deployed:
    """A predicted shape. `mesh` has the layout's vertices and units, moved rigidly onto the target."""

    mesh: TriMesh
    equilibrium: Equilibrium
    deviation: Deviation


def deploy(layout: Layout, target: TriMesh, design_mm: Reals, watch: Watch | None = None) -> Deployed:
    """Return the free equilibrium that the sheet reaches from its intended shape.

    `design_mm` `(n, 3)` is where each lattice vertex should come to lie on the target. Raises `NotConverged` where
    nothing near that shape is an equilibrium. What is reached from flat may be another one: see `from_flat`.
    """
    return compared(layout, solve_level(layout, design_mm, watch=watch), target, design_mm)


def compared(layout: Layout, found: Equilibrium, target: TriMesh, design_mm: Reals | None) -> Deployed:
    """Return an equilibrium aligned with the target and measured against it."""
    x = align(found.x_mm, layout.cells, target, design_mm)
    return Deployed(TriMesh(x, layout.cells), found, deviation(x, layout.cells, target, design_mm))
