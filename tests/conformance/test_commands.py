"""Every command can answer in JSON, says what it does, and stands in the reference."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from fabctl.cli.main import NOUNS, cli

ROOT = Path(__file__).resolve().parents[2]
# These talk to a terminal and return nothing to read.
WITHOUT_JSON = {"fabctl laser console"}


def leaves(command: click.Command, ctx: click.Context) -> Iterator[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        yield ctx.command_path, command
        return
    for name in command.list_commands(ctx):
        found = command.get_command(ctx, name)
        assert found is not None
        yield from leaves(found, click.Context(found, info_name=name, parent=ctx))


def every_command() -> list[tuple[str, click.Command]]:
    return list(leaves(cli, click.Context(cli, info_name="fabctl")))


def test_every_noun_has_a_command() -> None:
    assert {path.split()[1] for path, _ in every_command()} == set(NOUNS)


def test_every_command_offers_json() -> None:
    bare = [path for path, found in every_command() if "--json" not in {o for p in found.params for o in p.opts}]
    assert set(bare) - WITHOUT_JSON == set()


def test_every_command_says_what_it_does() -> None:
    assert [path for path, found in every_command() if not found.help] == []


@pytest.mark.parametrize("name", ["README.md", "docs/bench.md", "docs/ci.md"])
def test_every_command_a_page_names_exists(name: str) -> None:
    known = {tuple(path.split()[1:3]) for path, _ in every_command()}
    nouns = {words[0] for words in known}
    text = (ROOT / name).read_text()
    named = [part.split("`")[0].split()[1:3] for part in text.split("`")[1::2] if part.startswith("fabctl ")]
    for words in named:
        assert words[0] in nouns | {"--help"}, f"{name} names fabctl {' '.join(words)}"


def test_every_number_on_the_command_line_has_two_ends() -> None:
    ranges = click.FloatRange | click.IntRange
    numbers = [
        (path, param.opts[-1], kind)
        for path, found in every_command()
        for param in found.params
        for kind in (param.type.types if isinstance(param.type, click.Tuple) else [param.type])
        if isinstance(kind, click.types.FloatParamType | click.types.IntParamType)
    ]
    assert len(numbers) > 40
    assert [n for n in numbers if not isinstance(n[2], ranges) or n[2].min is None or n[2].max is None] == []


def test_every_option_says_what_it_is() -> None:
    options = [(path, p) for path, found in every_command() for p in found.params if isinstance(p, click.Option)]
    assert [(path, p.opts[-1]) for path, p in options if not p.help] == []
