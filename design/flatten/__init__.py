"""From a surface to its conformal flat: boundary-first flattening, its checks and its choices."""

from design.flatten.flat import flatten
from design.flatten.ladder import FeasibilityReport, Limits, feasibility
from design.flatten.nearest import Feasible, closest_feasible
from design.flatten.result import Flattening, FlattenOptions, Seam

__all__ = [
    "FeasibilityReport",
    "Feasible",
    "FlattenOptions",
    "Flattening",
    "Limits",
    "Seam",
    "closest_feasible",
    "feasibility",
    "flatten",
]
