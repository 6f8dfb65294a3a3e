"""Every path and every name on the command line, given wrong in every way: exit code 2, in words, naming the culprit.

The list of parameters is walked from the parser, so a new option is tested the day it comes.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from fabctl.cli.common import run_guarded
from fabctl.cli.main import cli
from fabctl.cli.paths import RUN, SPECIMEN, Name, OutFile, OutFolder
from fabctl.designing import build_folder
from fabctl.errors import DONE, USAGE
from fabctl.records.folder import start_run
from fabctl.workspace import Workspace

# Python's, NumPy's and pydantic's own words: a person at the bench can do nothing with them.
RAW = re.compile(
    r"Traceback|\[Errno|codec can't|pickle|magic string|object is not|indices must|NoneType|has no attribute|"
    r"KeyError|ValueError|TypeError|invalid literal|could not convert|Expecting value|Input should be a valid dict|"
    r"unhashable|not subscriptable|Errno \d"
)
REQUIRED = {  # what a command also needs, so that the bad path is reached
    "target make": ["cap"],
    "laser jog": ["1", "1"],
    "laser frame": ["10", "10"],
    "rig jog": ["1"],
    "specimen note": ["batch=B7"],
    "camera board measured": ["300", "200"],
    "library cell": ["--t-mm", "1.2", "--theta-deg", "3"],
    "camera register": ["--thickness-mm", "2"],
    "cut run": ["--origin", "camera"],
}
PARTNERS = {  # of a parameter that is read only beside others
    "markers": ["--scale", "markers", "--board", "{lab}/points.csv"],
    "board": ["--scale", "markers", "--markers", "{lab}/points.csv"],
    "bars": ["--scale", "markers"],
    "model": ["--scale", "markers"],
    "datum": ["--datum-target", "{lab}/points.csv", "--mode", "datum"],
    "datum_target": ["--datum", "{lab}/points.csv", "--mode", "datum"],
}
# Only the name of these is looked at: a device, a lens or a scan's model would be asked before they are read.
LATE = {("cut run", "image"), ("cut run", "camera_file"), ("camera align", "image"), ("scan run", "pictures")}
ENDINGS = {
    "target": ".obj .ply .stl",
    "path": ".obj .ply .stl",
    "clouds": ".ply .xyz .pcd .las .obj .stl",
    "words": ".ply .xyz .pcd .las",
    "file": ".npz",
    "image": ".png",
    "pictures": ".png",
    "colours": ".ply",
    "coupon_file": ".json",
    "registration": ".json",
    "camera_file": ".json",
}


def leaves(command: click.Command, ctx: click.Context, words: str = "") -> Iterator[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        yield words, command
        return
    for name in command.list_commands(ctx):
        inner = command.get_command(ctx, name)
        assert inner is not None
        yield from leaves(inner, click.Context(inner, info_name=name, parent=ctx), f"{words} {name}".strip())


COMMANDS = dict(leaves(cli, click.Context(cli, info_name="fabctl")))
READ = [
    (words, param)
    for words, command in COMMANDS.items()
    for param in command.params
    if isinstance(param.type, click.Path | Name) and not isinstance(param.type, OutFile | OutFolder)
]
WRITTEN = [
    (words, param)
    for words, command in COMMANDS.items()
    for param in command.params
    if isinstance(param.type, OutFile | OutFolder)
]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a lab's folder in which every command finds the other things it needs."""
    home = tmp_path_factory.mktemp("lab")
    build_folder("cap", home / "design", home, cell_mm=20.0)
    place = Workspace(home)
    specimen = place.new_specimen(home / "design")
    for kind in ("cut", "scan"):
        config = {"placement": [[1, 0, 0], [0, 1, 0]], "material": {"thickness_mm": 2}}
        run = start_run(place.runs, kind, specimen=specimen.name, config=config)
        (home / f"{kind}.run").write_text(run.run_id)
        run.finish("done")
    rng = np.random.default_rng(1)
    np.savetxt(home / "cloud.xyz", rng.random((500, 3)))
    (home / "points.csv").write_text("1,0,0,0\n2,1,0,0\n3,0,1,0\n4,0,0,1\n")
    (home / "form.csv").write_text("patch\n1\n")
    (home / "picture.png").write_bytes((home / "design/preview.png").read_bytes())
    runs = CliRunner()
    for kind in ("bed", "registration", "scale"):
        words = ["--home", str(home), "camera", "board", "marks", kind, "--size-mm", "300x200"]
        assert runs.invoke(cli, words, catch_exceptions=False).exit_code == DONE
    assert runs.invoke(cli, ["--home", str(home), "camera", "board", "charuco"]).exit_code == DONE
    coupon = ["kerf", "coupon", "--material", "natural-rubber-2.3", "-o", str(home / "coupon")]
    assert runs.invoke(cli, ["--home", str(home), *coupon]).exit_code == DONE
    return home


def good(name: str, lab: Path) -> list[str]:
    """Return a word that is right for the parameter called `name`."""
    known = {
        "target": lab / "design/target.ply",
        "path": lab / "design/target.ply",
        "design": lab / "design",
        "a": lab / "design",
        "b": lab / "design",
        "form": lab / "form.csv",
        "measured": lab / "design/response.csv",
        "response": lab / "design/response.csv",
        "published": lab / "form.csv",
        "image": lab / "picture.png",
        "coupon_file": lab / "coupon/coupon.json",
        "folder": lab / "coupon",
        "clouds": lab / "cloud.xyz",
        "material": "natural-rubber-2.3",
        "spec": "cap",
        "words": "S-0001",
        "specimen": "S-0001",
        "board": "bed",
    }
    if name in ("first", "second", "run"):
        return [(lab / "scan.run").read_text()]
    return ["S-0001" if name == "name" else str(known[name])]


