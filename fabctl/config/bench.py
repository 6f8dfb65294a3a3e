"""The bench file: which devices stand on the table, and by what URL each is reached."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from fabctl.config.loader import Model, load
from fabctl.errors import ConfigError

Positive = Annotated[float, Field(gt=0)]


class LaserConfig(Model):
    """A GRBL laser. `url` is serial:///dev/…?baud=115200, tcp://host:port, or ready:NAME for a started simulator."""

    url: str
    travel_mm: tuple[Positive, Positive]
    spot_mm: Positive = 0.1
    max_run_on_s: Annotated[float, Field(ge=0.1, le=600)] = 5.0
    homing: bool = True
    origin_mm: tuple[float, float] = (0.0, 0.0)
    allow_m3: bool = False


class RigConfig(Model):
    """An indentation rig. `map` names the register map in `configs/rigs/`."""

    url: str
    map: str
    travel_mm: Positive
    force_limit_N: Positive
    indenter_radius_mm: Positive
    sample_hz: Positive = 100.0


class ScanConfig(Model):
    """Where clouds come from: a folder that a person drops files into, or a command that makes one."""

    inbox: str | None = None
    command: str | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ScanConfig:
        if (self.inbox is None) == (self.command is None):
            raise ValueError("give either inbox or command")
        return self


def _number_as_text(value: object) -> object:
    """Return a device number, which YAML takes for a number, as text."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class CameraConfig(Model):
    """The bed camera: a device number or path, a URL, or a folder of pictures."""

    url: Annotated[str, BeforeValidator(_number_as_text), Field(min_length=1)]
    calibration: str | None = None


class BenchConfig(Model):
    """One bench, one file. `{state}` in any text stands for the bench's state folder."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    laser: LaserConfig | None = None
    rig: RigConfig | None = None
    scan: ScanConfig | None = None
    camera: CameraConfig | None = None
    specimen_slot: str | None = None
    deployment: Literal["by_hand", "automatic"] = "by_hand"
    simulated: bool = False
    simulators: dict[str, str] = Field(default_factory=dict)

    @property
    def is_simulated(self) -> bool:
        """Return whether its devices are simulators: the file says so, or lists them."""
        return self.simulated or bool(self.simulators)


def find(kind: str, name: str, home: Path) -> Path:
    """Return the file that `name` means: a path, or a name in `configs/<kind>/` of the lab or of the tool."""
    direct = Path(name)
    if direct.suffix in (".yaml", ".yml") and direct.is_file():
        return direct
    for place in _places(kind, home):
        path = place / f"{name}.yaml"
        if path.is_file():
            return path
    wrong = "is a folder" if direct.is_dir() else "is no YAML file" if direct.is_file() else "no such file"
    known = ", ".join(names(kind, home)) or "none"
    raise ConfigError([f"{name}: {wrong}, nor a name in configs/{kind} (known: {known})"])


def names(kind: str, home: Path) -> list[str]:
    """Return the names that `find` knows without a path."""
    return sorted({path.stem for place in _places(kind, home) for path in place.glob("*.yaml")})


def _places(kind: str, home: Path) -> tuple[Path, Path]:
    return home / "configs" / kind, Path(__file__).resolve().parents[2] / "configs" / kind


def load_bench(name: str, home: Path) -> BenchConfig:
    """Return the bench called `name`, or the one in the file of that path."""
    return load(find("benches", name, home), BenchConfig)
