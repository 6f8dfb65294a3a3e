"""Hinges that are not the library's: what is chosen and predicted is what the solver finds for the hinge as cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from design.cells.hinges import with_hinge
from design.cells.homogenise import solve_cell
from design.cells.library import VERDICTS, load_library
from design.cells.select import SelectionOptions, selection_curve
from design.cells.sheet import Sheet
from design.errors import DesignError
from design.pattern.paths import LAYERS, LayerPreset
from design.pattern.slits import HingeOptions
from design.pipeline import Design, build
from design.predicted import _doubts
from design.spec import DesignSpec
from design.targets import cap

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}


def made(hinge: HingeOptions, rule: str = "smooth") -> Design:
    spec = DesignSpec("cap", hinge=hinge, response=None, selection=SelectionOptions(rule))  # type: ignore[arg-type]
    return build(spec, cap(edge_mm=8), load_library(), PRESETS)


@pytest.mark.parametrize("width", [0.22, 0.30, 0.36, 0.45])
def test_the_library_at_another_hinge_is_what_the_solver_finds(width: float) -> None:
    library = with_hinge(load_library(), width)
    curve = selection_curve(library)
    for share in (0.35, 0.6, 0.85):
        k = int(share * len(curve.t_mm))
        cell = solve_cell(curve.t_mm[k], curve.theta_rad[k], replace(Sheet(), hinge_mm=width))
        assert cell.expansion_ratio == pytest.approx(curve.expansion_ratio[k], abs=1e-3)
        assert cell.stiffness_mm2 is not None
        assert curve.stiffness_mJ[k] == pytest.approx(cell.stiffness_mm2 * 1.5 * 2.3, rel=0.01)
    assert library.sheet.hinge_mm == width and library.hash != load_library().hash


def test_the_librarys_own_hinge_changes_nothing_and_hinges_scale_with_the_cell() -> None:
    assert with_hinge(load_library(), 0.25) is load_library()
    small = with_hinge(load_library().scaled(Sheet(edge_mm=5, slit_mm=0.0625, hinge_mm=0.125)), 0.15)
    large = with_hinge(load_library(), 0.30)
    np.testing.assert_allclose(small.expansion_ratio, large.expansion_ratio, atol=1e-9)
    np.testing.assert_allclose(4 * small.stiffness_mJ, large.stiffness_mJ, rtol=1e-9)


@pytest.mark.parametrize("hinge", [HingeOptions("constant", 0.3), HingeOptions("widening", 0.30, 0.125)])
def test_a_designs_cells_expand_as_chosen_with_the_hinge_they_are_cut_with(hinge: HingeOptions) -> None:
    design = made(hinge)
    choice, widths = design.cells.choice, design.cells.hinge_mm
    np.testing.assert_allclose(choice.expansion_ratio, design.cells.wanted_ratio, atol=1e-9)
    for k in range(0, len(widths), 40):
        cell = solve_cell(choice.t_mm[k], choice.theta_rad[k], replace(Sheet(), hinge_mm=float(widths[k])))
        assert cell.expansion_ratio == pytest.approx(choice.expansion_ratio[k], abs=3e-4)


def test_the_published_rule_keeps_its_entries_and_is_told_what_its_hinges_change() -> None:
    design = made(HingeOptions("widening", 0.30, 0.125), "published")
    library = load_library()
    entries = {(round(t, 9), round(a, 9)) for t, a in zip(library.t_mm, library.theta_rad, strict=True)}
    choice = design.cells.choice
    assert {(round(t, 9), round(a, 9)) for t, a in zip(choice.t_mm, choice.theta_rad, strict=True)} <= entries
    assert "HINGE-SHIFT" in {finding.code for finding in design.findings}
    assert -0.06 < (choice.expansion_ratio - design.cells.wanted_ratio).min() < -0.01


def test_a_hinge_beyond_the_sweeps_or_for_another_sheet_is_refused_with_the_range() -> None:
    with pytest.raises(DesignError, match=r"outside the 0.2 to 0.5 mm"):
        with_hinge(load_library(), 0.6)
    other = replace(load_library(), sheet=replace(Sheet(), nu_ratio=0.3))
    with pytest.raises(DesignError, match="library build"):
        with_hinge(other, 0.3)


def test_a_narrower_hinge_leaves_no_cell_called_monostable_that_it_would_hold_open() -> None:
    narrow = with_hinge(load_library(), 0.2)
    springs = narrow.table["verdict"] == VERDICTS.index("not bistable")
    some = np.flatnonzero(springs)[::300]
    for k in some.tolist():
        cell = solve_cell(narrow.table["t_mm"][k], narrow.table["theta_rad"][k], replace(Sheet(), hinge_mm=0.2))
        assert cell.verdict != "bistable"


@pytest.mark.parametrize(("width", "level"), [(0.25, None), (0.28, "info"), (0.36, "warning")])
def test_a_prediction_says_that_bending_is_not_that_of_its_hinge(width: float, level: str | None) -> None:
    doubts = [finding for finding in _doubts(with_hinge(load_library(), width)) if finding.code == "DEPLOY-HINGE"]
    assert [finding.level for finding in doubts] == ([level] if level else [])


def test_a_design_says_which_expansions_its_hinges_leave() -> None:
    told = {finding.code: finding.message for finding in made(HingeOptions("constant", 0.36)).findings}
    assert "with the library's 0.25 mm from" in told["HINGE-RANGE"]
    assert "HINGE-RANGE" not in {finding.code for finding in made(HingeOptions()).findings}


def test_a_design_of_small_cells_takes_the_librarys_own_hinge_where_none_is_asked_for() -> None:
    small = load_library().scaled(Sheet(edge_mm=5, slit_mm=0.0625, hinge_mm=0.125))
    design = build(DesignSpec("small", cell_mm=5, response=None), cap(radius_mm=40, edge_mm=5), small, PRESETS)
    assert np.unique(design.cells.hinge_mm) == pytest.approx([0.125])
