"""From a surface to its conformal flat: boundary-first flattening, its checks and its choices."""

from design.flatten.flat import flatten
from design.flatten.result import Flattening, FlattenOptions, Seam

__all__ = ["FlattenOptions", "Flattening", "Seam", "flatten"]
