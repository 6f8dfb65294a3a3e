"""What grblHAL and FluidNC number differently from GRBL 1.1: `error:` above 38, `ALARM:` above 9. In our own words."""

from __future__ import annotations

Meaning = tuple[str, str]

_HAL_ERRORS: dict[int, Meaning] = {
    18: ("a reset is under way", "wait for the banner"),
    19: ("a value must be more than zero", "use a positive number"),
    39: ("a value is out of range", "look at the line"),
    40: ("a tool change is waiting", "finish it; a laser job has none"),
    41: ("the spindle is not running", "switch the beam mode on first (M4)"),
    42: ("the plane does not fit the command", "use G17"),
    43: ("the feed is above what the machine allows", "lower F, or raise $110/$111"),
    44: ("the S word is out of range", "keep S within $31 and $30"),
    45: ("a limit switch is pressed", "move off the switch"),
    46: ("the machine must be homed first", "home it"),
    49: ("the board's self-test failed", "switch it off and look at it"),
    50: ("emergency stop is pressed", "release it, then reset"),
    51: ("a motor driver reports a fault", "switch off and look at the drivers"),
    52: ("a setting's value is out of range", "look at the limits the board gives"),
    53: ("the setting is not available in this build", "leave it out"),
    79: ("not possible after a critical event", "reset first"),
}
_HAL_ALARMS: dict[int, Meaning] = {
    10: ("emergency stop is pressed", "release it, then reset and home"),
    11: ("homing is required", "home the machine"),
    12: ("a limit switch is pressed", "move off the switch, then unlock"),
    13: ("the probe was hit outside a probing move", "free the probe"),
    14: ("the spindle or laser driver reports a fault", "look at it before going on"),
    15: ("squaring the doubled axis found no second switch", "check its switches"),
    16: ("the board's self-test failed", "switch it off and look at it"),
    17: ("a motor driver reports a fault", "switch off and look at the drivers"),
    18: ("homing failed", "check the switches, then home again"),
}
_FLUID_ALARMS: dict[int, Meaning] = {
    10: ("the spindle or laser driver does not answer", "look at it before going on"),
    11: ("a control pin was active at power-up", "release the button, then reset"),
    12: ("it is not clear which limit switch is pressed", "move off both by hand"),
    13: ("a hard stop", "find out why, reset and home"),
    14: ("the machine is not homed", "home the machine"),
    15: ("the board has just started", "home or unlock it"),
    16: ("an expander board restarted", "check its cable, reset and home"),
    17: ("a line of the program failed", "look at the line, then start again"),
    18: ("the probe was hit outside a probing move", "free the probe"),
}
ERRORS: dict[str, dict[int, Meaning]] = {"grblHAL": _HAL_ERRORS}
ALARMS: dict[str, dict[int, Meaning]] = {"grblHAL": _HAL_ALARMS, "FluidNC": _FLUID_ALARMS}
