"""Cells that spring back: simulated ones, past the bistable ones, where the specification asks for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from design.cells.library import VERDICTS, load_library
from design.cells.monostable import MARGIN_RATIO, monostable_cells
from design.errors import DesignError
from design.pattern.paths import LAYERS, LayerPreset
from design.pipeline import build
from design.spec import DesignSpec, Region, ResponseOptions
from design.targets import cap

PRESETS = {layer: LayerPreset(0.5, 20.0) for layer in LAYERS}


@pytest.mark.parametrize("edge_mm", [10.0, 5.0])
def test_the_sweep_found_every_one_of_them_not_bistable(edge_mm: float) -> None:
    library = load_library()
    sheet = library.sheet
    ratio = edge_mm / sheet.edge_mm
    library = library.scaled(
        replace(sheet, edge_mm=edge_mm, slit_mm=ratio * sheet.slit_mm, hinge_mm=ratio * sheet.hinge_mm)
    )
    asked = np.linspace(library.theta_rad.min(), library.theta_rad.max(), 60)
    t_mm, theta_rad = monostable_cells(library, asked)
    table = library.table
    for t, theta in zip(t_mm, theta_rad, strict=True):
        here = (table["theta_rad"] == theta) & (table["t_mm"] == t)
        assert [VERDICTS[int(code)] for code in table["verdict"][here]] == ["not bistable"]
        greatest = library.t_mm[np.isclose(library.theta_rad, theta)].max()
        assert 0.999 * MARGIN_RATIO * edge_mm < t - greatest < 1.1 * MARGIN_RATIO * edge_mm
    assert not library.at(t_mm, theta_rad).inside.any()
    assert np.abs(theta_rad - asked).max() < np.radians(10)


def test_a_library_of_bistable_cells_alone_has_none() -> None:
    library = load_library()
    table = {**library.table, "verdict": np.zeros_like(library.table["verdict"])}
    with pytest.raises(DesignError, match="spring back"):
        monostable_cells(replace(library, table=table), np.array([0.1]))


def test_a_region_has_slits_and_stays_flat() -> None:
    spec = DesignSpec("cap", monostable=(Region(0, 0, 12),), passive=(Region(0, 0, 7),),
                      response=ResponseOptions(depth_mm=2.0, steps_count=4))  # fmt: skip
    made = build(spec, cap(radius_mm=40, edge_mm=4), load_library(), PRESETS)
    kind = np.array(made.cells.kind)
    mono = np.flatnonzero(kind == "monostable")
    assert len(mono) >= 6
    assert (kind == "passive").any()
    owners = {path.cell for path in made.drawing.paths if path.layer == "slit"}
    assert set(mono.tolist()) & owners
    assert (made.cells.choice.expansion_ratio[mono] == 1).all()
    assert not load_library().at(made.cells.choice.t_mm[mono], made.cells.choice.theta_rad[mono]).inside.any()
    rest = kind == "cut"
    assert made.cells.choice.expansion_ratio[rest] == pytest.approx(made.cells.wanted_ratio[rest])
    assert "CELLS-MONOSTABLE" in {finding.code for finding in made.findings}
    assert made.predicted is not None
    mesh = made.predicted.deployed.mesh
    corners = mesh.vertices_mm[mesh.faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
    # Their open neighbours pull on them, but they stay nearer to flat.
    assert sides[mono].max() < 10 * (1 + made.cells.wanted_ratio[mono].min()) / 2
    assert sides[rest].mean() > 10 * (1 + made.cells.wanted_ratio[rest].min()) / 2
