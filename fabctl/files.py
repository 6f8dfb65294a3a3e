"""Files that a person names, opened in one way. **W**

What is wrong with one is told in the same words whoever reads it, and ends with exit code 2: it is not there, a folder,
not allowed, empty, not text, not JSON.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fabctl.errors import UsageError

if TYPE_CHECKING:
    from drivers.camera import Frame


def bytes_of(path: Path, what: str) -> bytes:
    """Return the file's bytes; `what` says which file was expected, such as "a coupon's form"."""
    if path.exists() and not (path.is_file() or path.is_dir()):  # a pipe would be waited for, a device has no end
        raise UsageError(f"{path}: is no regular file; {what} was expected")
    try:
        found = path.read_bytes()
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; {what} was expected") from None
    except IsADirectoryError:
        raise UsageError(f"{path}: is a folder; {what} was expected") from None
    except OSError as fault:
        raise UsageError(f"{path}: cannot be read: {(fault.strerror or 'unknown').lower()}") from fault
    if not found.strip():
        raise UsageError(f"{path}: is empty; {what} was expected")
    return found


def text_of(path: Path, what: str) -> str:
    """Return the file's text."""
    try:
        text = bytes_of(path, what).decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise UsageError(f"{path}: is not text (UTF-8); {what} was expected") from fault
    if "\0" in text:
        raise UsageError(f"{path}: is not text, it holds zero bytes; {what} was expected")
    return text


def json_of(path: Path, what: str) -> dict[str, Any]:
    """Return the object in a JSON file."""
    try:
        found = json.loads(text_of(path, what))
    except json.JSONDecodeError as fault:
        raise UsageError(f"{path}:{fault.lineno}: is not JSON; {what} was expected") from fault
    except (ValueError, RecursionError) as fault:  # digits without end, brackets without end
        raise UsageError(f"{path}: is JSON that nobody wrote; {what} was expected") from fault
    if not isinstance(found, dict):
        raise UsageError(f"{path}: holds no JSON object; {what} was expected")
    return found


def picture_of(path: Path) -> Frame:
    """Return the picture in the file."""
    from drivers.camera import read_picture
    from drivers.errors import TransportError

    bytes_of(path, "a picture")
    try:
        return read_picture(path)
    except TransportError as fault:
        raise UsageError(str(fault)) from fault


def why_not(fault: Exception) -> str:
    """Return what a reader of plain data did not find, in words: a missing key has only its name in Python's."""
    if isinstance(fault, KeyError):
        return f"it says no {fault.args[0]}"
    return str(fault) if isinstance(fault, ValueError) else "its parts are not of the kinds they should be"
