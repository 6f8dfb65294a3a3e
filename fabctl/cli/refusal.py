"""What a refusal or a failure is in numbers: its exit code, and the one JSON object that `--json` prints for it."""

from __future__ import annotations

import contextlib
import errno
import math
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import click

from design.errors import DesignError, NotConverged, OutOfLibrary, UnreadableFile
from design.findings import Finding
from drivers.errors import DeviceAlarm, DeviceError, DeviceTimeout, TransportError
from fabctl.errors import BUG, DEVICE, OPERATOR, OUT_OF_TOLERANCE, REFUSED, USAGE, ConfigError, FabctlError

STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EFBIG)  # the disk's fault, not the asker's
FINDING = {"code", "level", "where", "message", "hint"}  # the keys of `Finding.as_dict`
OUT_OF_RANGE = re.compile(r"(\S+) is not in the range|'([^']+)' is not a valid")
UNIT = re.compile(r"_(mm_s|mm_N|mm|deg|degc|s|frac|ratio|N|g)$")

Measure = tuple[Any, str, Any]
MEASURES: dict[type[BaseException], Callable[[Any], Measure]] = {
    OutOfLibrary: lambda f: ([f.low_ratio, f.high_ratio], "ratio", list(f.limits_ratio)),
    NotConverged: lambda f: (f.residual_ratio, "ratio", None),
    DeviceTimeout: lambda f: (f.waited_s, "s", f.waited_s),
    DeviceAlarm: lambda f: (f.code, "", None),
}


def exit_code_of(fault: BaseException) -> int:
    """Return what the program ends with after `fault` (`fabctl.errors` lists the codes)."""
    if isinstance(fault, FabctlError):
        return fault.exit_code
    if isinstance(fault, DeviceError):
        return DEVICE
    if isinstance(fault, UnreadableFile):
        return USAGE
    if isinstance(fault, DesignError):
        return REFUSED
    if isinstance(fault, click.exceptions.Abort | KeyboardInterrupt):
        return OPERATOR
    if isinstance(fault, click.ClickException):
        return USAGE
    if isinstance(fault, OSError):
        return DEVICE if fault.errno in STORAGE else USAGE
    return BUG


def sentence_of(fault: BaseException) -> str:
    """Return what is told a person."""
    if isinstance(fault, click.ClickException):
        return fault.format_message()
    if isinstance(fault, click.exceptions.Abort | KeyboardInterrupt):
        return "stopped by the operator"
    if isinstance(fault, OSError) and not isinstance(fault, DeviceError):
        return f"{fault.filename or 'storage'}: {words_of(fault)}"
    return "\n".join([str(fault), *getattr(fault, "__notes__", ())])  # what can be done about it, where that is known


def words_of(fault: OSError) -> str:
    """Return the system's word for what went wrong, without its number."""
    return (fault.strerror or str(fault)).lower()


def refusal(fault: BaseException) -> dict[str, Any]:
    """Return the object that `--json` prints where a command refuses or fails.

    `error` is the whole in a sentence, `exit_code` the process's own, and each of `findings` says `code`, `level`,
    `where`, `what`, `remedy`, and in numbers `value` against `limit` in `unit`, null where there are none.
    """
    first = sentence_of(fault).splitlines() or [type(fault).__name__]
    return {"error": first[0], "exit_code": exit_code_of(fault), "findings": list(_findings(fault))}


def answer_no(data: Mapping[str, Any], code: int, why: str) -> dict[str, Any]:
    """Return the result of a command whose answer is a no, with what every refusal says; `data` may name findings."""
    words = {USAGE: "USAGE", REFUSED: "REFUSED", DEVICE: "DEVICE", OUT_OF_TOLERANCE: "OUT-OF-TOLERANCE"}
    findings = data.get("findings") or [Finding(words.get(code, "FAILED"), why).as_dict()]
    return {"error": why, "exit_code": code, **data, "findings": findings}


