"""The file of a test method (`configs/methods/*.yaml`): typed steps, checked before anything moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from fabctl.config.bench import find
from fabctl.config.loader import Model, load

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1, le=10_000)]


class _Reach(Model):
    """How far: to a depth below contact or to a net force, whichever is given."""

    depth_mm: Positive | None = None
    force_N: Positive | None = None
    speed_mm_s: Positive

    @model_validator(mode="after")
    def _one_end(self) -> _Reach:
        if (self.depth_mm is None) == (self.force_N is None):
            raise ValueError("give either depth_mm or force_N")
        return self


class Tare(Model):
    """Average the force over `time_s` with the indenter free, and call that zero."""

    step: Literal["tare"]
    time_s: Positive = 1.0


class Approach(Model):
    """Go down until the net force reaches `trigger_N`, then back off by `clearance_mm`: the start of every curve."""

    step: Literal["approach"]
    speed_mm_s: Positive
    trigger_N: Positive
    clearance_mm: Positive = 0.5
    travel_mm: Positive | None = None


class Preload(Model):
    """Press with a small net force and hold it, so that everything has settled."""

    step: Literal["preload"]
    force_N: Positive
    speed_mm_s: Positive
    time_s: NotNegative = 0.0


class Zero(Model):
    """Call the present position depth zero."""

    step: Literal["zero"]


class Load(_Reach):
    """Press to a depth or a force, at a rate."""

    step: Literal["load"]


class Hold(Model):
    """Stand still, and see the force relax; with `force_N` keep the net force instead, and see the specimen creep."""

    step: Literal["hold"]
    time_s: Positive
    force_N: Positive | None = None
    speed_mm_s: Positive = 0.5


class Unload(Model):
    """Let go: to a depth or a force, else back to the clearance above contact."""

    step: Literal["unload"]
    speed_mm_s: Positive
    depth_mm: NotNegative | None = None
    force_N: Positive | None = None


class Cycles(_Reach):
    """Load, hold and unload, several times; each is one curve. With `condition` they only work the rubber in."""

    step: Literal["cycles"]
    cycles_count: Count
    unload_speed_mm_s: Positive | None = None
    hold_s: NotNegative = 0.0
    rest_s: NotNegative = 0.0
    condition: bool = False


class Wait(Model):
    """Stand, sampling, until the operator says go on."""

    step: Literal["wait"]
    message: str


Simple = Annotated[Tare | Approach | Preload | Zero | Load | Hold | Unload | Cycles | Wait, Field(discriminator="step")]


class Grid(Model):
    """Repeat `steps` at every point (x, y) of the specimen's stage, going from one to the next at the safe height."""

    step: Literal["grid"]
    x_mm: Annotated[tuple[float, ...], Field(min_length=1)]
    y_mm: Annotated[tuple[float, ...], Field(min_length=1)]
    speed_mm_s: Positive = 10.0
    steps: tuple[Simple, ...]


Step = Annotated[
    Tare | Approach | Preload | Zero | Load | Hold | Unload | Cycles | Wait | Grid, Field(discriminator="step")
]


class LimitsConfig(Model):
    """What the controller is told to enforce: gross force, depth below home, and how long it waits for the host."""

    force_N: Positive
    tension_N: Positive = 2.0
    travel_mm: Positive
    watchdog_s: Annotated[float, Field(ge=0.1, le=2)] = 0.5


class MethodConfig(Model):
    """One method, one file."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    description: str = ""
    sample_hz: Annotated[float, Field(gt=0, le=500)] | None = None
    safe_height_mm: NotNegative = 0.5
    travel_speed_mm_s: Positive = 10.0
    acceleration_mm_s2: Annotated[float, Field(gt=0, le=500)] = 50.0
    secant_mm: Positive = 2.0
    limits: LimitsConfig
    steps: tuple[Step, ...]

    @model_validator(mode="after")
    def _does_something(self) -> MethodConfig:
        # Not a field's minimum: pydantic would add that complaint wherever one of the steps is wrong.
        if not self.steps or any(isinstance(step, Grid) and not step.steps for step in self.steps):
            raise ValueError("give at least one step")
        return self


def load_method(name: str, home: Path) -> MethodConfig:
    """Return the method called `name`, or the one in the file of that path."""
    return load(find("methods", name, home), MethodConfig)
