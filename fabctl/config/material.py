"""The material file: what the rubber is, and how the laser treats it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from pydantic import Field

from design.cells.sheet import Sheet
from fabctl.config.bench import Positive, find
from fabctl.config.loader import Model, load

# Plastics and rubbers with chlorine, by the names they are sold under; `cr` and `csm` only as words of their own.
CHLORINATED = re.compile(r"pvc|vinyl|chlor(?!ine.free)|neoprene|hypalon|(?<![a-z])(?:cr|csm)(?![a-z])", re.IGNORECASE)
CHLORINE_DANGER = "the beam frees hydrogen chloride, which poisons people and rusts the machine"
Fraction = Annotated[float, Field(ge=0, le=1)]


class LayerConfig(Model):
    """Power, speed and passes of one layer."""

    power_frac: Fraction
    feed_mm_s: Positive
    passes_count: Annotated[int, Field(ge=1)] = 1


class LaserPreset(Model):
    """How this material is cut on the lab's laser."""

    slit: LayerConfig
    outline: LayerConfig
    engrave: LayerConfig
    mark: LayerConfig
    kerf_mm: Positive
    air_assist: bool = True
    exhaust: bool = True
    focus_height_mm: Positive | None = None


class MaterialConfig(Model):
    """One sheet material. `never_cut_because` names the danger where a laser must not touch it; see `danger`."""

    name: str
    E_MPa: Positive
    nu_ratio: Annotated[float, Field(ge=0, lt=0.5)]
    thickness_mm: Positive
    density_kg_m3: Positive
    edge_mm: Positive = 10.0
    slit_mm: Positive = 0.125
    hinge_mm: Positive = 0.25
    laser: LaserPreset | None = None
    never_cut_because: str | None = None

    @property
    def danger(self) -> str | None:
        """Return why a laser must not touch this material: what its file says, else what its name gives away."""
        if self.never_cut_because is not None:
            return self.never_cut_because
        found = CHLORINATED.search(self.name)
        return f"{found[0]!r} in its name says chlorine; {CHLORINE_DANGER}" if found else None


def load_material(name: str, home: Path) -> MaterialConfig:
    """Return the material called `name`, or the one in the file of that path."""
    return load(find("materials", name, home), MaterialConfig)


def sheet_of(material: MaterialConfig) -> Sheet:
    """Return the cell's constants of a material."""
    return Sheet(
        edge_mm=material.edge_mm,
        slit_mm=material.slit_mm,
        hinge_mm=material.hinge_mm,
        thickness_mm=material.thickness_mm,
        E_MPa=material.E_MPa,
        nu_ratio=material.nu_ratio,
        density_kg_m3=material.density_kg_m3,
    )
