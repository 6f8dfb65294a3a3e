"""YAML to frozen pydantic models, with the line of every fault.

`yaml.compose` keeps the marks and shows duplicate keys, which `yaml.safe_load` swallows. Scalars follow YAML 1.2's core
schema as people expect it: `1e3` is a number and `on` is a word.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from fabctl.errors import ConfigError, UsageError
from fabctl.files import text_of

INT = re.compile(r"[-+]?[0-9]+")
FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
DIGITS_COUNT = 19  # longer ones are nobody's measure: they become floats, and Python refuses to read very long integers
WORDS: dict[str, bool | None] = {"true": True, "false": False, "null": None, "~": None, "": None}

Marks = dict[tuple[str | int, ...], int]


class Model(BaseModel):
    """Base of every configuration model: frozen, strict, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


def load(path: Path, model: type[M], context: Any = None) -> M:
    """Return the file at `path` as `model`; raise `ConfigError` with all complaints, each `file:line: key: what`.

    `context` is what the model's validators may look at beside the file.
    """
    try:
        return parse(text_of(path, "a YAML file"), model, str(path), context)
    except UsageError as fault:
        raise ConfigError([str(fault)]) from fault


def parse(text: str, model: type[M], name: str, context: Any = None) -> M:
    """Return YAML `text` as `model`; `name` stands in the complaints."""
    marks: Marks = {}
    complaints: list[str] = []
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        data = _value(node, (), marks, complaints, name) if node is not None else {}
    except RecursionError as fault:
        raise ConfigError([f"{name}:1: nested too deeply, or an anchor that holds itself"]) from fault
    except yaml.YAMLError as fault:
        mark = getattr(fault, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise ConfigError([f"{name}{line}: not YAML: {getattr(fault, 'problem', None) or fault}"]) from fault
    if not isinstance(data, dict):
        kind = "a list" if isinstance(data, tuple) else "one value"
        raise ConfigError([f"{name}:1: a mapping of keys was expected, not {kind}"])
    try:
        checked = model.model_validate(data, context=context)
    except ValidationError as fault:
        complaints += _complaints(fault.errors(), data, marks, name)
    if complaints:
        raise ConfigError(sorted(complaints, key=_line_number))
    return checked


def _value(node: yaml.Node, path: tuple[str | int, ...], marks: Marks, complaints: list[str], name: str) -> Any:
    marks[path] = node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        found: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = str(key_node.value)
            if key in found:
                complaints.append(f"{name}:{key_node.start_mark.line + 1}: {_dotted((*path, key))}: given twice")
            found[key] = _value(value_node, (*path, key), marks, complaints, name)
            marks[(*path, key)] = key_node.start_mark.line + 1
        return found
    if isinstance(node, yaml.SequenceNode):
        # Tuples, because the models are frozen and strict.
        return tuple(_value(item, (*path, k), marks, complaints, name) for k, item in enumerate(node.value))
    return _scalar(node)


def _scalar(node: yaml.Node) -> Any:
    text = str(node.value)
    if getattr(node, "style", None) is not None:  # quoted or block: a string by the author's will
        return text
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    if INT.fullmatch(text) and len(text) < DIGITS_COUNT:
        return int(text)
    if FLOAT.fullmatch(text):
        return float(text)
    return text


def _complaints(errors: Sequence[Any], data: Any, marks: Marks, name: str) -> list[str]:
    """Return a line for each error; where a key takes several kinds, only the kind that was meant speaks."""
    found = [(_keys(error, data), error) for error in errors]
    deep = {path[:k] for path, _ in found for k in range(len(path))}
    meant = [(path, error) for path, error in found if not (path in deep and isinstance(error["input"], dict))]
    return list(dict.fromkeys(_complaint(path, error, marks, name) for path, error in meant))


def _keys(error: Any, data: Any) -> tuple[str | int, ...]:
    """Return where `error` lies in the file: pydantic puts names of types between the keys."""
    path: list[str | int] = []
    for key in error["loc"]:
        if key in data if isinstance(data, dict) else isinstance(data, tuple) and isinstance(key, int):
            path.append(key)
            data = data[key]
    return (*path, error["loc"][-1]) if error["type"] == "missing" else tuple(path)


def _complaint(path: tuple[str | int, ...], error: Any, marks: Marks, name: str) -> str:
    line = next((marks[path[:k]] for k in range(len(path), -1, -1) if path[:k] in marks), 1)
    told = {"extra_forbidden": "unknown key", "model_type": "a mapping of keys was expected"}
    text = told.get(error["type"], str(error["msg"]).removeprefix("Value error, "))
    if error["type"] not in ("missing", "extra_forbidden") and not isinstance(error["input"], dict | tuple):
        text += f", not {error['input']!r}"
    return f"{name}:{line}: {_dotted(path)}: {text}" if path else f"{name}:{line}: {text}"


def _line_number(complaint: str) -> int:
    found = re.search(r":(\d+): ", complaint)
    return int(found[1]) if found else 0


def _dotted(path: tuple[str | int, ...]) -> str:
    return ".".join(map(str, path))
