"""The specification file: what is asked of a design, with the target and the material by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from design.cells.select import Rule, SelectionOptions
from design.flatten import FlattenOptions
from design.flatten.result import Boundary, HoleChoice, SeamChoice
from design.pattern.assign import Averaging, ScaleOptions, Which
from design.pattern.border import BorderOptions
from design.pattern.slits import HingeOptions, HingeRule
from design.pattern.tiling import Placement
from design.pattern.toolpath import Sides, ToolOptions
from design.spec import DesignSpec, Infeasible, Kind, Region, ResponseOptions, Rim
from design.targets import TARGETS
from fabctl.config.bench import Positive, find, names
from fabctl.config.loader import Model, load

Length = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=0)]
Point = tuple[float, float, float]
RimValue = tuple[float, float, float, Annotated[float, Field(ge=-1, le=1)]]  # u: log of flat over deployed length


class MadeTarget(Model):
    """One of the project's own surfaces, with its measures (`fabctl target make --help` lists them)."""

    make: str
    radius_mm: Positive | None = None
    height_mm: Positive | None = None
    half_angle_deg: Positive | None = None
    edge_mm: Positive | None = None

    @field_validator("make")
    @classmethod
    def _known(cls, make: str) -> str:
        if make not in TARGETS:
            raise ValueError(f"there is no such target (known: {', '.join(sorted(TARGETS))})")
        return make

    def arguments(self) -> dict[str, float]:
        """Return the measures that were given, angles in radians."""
        given = {"radius_mm": self.radius_mm, "height_mm": self.height_mm, "edge_mm": self.edge_mm}
        if self.half_angle_deg is not None:
            given["half_angle_rad"] = math.radians(self.half_angle_deg)
        return {name: value for name, value in given.items() if value is not None}


class FlattenConfig(Model):
    """How the surface is laid flat; with `source: target` the OBJ's own texture coordinates are its flat, in mm."""

    source: Literal["computed", "target"] = "computed"
    boundary: Boundary = "isometric"
    modes_count: Count = 24
    holes: HoleChoice = "auto"
    seam: SeamChoice = "auto"
    cut_mm: Annotated[tuple[Point, ...], Field(min_length=2)] | None = None
    cones_count: Count = 0
    rim_u: Annotated[tuple[RimValue, ...], Field(min_length=1)] | None = None  # x, y, z on the target in mm, and u

    @model_validator(mode="after")
    def _values_where_prescribed(self) -> FlattenConfig:
        if (self.boundary == "prescribed") != (self.rim_u is not None):
            raise ValueError("`rim_u` (rows of x, y, z, u) belongs to `boundary: prescribed`, and to nothing else")
        if self.rim_u is not None and (self.cones_count or self.cut_mm is not None):
            raise ValueError("`rim_u` goes with neither `cones_count` nor `cut_mm`, which make rims of their own")
        return self

    @model_validator(mode="after")
    def _given_is_taken_as_it_is(self) -> FlattenConfig:
        if self.source == "target" and self.model_fields_set != {"source"}:
            raise ValueError("`source: target` takes the file's flat as it is; no other key of `flatten` applies")
        return self


class ScaleConfig(Model):
    """Which end of the library's expansions the design takes."""

    end: Which = "high"
    high_ratio: Positive | None = None

    @model_validator(mode="after")
    def _value_given(self) -> ScaleConfig:
        if (self.end == "value") != (self.high_ratio is not None):
            raise ValueError("`high_ratio` belongs to `end: value`, and to nothing else")
        return self


class SelectionConfig(Model):
    """How a cell is chosen for its expansion."""

    rule: Rule = "smooth"
    max_stiffness_loss_frac: Share = 0.05
    barrier_floor_mJ: Length = 0.0


class HingeConfig(Model):
    """How wide hinges are; without a width, the library's own, so that its predictions hold."""

    rule: HingeRule = "constant"
    width_mm: Positive | None = None
    added_mm: Length = 0.125


class RegionConfig(Model):
    """A circle of cells that are not as the others, from the middle of the cells' box."""

    x_mm: float
    y_mm: float
    radius_mm: Positive


class BorderConfig(Model):
    """What is added around the cells."""

    margin_mm: Length = 0.0
    marks: bool = True
    mark_mm: Positive = 4.0
    sheet_margin_mm: Length = 10.0
    id_height_mm: Length = 3.0
    id_width_mm: Positive = 16.0
    code_module_mm: Length = 0.8


class ToolConfig(Model):
    """How the beam goes about it; the kerf is the material's unless it is given here."""

    kerf_mm: Positive | None = None
    slit_width_mm: Positive | None = None
    slit_sides: Sides = "auto"
    lead_in_mm: Length = 1.0
    overcut_mm: Length = 0.3
    tabs_count: Count = 0
    tab_mm: Positive = 0.4
    spread_mm: Length = 0.0


