"""What goes wrong with a rig that answers: it stopped by itself, it refused, or nobody knows whether it moved."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.errors import DeviceError, DeviceRefused


class RigFaulted(DeviceError):
    """The controller stopped the stage by itself; the fault stays latched until it is cleared."""

    def __init__(self, faults: tuple[str, ...], position_mm: float, force_N: float) -> None:
        super().__init__(faults, position_mm, force_N)
        self.faults, self.position_mm, self.force_N = faults, position_mm, force_N

    def __str__(self) -> str:
        return (
            f"rig: the controller stopped the stage: {', '.join(self.faults) or 'fault'} at {self.position_mm:.3f} mm, "
            f"{self.force_N:.3f} N gross; look at the specimen, then `fabctl rig clear` and `fabctl rig retract`"
        )


class MotionUnknown(DeviceError):
    """A motion command was sent and its arrival could not be confirmed. The stage was told to stop."""

    def __init__(self, command: str, number: int, stopped: bool) -> None:
        super().__init__(command, number, stopped)
        self.command, self.number, self.stopped = command, number, stopped

    def __str__(self) -> str:
        after = "the stage was stopped" if self.stopped else "the stage did NOT confirm the stop: press the e-stop"
        return f"rig: whether {self.command} (command {self.number}) was executed is not known; {after}"


def refused(command: str, values: Mapping[str, float], reason: str) -> DeviceRefused:
    """Return the error of a command that the controller refused, with what to do."""
    said = ", ".join(f"{name} {value:g}" for name, value in values.items())
    return DeviceRefused("rig", f"{command} {said}".strip(), reason, HINTS.get(reason, ""))


HINTS = {
    "not_armed": "arm first",
    "faulted": "see `fabctl rig info`, remove the cause, then `fabctl rig clear`",
    "not_homed": "fabctl rig home",
    "outside_travel": "choose a target inside the limits",
    "not_at_safe_height": "retract first",
    "id_not_newer": "another host commands this rig",
}
