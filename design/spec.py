"""What a person asks of a design, as plain data. The YAML form lives in `fabctl/config/spec.py`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from design.cells.select import SelectionOptions
from design.flatten import FlattenOptions
from design.flatten.ladder import Remedy
from design.pattern.assign import Averaging, ScaleOptions
from design.pattern.border import BorderOptions
from design.pattern.slits import HingeOptions
from design.pattern.tiling import Placement
from design.pattern.toolpath import ToolOptions

Kind = Literal["expanding", "contracting"]
Rim = Literal["held", "no-slip", "slip", "coulomb"]
Infeasible = Literal["report", "cones", "nearest", "both"]


@dataclass(frozen=True, slots=True)
class Region:
    """A circle of cells that are not as the others. `x_mm`, `y_mm` from the middle of the cells' box."""

    x_mm: float
    y_mm: float
    radius_mm: float


@dataclass(frozen=True, slots=True)
class ResponseOptions:
    """The indentation to predict: a rigid sphere pressed at the apex, or at a point of the target's frame."""

    indenter_radius_mm: float = 8.0
    depth_mm: float = 6.0
    steps_count: int = 16
    point_mm: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class DesignSpec:
    """A design, asked for. Lengths in mm; `bed_mm` is the largest sheet the laser takes, None for no limit."""

    name: str
    cells: Kind = "expanding"
    cell_mm: float = 10.0
    flatten: FlattenOptions = field(default_factory=FlattenOptions)
    infeasible: Infeasible = "report"
    averaging: Averaging = "exact"
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    placement: Placement = "optimised"
    hinge: HingeOptions | None = None  # None: the library's own
    passive: tuple[Region, ...] = ()  # not cut: flat and stiff
    monostable: tuple[Region, ...] = ()  # cut, but they spring back
    border: BorderOptions = field(default_factory=BorderOptions)
    tool: ToolOptions = field(default_factory=ToolOptions)
    spread_mm: float = 0.0
    bed_mm: tuple[float, float] | None = None
    compensate: bool | Rim = False  # change expansions so that the sheet at rest meets the target; a rim: under weight
    response: ResponseOptions | None = field(default_factory=ResponseOptions)

    def remedy(self) -> Remedy:
        """Return what the ladder tries where no cone-free sheet fits."""
        return "none" if self.infeasible == "report" else self.infeasible
