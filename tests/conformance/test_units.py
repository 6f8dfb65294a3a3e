"""Every float says its unit in its name, in every dataclass and every configuration model."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import re
import typing
from collections.abc import Iterator
from types import ModuleType

import pydantic
import pytest

import design
import drivers
import fabctl
import simulators

UNIT = re.compile(
    r"(_|^)(mm|mm2|mm3|m|px|mm_s|mm_s2|mm_min|mm_px|mm2_N|mm_N|N|mN|kN|N_s|N_mm|N_mm2|Nmm|N_m|MPa|kPa|s|ms|us|ns|Hz|hz|rad|deg|rad_s"
    r"|C|degC|percent|mJ|kg|g|kg_m3|N_mm3|bytes|frac|ratio|count|baud|V|dB|lines_s|per_s|mm_C|cu|1_mm|per_mm|mm2_s2)$"
)
# `cu` is a cloud unit: what a scan without a scale is measured in.
# Mathematics keeps its letters where the formula is in view; an elastic modulus ends in its unit anyway.
LETTERS = {"u", "nu", "mu", "lam", "k", "K", "a", "b", "c", "d", "x", "y", "z"}
# These hold figures in whatever unit they were made of: an interval of a stiffness or of an energy, a line through any
# two quantities, places and what is prescribed there, a finding's measure, a register's scale and limits, a matrix, the
# derivatives of a dimensionless energy.
GENERIC = {
    "Finding.value", "Finding.limit", "FlattenConfig.rim_u",
    "Comparison.scale", "Fit.chi2", "Fit.powers", "PeriodicCell.share", "Response.direction", "Scale.to_board",
    "RegisterConfig.scale", "RegisterConfig.min", "RegisterConfig.max", "Register.low", "Register.high",
    "Delivery.parts", "State.slope", "State.curve_total", "Tangent.slope", "Tangent.curve",
    *(f"Group.{name}" for name in ("mean", "sd", "low", "high")),
    *(f"Line.{name}" for name in ("slope", "slope_se", "offset", "offset_se", "scatter")),
    *(f"Spread.{name}" for name in ("median", "q95", "q99", "worst")),
    *(f"Valued.{name}" for name in ("value", "ci95")),
}  # fmt: skip


def modules(package: ModuleType) -> Iterator[ModuleType]:
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.name.endswith("__main__"):
            yield importlib.import_module(found.name)


def is_float(kind: object) -> bool:
    if kind is float:
        return True
    return any(is_float(part) for part in typing.get_args(kind) if part is not type(None))


def float_fields(module: ModuleType) -> Iterator[tuple[str, str]]:
    for _, cls in inspect.getmembers(module, inspect.isclass):
        if cls.__module__ != module.__name__:
            continue
        if dataclasses.is_dataclass(cls):
            hints = typing.get_type_hints(cls)
            names = [(field.name, hints[field.name]) for field in dataclasses.fields(cls)]
        elif issubclass(cls, pydantic.BaseModel):
            names = [(name, field.annotation) for name, field in cls.model_fields.items()]
        else:
            continue
        yield from ((f"{cls.__qualname__}.{name}", name) for name, kind in names if is_float(kind))


@pytest.mark.parametrize("package", [design, drivers, fabctl, simulators], ids=lambda package: package.__name__)
def test_every_float_field_ends_in_its_unit(package: ModuleType) -> None:
    fields = [field for module in modules(package) for field in float_fields(module)]
    named = [(place, name) for place, name in fields if place not in GENERIC and not name.startswith("_")]
    assert [place for place, name in named if not UNIT.search(name) and name not in LETTERS] == []
