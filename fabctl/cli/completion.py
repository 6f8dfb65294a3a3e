"""`fabctl completion`: the script that a shell sources to complete commands."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from fabctl.cli.common import json_option, show


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@json_option
def command(shell: str, as_json: bool) -> None:
    """Print the completion script of SHELL; source it, or put it where the shell looks.

    bash: fabctl completion bash > ~/.local/share/bash-completion/completions/fabctl
    """
    kind = get_completion_class(shell)
    assert kind is not None  # the three names above are click's own
    source = kind(click.Group("fabctl"), {}, "fabctl", "_FABCTL_COMPLETE").source()
    show({"shell": shell, "script": source}, as_json, [source])
