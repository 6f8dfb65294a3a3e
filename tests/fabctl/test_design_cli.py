"""`fabctl design` from the outside: folders, exit codes, everything wrong said at once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from design.bundle import open_bundle
from design.errors import BundleError
from fabctl.designing import build_folder, inputs_for, read_inputs
from fabctl.errors import ConfigError, RefusedError, UsageError
from fabctl.events import Event

SPEC = """
name: small-cap
target: {make: cap, radius_mm: 40, edge_mm: 5}
response: null
placement: centred
"""


def run(words: list[str], home: Path) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "fabctl", "--home", str(home), *words]
    return subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)


def test_build_writes_the_folder_and_prints_json(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(SPEC)
    done = run(["design", "build", str(tmp_path / "spec.yaml"), "-o", str(tmp_path / "cap"), "--json"], tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    bundle = open_bundle(tmp_path / "cap")
    assert found["cells_count"] == len(bundle.cells())
    assert found["sheet_mm"] == list(bundle.drawing().size_mm)
    assert bundle.file("spec.yaml").read_text() == SPEC
    again = run(["design", "build", str(tmp_path / "spec.yaml"), "-o", str(tmp_path / "cap")], tmp_path)
    assert again.returncode == 3
    assert "exists already" in again.stderr


def test_a_specification_with_faults_is_refused_with_all_of_them_and_their_lines(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text("name: x\ntarget: a.obj\ncell_mm: -1\nscale: {end: top}\ntypo: 1\n")
    with pytest.raises(ConfigError) as fault:
        read_inputs(str(tmp_path / "spec.yaml"), tmp_path)
    assert fault.value.exit_code == 2
    for line in ("spec.yaml:3: cell_mm", "spec.yaml:4: scale.end", "spec.yaml:5: typo"):
        assert line in str(fault.value)


@pytest.mark.parametrize("target", ["{make: kap}", "nowhere.obj"])
def test_names_that_mean_nothing_are_told_with_the_other_faults_of_the_file(target: str, tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(f"name: x\ntarget: {target}\nmaterial: rubber\ncell_mm: -1\n")
    with pytest.raises(ConfigError) as fault:
        read_inputs(str(tmp_path / "spec.yaml"), tmp_path)
    lines = fault.value.complaints
    assert all(part in line for part, line in zip((":2: target", ":3: material", ":4: cell_mm"), lines, strict=True))


@pytest.mark.parametrize(
    ("text", "kind", "says"),
    [
        ("name: x\ntarget: {make: spoon}\n", ConfigError, "spoon"),
        ("name: x\ntarget: {make: saddle, half_angle_deg: 20}\n", UsageError, "no such measure"),
        ("name: x\ntarget: {make: cap}\nmaterial: neoprene-2.0\n", RefusedError, "hydrogen chloride"),
        ("name: x\ntarget: nowhere.obj\n", ConfigError, r"spec.yaml:2: target.*nowhere.obj"),
        ("name: x\ntarget: {make: cap}\nscale: {end: value}\n", ConfigError, "high_ratio"),
    ],
)
def test_what_cannot_be_built_is_refused_with_its_reason(
    text: str, kind: type[Exception], says: str, tmp_path: Path
) -> None:
    (tmp_path / "spec.yaml").write_text(text)
    with pytest.raises(kind, match=says):
        read_inputs(str(tmp_path / "spec.yaml"), tmp_path)


def test_a_smaller_cell_scales_slit_and_hinge_and_overrides_the_file(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(SPEC)
    inputs = read_inputs(str(tmp_path / "spec.yaml"), tmp_path, cell_mm=5.0)
    assert inputs.spec.cell_mm == inputs.library.sheet.edge_mm == 5.0
    assert inputs.library.sheet.slit_mm == pytest.approx(0.0625)
    assert inputs.spec.hinge is not None and inputs.spec.hinge.width_mm == pytest.approx(0.125)


@pytest.mark.parametrize("text", [SPEC, SPEC.replace("response: null\n", "")])
def test_a_specification_without_a_response_is_told_what_then_is_missing(text: str, tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(text)
    told = [f for f in read_inputs(str(tmp_path / "spec.yaml"), tmp_path).findings if f.code == "RESPONSE-NONE"]
    assert len(told) == ("null" in text)
    assert all(f.level == "info" and "deployed shape" in f.message for f in told)


def test_a_name_that_is_a_specification_is_checked_as_it_would_be_built(tmp_path: Path) -> None:
    (tmp_path / "configs/specs").mkdir(parents=True)
    (tmp_path / "configs/specs/mine.yaml").write_text(SPEC.replace("small-cap", "mine") + "cell_mm: 8\n")
    assert inputs_for("mine", None, tmp_path).spec.cell_mm == 8
    assert inputs_for("cap", None, tmp_path).spec == read_inputs("cap", tmp_path).spec
    assert inputs_for("cap", None, tmp_path, cells="contracting").spec.cells == "contracting"
    with pytest.raises(UsageError, match="says its material and cells itself"):
        inputs_for("mine", "natural-rubber-2.3", tmp_path)


def test_a_word_that_means_nothing_is_answered_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nosuch: there is no such file.*double-bump.*saddle"):
        inputs_for("nosuch", None, tmp_path)
    with pytest.raises(UsageError, match="is a folder"):
        inputs_for(str(tmp_path), None, tmp_path)


def test_progress_of_a_build_never_goes_back_and_ends_at_all(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(SPEC)
    told: list[float] = []

    def hear(event: Event) -> None:
        told.extend([event.done_frac] if event.done_frac is not None else [])

    build_folder(str(tmp_path / "spec.yaml"), tmp_path / "cap", tmp_path, cell_mm=12.0, emit=hear)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_folder_that_is_taken_is_refused_before_anything_is_computed(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/notes.txt").write_text("mine")
    with pytest.raises(BundleError, match="exists already"):
        build_folder("there is no such specification", tmp_path / "taken", tmp_path)
