"""Write the files that are made from the code: JSON Schemas for editors and the command reference.

`--check` writes nothing and fails where a file on disk is not what the code would make.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

MODELS = {
    "bench": "fabctl.config.bench:BenchConfig",
    "material": "fabctl.config.material:MaterialConfig",
    "method": "fabctl.config.method:MethodConfig",
    "rig": "fabctl.config.rig:RigMapConfig",
    "spec": "fabctl.config.spec:SpecConfig",
}


def schemas() -> Iterator[tuple[str, str]]:
    """Yield path and text of every schema."""
    for name, place in MODELS.items():
        module, _, model = place.partition(":")
        schema = getattr(importlib.import_module(module), model).model_json_schema()
        yield f"configs/schemas/{name}.schema.json", json.dumps(schema, indent=1, sort_keys=True) + "\n"


def reference() -> str:
    """Return the command reference as Markdown: every command with its own help."""
    from fabctl.cli.main import NOUNS, cli

    parts = ["# Commands", "", "Made by `make fresh` from the program itself.", ""]
    root = click.Context(cli, info_name="fabctl")
    for noun in NOUNS:
        command = cli.get_command(root, noun)
        assert command is not None
        parts += _section(command, root, noun, 2)
    return "\n".join(parts).rstrip() + "\n"


def _section(command: click.Command, parent: click.Context, name: str, depth: int) -> list[str]:
    ctx = click.Context(command, info_name=name, parent=parent, terminal_width=100, max_content_width=100)
    lines = [f"{'#' * min(depth, 4)} {ctx.command_path}", "", "```text", command.get_help(ctx).rstrip(), "```", ""]
    if isinstance(command, click.Group):
        for sub in command.list_commands(ctx):
            found = command.get_command(ctx, sub)
            assert found is not None
            lines += _section(found, ctx, sub, depth + 1)
    return lines


def main(words: list[str]) -> int:
    """Write or check; 1 where a check fails."""
    made = dict(schemas()) | {"docs/commands.md": reference()}
    stale = [name for name, text in made.items() if not (ROOT / name).is_file() or (ROOT / name).read_text() != text]
    if "--check" in words:
        for name in stale:
            print(f"{name} is stale; run `make fresh`", file=sys.stderr)
        return 1 if stale else 0
    for name in stale:
        (ROOT / name).parent.mkdir(parents=True, exist_ok=True)
        (ROOT / name).write_text(made[name])
        print(f"wrote {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
