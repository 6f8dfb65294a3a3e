"""The rig's calibrations: the load cell against masses, the frame against a rigid block. Fitting is pure.

A bench's current calibration lies in `calibrations/<bench>.json`; each run copies it, so that a result never changes
because somebody calibrated later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from design.findings import Finding
from fabctl.config.loader import Model, load
from fabctl.errors import ConfigError
from fabctl.records.folder import as_json, write_atomically

VALID_DAYS = 365
GRAVITY_N_KG = 9.80665


@dataclass(frozen=True, slots=True)
class Line:
    """A fitted line with the standard errors of slope and offset, and the scatter about it."""

    slope: float
    slope_se: float
    offset: float
    offset_se: float
    scatter: float
    degrees_count: int


def _dated(text: str) -> str:
    when = datetime.fromisoformat(text)
    if when.tzinfo is None or when > datetime.now(UTC) + timedelta(days=1):
        raise ValueError("a date in the past with its offset from UTC was expected")
    return text


Utc = Annotated[str, AfterValidator(_dated)]
Gain = Annotated[float, Field(gt=0.5, lt=2)]
NotNegative = Annotated[float, Field(ge=0)]
Days = Annotated[int, Field(ge=1, le=36_500)]


class Calibration(Model):
    """What is known of a rig. `gain_ratio` is shown over true force; both figures have a standard error and a date."""

    gain_ratio: Gain | None = None
    gain_se_ratio: NotNegative | None = None
    force_run: str | None = None
    force_utc: Utc | None = None
    compliance_mm_N: NotNegative | None = None
    compliance_se_mm_N: NotNegative | None = None
    frame_run: str | None = None
    frame_utc: Utc | None = None
    valid_days_count: Days = VALID_DAYS
    force_valid_days_count: Days | None = None  # each its own; None: as `valid_days_count` says
    frame_valid_days_count: Days | None = None

    def ends(self, word: Literal["force", "frame"]) -> datetime | None:
        """Return when the calibration of force or frame is past its date, None where there is none."""
        date = self.force_utc if word == "force" else self.frame_utc
        days_count = self.force_valid_days_count if word == "force" else self.frame_valid_days_count
        if date is None:
            return None
        days_count = self.valid_days_count if days_count is None else days_count
        return datetime.fromisoformat(date) + timedelta(days=days_count)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON."""
        return self.model_dump()

    def findings(self, now: datetime | None = None) -> list[Finding]:
        """Return what is missing or past its date."""
        found = []
        words: tuple[tuple[str, float | None, Literal["force", "frame"]], ...] = (
            ("load cell", self.gain_ratio, "force"),
            ("frame", self.compliance_mm_N, "frame"),
        )
        for what, value, word in words:
            ends = self.ends(word)
            if value is None or ends is None:
                found.append(
                    Finding(f"RIG-NO-{word.upper()}", f"the {what} is not calibrated", "warning", hint=_hint(word))
                )
                continue
            if (now or datetime.now(UTC)) > ends:
                text = f"the calibration of the {what} ended on {ends.date()}"
                found.append(Finding(f"RIG-{word.upper()}-EXPIRED", text, "warning", hint=_hint(word)))
        return found


def _hint(word: str) -> str:
    return f"fabctl rig calibrate {word}"


def fit_line(x: Sequence[float], y: Sequence[float]) -> Line:
    """Return the least-squares line through at least three points."""
    if len(x) < 3:
        raise ValueError(f"{len(x)} points do not show how well a line fits; give at least three")
    design = np.column_stack([np.asarray(x, float), np.ones(len(x))])
    (slope, offset), *_ = np.linalg.lstsq(design, np.asarray(y, float), rcond=None)
    residual = np.asarray(y, float) - design @ [slope, offset]
    degrees = len(x) - 2
    variance = float(residual @ residual) / degrees
    covariance = np.linalg.inv(design.T @ design) * variance
    return Line(
        float(slope),
        float(covariance[0, 0] ** 0.5),
        float(offset),
        float(covariance[1, 1] ** 0.5),
        variance**0.5,
        degrees,
    )


def calibration_path(home: Path, bench: str) -> Path:
    """Return where a bench's calibration lies."""
    return home / "calibrations" / f"{bench}.json"


def load_calibration(home: Path, bench: str) -> Calibration | None:
    """Return the bench's calibration, None where there is none; raise `ConfigError` with all that is wrong in it."""
    path = calibration_path(home, bench)
    if not path.exists():
        return None
    try:
        return load(path, Calibration)
    except ConfigError as fault:
        way_out = f"put {path} away, then: {_hint('force')}, and {_hint('frame')}"
        raise ConfigError([*fault.complaints, way_out]) from fault


def save_calibration(home: Path, bench: str, calibration: Calibration) -> Path:
    """Make `calibration` the bench's current one."""
    path = calibration_path(home, bench)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, as_json(calibration.as_dict()))
    return path
