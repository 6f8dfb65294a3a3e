"""`python -m benchmarks NAME [--json] [options of that benchmark]`."""

from __future__ import annotations

import importlib
import json
import pkgutil
import sys
from pathlib import Path

from benchmarks import Figure


def names() -> list[str]:
    """Return every benchmark there is."""
    return sorted(m.name for m in pkgutil.iter_modules([str(Path(__file__).parent)]) if not m.name.startswith("_"))


def main(words: list[str]) -> int:
    """Run the named benchmark and print its figures; 0 where all that is asked is met."""
    as_json = "--json" in words
    words = [word for word in words if word != "--json"]
    if not words or words[0] not in names():
        print(f"usage: python -m benchmarks {{{'|'.join(names())}}} [--json]", file=sys.stderr)
        return 2
    figures: list[Figure] = importlib.import_module(f"benchmarks.{words[0]}").measure(words[1:])
    if as_json or not sys.stdout.isatty():
        print(json.dumps({"figures": [figure.as_dict() for figure in figures]}, indent=1, default=float))
    else:
        for figure in figures:
            mark = {True: "met", False: "MISSED", None: ""}[figure.met]
            print(f"{figure.name:60} {figure.value!s:>14} {figure.unit:8} {figure.target:40} {mark:7} n={figure.n}")
    return 0 if all(figure.met is not False for figure in figures) else 1


sys.exit(main(sys.argv[1:]))
