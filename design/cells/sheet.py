"""The sheet a cell is cut from: the constants of the cell's geometry and of the rubber."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sheet:
    """One kind of sheet, cut with one kind of slit.

    The default is the paper's (Chen, Panetta, Schnaubelt, Pauly 2021): edge 10 mm, slit 0.125 mm along the edge,
    hinge 0.25 mm, natural rubber of 2.3 mm. The shape depends only on slit/edge, hinge/edge and `nu_ratio`;
    lengths scale with `edge_mm`, energies with `E_MPa * thickness_mm * edge_mm**2`.
    """

    edge_mm: float = 10.0
    slit_mm: float = 0.125
    hinge_mm: float = 0.25
    thickness_mm: float = 2.3
    E_MPa: float = 1.5
    nu_ratio: float = 0.45
    density_kg_m3: float = 1150.0