def line(words: str, tested: click.Parameter, value: str, lab: Path) -> list[str]:
    """Return the command line with `value` for the tested parameter and good words for all others that are needed."""
    found = ["--home", str(lab), *words.split()]
    for param in COMMANDS[words].params:
        if param is not tested and not (param.required and isinstance(param.type, click.Path | Name)):
            continue
        if param is not tested and isinstance(param.type, OutFile | OutFolder):
            word = [str(lab / f"new{(param.type.endings or ('',))[0]}" if isinstance(param.type, OutFile) else "new")]
        else:
            word = [value] if param is tested else good(str(param.name), lab)
        if words == "scan run" and param is tested and param.name == "words":
            word = ["S-0001", value]
        found += [param.opts[-1], *word] if isinstance(param, click.Option) else word
    if words == "scan run" and tested.name != "words":
        found += ["S-0001", str(lab / "cloud.xyz")] if tested.name in ("marks", "bench") else [str(lab / "cloud.xyz")]
        found += [] if tested.name in ("target", "marks", "bench") else ["--target", str(lab / "design/target.ply")]
        found += [word.format(lab=lab) for word in PARTNERS.get(str(tested.name), [])]
    if words == "flow" and tested.name not in ("spec", "specimen"):
        found.append("cap")
    options = {name for param in COMMANDS[words].params for name in param.opts}
    return [*found, *REQUIRED.get(words, []), *(o for o in ("--yes", "--json") if o in options)]


def bad_files(folder: Path, ending: str) -> dict[str, Path]:
    """Return a file of that ending for every way of being wrong."""
    made = {how: folder / f"{how}{ending}" for how in ("missing", "folder", "empty", "random", "list", "other")}
    made["folder"].mkdir()
    made["empty"].touch()
    made["random"].write_bytes(bytes(np.random.default_rng(7).integers(0, 256, 3000, dtype=np.uint8)))
    made["list"].write_text("[]")
    with made["other"].open("wb") as stream:
        np.savez(stream, weights=np.arange(4.0))
    return made


def bad_folders(folder: Path) -> dict[str, Path]:
    """Return a folder for every way of not being a design, a scan's model or its pictures."""
    made = {how: folder / how for how in ("missing", "file", "bare", "list", "random", "hollow")}
    made["file"].write_text("text")
    for how in ("bare", "list", "random", "hollow"):
        made[how].mkdir()
    (made["list"] / "manifest.json").write_text("[]")
    (made["random"] / "manifest.json").write_bytes(b"\xff\xfe\x00\x81")
    (made["hollow"] / "manifest.json").write_text('{"files": 3}')
    return made


def wrong(words: str, param: click.Parameter, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Yield every wrong word for a parameter, with how it is wrong."""
    if param.type in (RUN, SPECIMEN):
        (tmp_path / "bare").mkdir()
        yield from (("unknown", "nobody"), ("bare", str(tmp_path / "bare")), ("missing", str(tmp_path / "gone/run")))
        return
    if isinstance(param.type, Name) and not (words == "scan run" and param.name == "words"):
        yield "unknown", "nobody"
    if isinstance(param.type, click.Path) and not param.type.file_okay:
        yield from ((how, str(path)) for how, path in bad_folders(tmp_path).items())
        return
    default = ".yaml" if isinstance(param.type, Name) else ".csv"
    for ending in ENDINGS.get(str(param.name), default).split():
        (tmp_path / ending[1:]).mkdir()
        yield from ((f"{how}{ending}", str(p)) for how, p in bad_files(tmp_path / ending[1:], ending).items())


def parameters(listed: list[tuple[str, click.Parameter]]) -> list[object]:
    return [pytest.param(words, param, id=f"{words} {param.opts[-1]}") for words, param in listed]


@pytest.mark.parametrize(("words", "param"), parameters(READ))
def test_a_wrong_path_or_name_is_told_in_words(
    words: str,
    param: click.Parameter,
    lab: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for how, value in wrong(words, param, tmp_path):
        monkeypatch.setattr(sys, "argv", ["fabctl", *line(words, param, value, lab)])
        code = run_guarded(cli)
        said = capfd.readouterr()
        assert code == USAGE, f"{how}: exit {code}: {said.err}"
        assert not RAW.search(said.err), f"{how}: {said.err}"
        if not ((words, param.name) in LATE and how.split(".")[0] not in ("missing", "folder", "file", "empty")):
            assert Path(value).name in said.err, f"{how}: {said.err}"
        if "--json" in sys.argv:
            assert json.loads(said.out)["exit_code"] == USAGE, how


@pytest.mark.parametrize(("words", "param"), parameters(WRITTEN))
def test_where_nothing_can_be_written_is_told_before_anything_is_made(
    words: str,
    param: click.Parameter,
    lab: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    ending = (getattr(param.type, "endings", ()) or ("",))[0]
    (tmp_path / "file").write_text("text")
    (tmp_path / f"folder{ending}").mkdir()
    places = [tmp_path / f"file/new{ending}"]
    places.append(tmp_path / f"folder{ending}" if isinstance(param.type, OutFile) else tmp_path / "file")
    for place in places:
        monkeypatch.setattr(sys, "argv", ["fabctl", *line(words, param, str(place), lab)])
        assert run_guarded(cli) == USAGE
        said = capfd.readouterr()
        assert str(tmp_path / "file") in said.err or "directory" in said.err
        assert not RAW.search(said.err)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["file", f"folder{ending}"])


def test_the_walk_finds_the_paths_and_its_exceptions_exist() -> None:
    assert len(READ) > 80
    assert {(words, param.name) for words, param in READ} >= LATE
    assert DONE == 0
