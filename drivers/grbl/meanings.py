"""Every `error:` and `ALARM:` number, with what it means and what to do. In the project's own words."""

from __future__ import annotations

from drivers.grbl import dialects

ERRORS: dict[int, tuple[str, str]] = {
    1: ("a word does not begin with a letter", "look for a stray character in the line"),
    2: ("a letter has no number after it, or the number cannot be read", "complete the word"),
    3: ("the board does not know this $ command", "check the command; other firmware may have it"),
    4: ("a value that must not be negative is", "use zero or more"),
    5: ("homing is switched off", "set $22=1 if the machine has limit switches"),
    6: ("the step pulse is shorter than 3 µs", "set $0 to 3 or more"),
    7: ("the board's memory could not be read; it went back to its defaults", "set $$ again from your notes"),
    8: ("the board must be idle for this", "wait until it has stopped"),
    9: ("the board is locked by an alarm, or is jogging", "home it ($H) or unlock it ($X)"),
    10: ("soft limits need homing", "set $22=1 first"),
    11: ("the line is longer than the board can hold", "shorten it to 79 characters"),
    12: ("a setting asks for more steps per second than the board can make", "lower $100… or $110…"),
    13: ("the safety door is open", "close the door"),
    14: ("the start-up line or build note is too long", "shorten it"),
    15: ("the jog would leave the machine's travel", "jog less far"),
    16: ("a jog may hold only X Y Z F and units", "take the other words out"),
    17: ("laser mode needs a controller with variable output", "this board cannot drive a laser by $32"),
    20: ("a word the board does not support", "take it out of the file"),
    21: ("two words of one modal group in a line", "put them on two lines"),
    22: ("no feed rate has been given", "add an F word"),
    23: ("a command word needs a whole number", "write it without a fraction"),
    24: ("two commands in the line both want the axis words", "put them on two lines"),
    25: ("a letter appears twice in the line", "remove one"),
    26: ("the command needs axis words and has none", "add X, Y or Z"),
    27: ("the line number is out of range", "use 0 to 9999999"),
    28: ("a P or L word is missing", "add it"),
    29: ("there is no such work coordinate system", "use G54 to G59, P0 to P6"),
    30: ("G53 works only with G0 and G1", "use G0 or G1 in the line"),
    31: ("axis words although G80 has cancelled motion", "give a motion command"),
    32: ("an arc without an axis of its plane", "add X or Y"),
    33: ("the target of the arc or probe is impossible", "check the end point and the centre"),
    34: ("the radius of the arc cannot reach its end", "use I and J, or a larger R"),
    35: ("an arc without the centre offset of its plane", "add I or J"),
    36: ("words that nothing in the line uses", "remove them"),
    37: ("a tool length offset on an axis other than the configured one", "use Z"),
    38: ("the tool number is too large", "use 0 to 255"),
}
ALARMS: dict[int, tuple[str, str]] = {
    1: ("a limit switch was hit", "find out why, move off the switch, reset and home"),
    2: ("a move would leave the travel (soft limit)", "reset; check the origin and the size of the design, then home"),
    3: ("reset while moving; steps were lost", "home before anything else"),
    4: ("the probe was already touching before probing began", "free the probe"),
    5: ("the probe met nothing on its way", "check probe and distance"),
    6: ("homing was interrupted by a reset", "home again"),
    7: ("the door was opened during homing", "close it and home again"),
    8: ("the limit switch stayed pressed after pulling off", "raise $27, check the switch"),
    9: ("no limit switch was found while homing", "check the switches, $23 and the travel $130…"),
}
UNKNOWN = ("a number this program does not know", "look it up in the firmware's own list")


def error_meaning(code: int, firmware: str = "grbl") -> tuple[str, str]:
    """Return what `error:code` of this firmware means and what to do."""
    return dialects.ERRORS.get(firmware, {}).get(code) or ERRORS.get(code, UNKNOWN)


def alarm_meaning(code: int, firmware: str = "grbl") -> tuple[str, str]:
    """Return what `ALARM:code` of this firmware means and what to do."""
    return dialects.ALARMS.get(firmware, {}).get(code) or ALARMS.get(code, UNKNOWN)
