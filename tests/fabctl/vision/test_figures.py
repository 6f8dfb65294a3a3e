"""The camera's figures: a part that breaks off is one missed figure, and costs no other part its own."""

from __future__ import annotations

import pytest

from benchmarks import Figure, camera
from fabctl.errors import RefusedError

GOOD = Figure("kept", 1, "", "", True, 1)


def refuse(_: int) -> list[Figure]:
    raise RefusedError("3 of 4 marks", [])


def test_a_part_that_is_refused_is_missed_and_the_others_are_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(camera, "_bed", lambda _: [GOOD])
    monkeypatch.setattr(camera, "_kerf", refuse)
    found = camera.measure(["bed", "kerf", "--quick"])
    assert [(f.name, f.met) for f in found] == [("kept", True), ("kerf: broken off", False)]
    assert "3 of 4 marks" in str(found[1].value)
    assert capsys.readouterr().err.count("\n") == 2


def test_every_figure_is_told_as_soon_as_its_part_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told: list[str] = []

    def later(_: int) -> list[Figure]:
        told.append(capsys.readouterr().err)
        return []

    monkeypatch.setattr(camera, "_bed", lambda _: [GOOD])
    monkeypatch.setattr(camera, "_kerf", later)
    camera.measure(["bed", "kerf"])
    assert "kept" in told[0]


def test_a_part_takes_as_many_pictures_as_asked_and_by_itself_as_many_as_the_figure_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts: list[int] = []
    monkeypatch.setattr(camera, "_nothing", lambda n: counts.append(n) or [])
    camera.measure(["nothing"])
    camera.measure(["nothing=24"])
    camera.measure(["--quick", "nothing"])
    assert counts == [1000, 24, 100]


@pytest.mark.parametrize("word", ["nothign", "ids=many", "ids=0"])
def test_a_part_that_is_none_is_named_and_nothing_runs(word: str) -> None:
    with pytest.raises(SystemExit, match="PART=N"):
        camera.measure([word])