class ResponseConfig(Model):
    """The indentation to predict."""

    indenter_radius_mm: Positive = 8.0
    depth_mm: Positive = 6.0
    steps_count: Annotated[int, Field(ge=4, le=400)] = 16
    point_mm: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Where the names in a specification are looked for: the lab, and the specification's own folder.

    `beside` is None where another target than the file's is taken.
    """

    home: Path
    beside: Path | None


class SpecConfig(Model):
    """One design, asked for. `target` is a mesh file (relative to this file), or one of the project's own surfaces."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    target: str | MadeTarget
    material: str = "natural-rubber-2.3"
    cells: Kind = "expanding"
    cell_mm: Positive | None = None
    library: str | None = None
    flatten: FlattenConfig = FlattenConfig()
    infeasible: Infeasible = "report"
    averaging: Averaging = "exact"
    scale: ScaleConfig = ScaleConfig()
    selection: SelectionConfig = SelectionConfig()
    placement: Placement = "optimised"
    hinge: HingeConfig = HingeConfig()
    passive: tuple[RegionConfig, ...] = ()
    monostable: tuple[RegionConfig, ...] = ()
    border: BorderConfig = BorderConfig()
    tool: ToolConfig = ToolConfig()
    bed_mm: tuple[Positive, Positive] | None = None
    compensate: bool | Rim = False
    response: ResponseConfig | None = ResponseConfig()

    @field_validator("material")
    @classmethod
    def _material_known(cls, name: str, info: ValidationInfo) -> str:
        if isinstance(info.context, Surroundings):
            home, is_file = info.context.home, Path(name).is_file()
            if not is_file and name not in (known := names("materials", home)):
                raise ValueError(f"there is no such material (known: {', '.join(known)})")
        return name

    @field_validator("target")
    @classmethod
    def _target_there(cls, target: str | MadeTarget, info: ValidationInfo) -> str | MadeTarget:
        beside = info.context.beside if isinstance(info.context, Surroundings) else None
        if beside is None or not isinstance(target, str) or (beside / target).exists() or Path(target).exists():
            return target
        raise ValueError("there is no such file, neither beside the specification nor from here")

    @model_validator(mode="after")
    def _contracting_cells_as_simulated(self) -> SpecConfig:
        if self.cells == "expanding":
            return self
        wrong = {
            "`hinge`: theirs follow from `cell_mm`": self.hinge != HingeConfig(),
            "`monostable` regions: none of them is known to spring open": bool(self.monostable),
            "`selection.rule: published`: it is for expanding cells": self.selection.rule == "published",
        }
        faults = [text for text, is_so in wrong.items() if is_so]
        if faults:
            raise ValueError("`cells: contracting` takes no " + "; no ".join(faults))
        return self

    def to_design(self, cell_mm: float, hinge_mm: float, kerf_mm: float) -> DesignSpec:
        """Return the specification as the design package knows it; what the file leaves open comes from the material.

        `hinge_mm` belongs to cells of `cell_mm`.
        """
        tool: dict[str, Any] = self.tool.model_dump(exclude={"kerf_mm", "spread_mm"})
        hinge = self.hinge.width_mm if self.hinge.width_mm is not None else hinge_mm
        return DesignSpec(
            name=self.name,
            cells=self.cells,
            cell_mm=cell_mm,
            flatten=FlattenOptions(**self.flatten.model_dump(exclude={"source", "cut_mm", "rim_u"})),
            infeasible=self.infeasible,
            averaging=self.averaging,
            scale=ScaleOptions(self.scale.end, self.scale.high_ratio),
            selection=SelectionOptions(**self.selection.model_dump()),
            placement=self.placement,
            hinge=HingeOptions(self.hinge.rule, hinge, self.hinge.added_mm),
            passive=tuple(Region(**region.model_dump()) for region in self.passive),
            monostable=tuple(Region(**region.model_dump()) for region in self.monostable),
            border=BorderOptions(**self.border.model_dump()),
            tool=ToolOptions(kerf_mm=self.tool.kerf_mm or kerf_mm, **tool),
            spread_mm=self.tool.spread_mm,
            bed_mm=self.bed_mm,
            compensate=self.compensate,
            response=ResponseOptions(**self.response.model_dump()) if self.response else None,
        )


def load_spec(name: str, home: Path, target: Path | None = None) -> tuple[SpecConfig, Path]:
    """Return the specification called `name` (a path, or a name in `configs/specs`) and the file it came from.

    The names in it are looked up with all else that is checked; that of its target unless `target` takes its place.
    """
    path = find("specs", name, home)
    return load(path, SpecConfig, Surroundings(home, path.parent if target is None else None)), path
