"""The kinds of paths and names that commands take: looked at before anything is made, and completed by the shell."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

LOADERS = {
    "benches": "fabctl.config.bench:load_bench",
    "boards": "fabctl.config.boards:load_board",
    "materials": "fabctl.config.material:load_material",
    "methods": "fabctl.config.method:load_method",
    "specs": "fabctl.config.spec:load_spec",
}
PICTURES = (".svg", ".png", ".pdf")
PHOTOS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


class InFile(click.Path):
    """A file to be read: it is there, a regular one, allowed, and not empty."""

    def __init__(self) -> None:
        super().__init__(exists=True, dir_okay=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail where there is nothing to read."""
        path = Path(str(super().convert(value, param, ctx)))
        if not path.is_file():
            self.fail(f"'{value}' is no regular file.", param, ctx)
        if path.stat().st_size == 0:
            self.fail(f"File '{value}' is empty.", param, ctx)
        return path


class InFolder(click.Path):
    """A folder to be read."""

    def __init__(self) -> None:
        super().__init__(exists=True, file_okay=False, path_type=Path)


class OutFile(click.Path):
    """A file to be written: where it goes is a folder, or can become one. `endings`, where given, name its kinds."""

    def __init__(self, endings: Sequence[str] = (), what: str = "a file here") -> None:
        super().__init__(dir_okay=False, path_type=Path)
        self.endings, self.what = tuple(endings), what

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail where nothing can be written there."""
        path = Path(str(super().convert(value, param, ctx)))
        if self.endings and path.suffix.lower() not in self.endings:
            self.fail(f"{value}: {self.what} ends in {', '.join(self.endings)}", param, ctx)
        if wrong := obstacle(path.parent):
            self.fail(f"{value}: {wrong}", param, ctx)
        return path


class OutFolder(click.Path):
    """A folder to be written into: it is one, or can become one."""

    def __init__(self) -> None:
        super().__init__(file_okay=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail where nothing can be written there."""
        path = Path(str(super().convert(value, param, ctx)))
        if wrong := obstacle(path):
            self.fail(f"{value}: {wrong}", param, ctx)
        return path


class PictureFile(OutFile):
    """A picture to be written: `.svg`, `.png` or `.pdf`."""

    def __init__(self, endings: Sequence[str] = PICTURES) -> None:
        super().__init__(endings, "a picture")


class PhotoFile(OutFile):
    """A picture of many grey pixels to be written."""

    def __init__(self) -> None:
        super().__init__(PHOTOS, "a picture")


def obstacle(folder: Path) -> str:
    """Return why nothing can be written into `folder`, which need not be there yet; nothing where it can."""
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        return f"{place} is a file, not a folder"
    return "" if os.access(place, os.W_OK | os.X_OK) else f"you may not write into {place}"


class Name(click.types.StringParamType):
    """A word that stands for something in the lab.

    `known` lists what there is, for the shell; `check` raises where the word stands for nothing, before anything is
    done. Both are given the lab's folder.
    """

    def __init__(
        self, known: Callable[[Path], Iterable[str]], check: Callable[[Path, str], object], files: bool = False
    ) -> None:
        self.known, self.check, self.files = known, check, files

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word as it is."""
        from fabctl.workspace import workspace

        word = super().convert(value, param, ctx)
        if ctx is not None and param is not None and _typed(ctx, param):  # a default may never be needed
            self.check(workspace(ctx.find_root().obj).root, word)
        return word

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the names that begin so, and files where the word may be a path."""
        from fabctl.workspace import workspace

        home = workspace(ctx.find_root().params.get("home")).root
        found = [CompletionItem(name) for name in self.known(home) if name.startswith(incomplete)]
        return [*found, CompletionItem(incomplete, type="file")] if self.files else found


def config_names(kind: str) -> Name:
    """Return the kind of word that is a YAML file, or a name in `configs/<kind>`."""

    def known(home: Path) -> list[str]:
        from fabctl.config.bench import names

        return names(kind, home)

    def check(home: Path, word: str) -> object:
        module, _, loader = LOADERS[kind].partition(":")
        return getattr(importlib.import_module(module), loader)(word, home)

    return Name(known, check, files=True)


def _typed(ctx: click.Context, param: click.Parameter) -> bool:
    return not ctx.resilient_parsing and ctx.get_parameter_source(str(param.name)) == ParameterSource.COMMANDLINE


def _run_names(home: Path) -> list[str]:
    return sorted((path.name for path in (home / "runs").glob("*-*-*")), reverse=True)


def _is_run(home: Path, word: str) -> object:
    from fabctl.workspace import Workspace

    return Workspace(home).run(word)


def _specimen_names(home: Path) -> list[str]:
    return sorted(path.parent.name for path in (home / "specimens").glob("S-*/specimen.json"))


def _is_specimen(home: Path, word: str) -> object:
    from fabctl.workspace import Workspace

    return Workspace(home).specimen(word)


def _target_names(home: Path) -> list[str]:
    from design.targets import TARGETS

    return sorted({*config_names("specs").known(home), *TARGETS})


def _later(home: Path, word: str) -> object:
    return word  # the command itself knows what its word may mean


RUN, SPECIMEN = Name(_run_names, _is_run), Name(_specimen_names, _is_specimen)
RUN_OR_SPECIMEN = Name(lambda home: [*_specimen_names(home), *_run_names(home)], _later)
SPECIMEN_OR_FILE = Name(_specimen_names, _later, files=True)
TARGET = Name(_target_names, _later, files=True)
