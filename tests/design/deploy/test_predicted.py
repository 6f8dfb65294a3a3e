"""The build says where a sheet left to itself pops to another shape than the one intended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from design.deploy.predict import Deployed, deploy
from design.predicted import _other_side


@pytest.fixture(scope="module")
def cap(cap_of):
    return cap_of(edge_mm=16.0)


def test_a_cap_that_pops_as_intended_needs_no_word(cap) -> None:
    assert _other_side(cap.layout, deploy(cap.layout, cap.target, cap.design_mm), False) == []


def test_another_shape_from_flat_is_told_with_both_energies(cap) -> None:
    popped = deploy(cap.layout, cap.target, cap.design_mm)
    other = replace(popped.equilibrium, x_mm=popped.equilibrium.x_mm * np.array([1.0, 1.0, 0.0]), energy_mJ=7.25)
    (finding,) = _other_side(cap.layout, Deployed(popped.mesh, other, popped.deviation), False)
    assert finding.code == "DEPLOY-SIDES"
    assert "7.25 mJ" in finding.message