def no_in_words(data: Mapping[str, Any], why: str) -> Iterator[str]:
    """Yield for a person what a result that is a no says, where the result itself goes to a program."""
    yield f"fabctl: {why}"
    for row in data.get("findings") or ():
        if row["level"] == "error":
            found = Finding(row["code"], row["message"], row["level"], row["where"], row["hint"])
            yield f"  {found}"


def _findings(fault: BaseException) -> Iterator[dict[str, Any]]:
    carried: tuple[Finding, ...] = getattr(fault, "findings", ())
    if isinstance(fault, ConfigError):
        yield from map(_complaint, fault.complaints)
    elif type(fault) in MEASURES or not any(found.level == "error" for found in carried):
        yield _itself(fault)
    for found in carried:
        yield told(found.as_dict())


def _itself(fault: BaseException) -> dict[str, Any]:
    value, unit, limit = MEASURES[type(fault)](fault) if type(fault) in MEASURES else (None, "", None)
    where, remedy = "", str(getattr(fault, "hint", ""))
    if isinstance(fault, click.BadParameter):
        value, unit, limit = _asked(fault)
    if isinstance(fault, click.UsageError) and fault.ctx is not None:
        where, remedy = _parameter(fault), f"{fault.ctx.command_path} --help"
    elif isinstance(fault, OSError) and fault.filename:
        where = str(fault.filename)
    elif isinstance(fault, TransportError):
        where = fault.url
    row = {"code": code_of(fault), "level": "error", "where": where, "message": sentence_of(fault), "hint": remedy}
    return told({**row, "value": value, "unit": unit, "limit": limit})


def code_of(fault: BaseException) -> str:
    """Return a stable word for the kind of fault: `OutOfLibrary` is OUT-OF-LIBRARY."""
    if isinstance(fault, click.UsageError):
        return "USAGE"
    if isinstance(fault, click.exceptions.Abort | KeyboardInterrupt):
        return "STOPPED"
    if isinstance(fault.__cause__, OSError) and fault.__cause__.errno in STORAGE:
        return "STORAGE"
    if isinstance(fault, OSError) and not isinstance(fault, DeviceError):
        return "STORAGE" if fault.errno in STORAGE else "FILE"
    if exit_code_of(fault) == BUG:
        return "BUG"
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", type(fault).__name__.lstrip("_").removesuffix("Error")).upper()


def _complaint(text: str) -> dict[str, Any]:
    place = re.match(r"(.+?:\d+): (.*)", text, re.S) or re.match(r"([^:]+): (.*)", text, re.S)
    where, what = (place[1], place[2]) if place else ("", text)
    return told({"code": "CONFIG", "level": "error", "where": where, "message": what, "hint": ""})


def _parameter(fault: click.UsageError) -> str:
    param = getattr(fault, "param", None)
    return param.opts[-1] if isinstance(param, click.Option) else getattr(param, "human_readable_name", "") or ""


def _asked(fault: click.BadParameter) -> Measure:
    """Return the value that was refused, its unit, and the range it should be in, where click tells them."""
    found = OUT_OF_RANGE.match(fault.message)
    value: Any = (found[1] or found[2]) if found else None
    with contextlib.suppress(TypeError, ValueError):
        value = float(value)
    kind = getattr(fault.param, "type", None)
    ends = [getattr(kind, "min", None), getattr(kind, "max", None)]
    unit = UNIT.search(getattr(fault.param, "name", None) or "")
    return value, unit[1] if unit and isinstance(value, float) else "", None if ends == [None, None] else ends


def told(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return a finding as `--json` shows it, in every command."""
    return {
        "code": found["code"],
        "level": found["level"],
        "where": found["where"],
        "what": found["message"],
        "value": found.get("value"),
        "unit": found.get("unit") or None,
        "limit": found.get("limit"),
        "remedy": found["hint"] or None,
    }


def plain(data: Any) -> Any:
    """Return `data` as JSON can say it: findings in their one shape, and null for what is no number."""
    if isinstance(data, Mapping):
        if set(data) >= FINDING:
            data = told(data)
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [plain(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
