"""An interrupted cut is gone on with once, and only from its own design."""

from __future__ import annotations

from pathlib import Path

import pytest

from fabctl.cut.resume import against_resuming
from fabctl.records.folder import RunFolder, start_run
from fabctl.workspace import Specimen, Workspace

BEGUN = '{"t_s": 1.0, "dir": ">", "bytes": "?"}\n{"t_s": 2.0, "dir": "#", "bytes": "program begins"}\n'


@pytest.fixture
def cut(tmp_path: Path) -> tuple[Workspace, Specimen, RunFolder]:
    lab = Workspace(tmp_path / "lab")
    design = tmp_path / "design"
    design.mkdir()
    (design / "manifest.json").write_text('{"name": "dome"}')
    specimen = lab.new_specimen(design)
    return lab, specimen, start_run(lab.runs, "cut", specimen=specimen.name)


def codes(lab: Workspace, run: RunFolder, specimen: Specimen, design: Path) -> list[str]:
    return [finding.code for finding in against_resuming(lab, run, specimen, design)]


def test_the_first_resume_of_its_own_design_is_free(cut: tuple[Workspace, Specimen, RunFolder], tmp_path: Path) -> None:
    lab, specimen, run = cut
    assert codes(lab, run, specimen, tmp_path / "design") == []
    assert codes(lab, run, specimen, specimen.design) == []


@pytest.mark.parametrize("status", ["done", "stopped", "failed", None])
def test_a_second_resume_is_refused_however_the_first_ended(
    cut: tuple[Workspace, Specimen, RunFolder], status: str | None
) -> None:
    lab, specimen, run = cut
    later = start_run(lab.runs, "cut", specimen=specimen.name, config={"resumed": run.run_id})
    (later.path / "wire.log").write_text(BEGUN)
    if status is not None:
        later.finish(status)
    assert codes(lab, run, specimen, specimen.design) == ["RESUME-TWICE"]


@pytest.mark.parametrize("status", ["refused", "stopped", "failed", None])
@pytest.mark.parametrize("log", [None, "", '{"t_s": 1.0, "dir": ">", "bytes": "(program begins)\\n"}\n{"t_s": 2'])
def test_a_resume_whose_program_never_began_counts_for_nothing(
    cut: tuple[Workspace, Specimen, RunFolder], status: str | None, log: str | None
) -> None:
    lab, specimen, run = cut
    later = start_run(lab.runs, "cut", specimen=specimen.name, config={"resumed": run.run_id})
    if log is not None:
        (later.path / "wire.log").write_text(log)
    if status is not None:
        later.finish(status)
    assert codes(lab, run, specimen, specimen.design) == []


def test_another_design_is_refused(cut: tuple[Workspace, Specimen, RunFolder], tmp_path: Path) -> None:
    lab, specimen, run = cut
    other = tmp_path / "other"
    other.mkdir()
    (other / "manifest.json").write_text('{"name": "vase"}')
    assert codes(lab, run, specimen, other) == ["RESUME-DESIGN"]
