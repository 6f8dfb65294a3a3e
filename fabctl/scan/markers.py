"""Markers as correspondences: a measured board gives the scale, without any geometry of the specimen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from design.findings import Finding
from fabctl.errors import RefusedError
from fabctl.scan.similarity import best_similarity

Floats = NDArray[np.float64]

MISFIT_LIMIT_FRAC = 0.005  # of the board's size; a marker farther off than this is mislabelled or moved


@dataclass(frozen=True, slots=True)
class Scale:
    """Millimetres per cloud unit, with its standard deviation as a fraction of it.

    `to_board` is the first pose, four rows of a matrix from cloud units to the board's millimetres, z up; None where
    the marks do not give one.
    """

    unit_mm: float
    sigma_frac: float
    markers_count: int
    to_board: tuple[tuple[float, ...], ...] | None = None
    findings: tuple[Finding, ...] = ()


def scale_from_board(seen: Mapping[str, Floats], board_mm: Mapping[str, Floats]) -> Scale:
    """Return the scale that carries the markers as scanned onto the board as measured.

    Least squares over all markers (Umeyama 1991); the spread comes from leaving each out in turn. Raises
    `RefusedError` for fewer than two common markers, or where one is off.
    """
    labels = sorted(set(seen) & set(board_mm))
    if len(labels) < 2:
        raise RefusedError(
            "the scale cannot be taken from the board",
            [
                Finding(
                    "SCAN-MARKERS", f"{len(labels)} markers are named both in the scan and on the board; 2 are needed"
                )
            ],
        )
    cloud, board = np.array([seen[k] for k in labels]), np.array([board_mm[k] for k in labels])
    if len(labels) == 2:
        ratio = float(np.linalg.norm(board[1] - board[0]) / np.linalg.norm(cloud[1] - cloud[0]))
        return Scale(ratio, float("nan"), 2)
    fit = best_similarity(cloud, board)
    size = max(float(np.linalg.norm(a - b)) for a, b in combinations(board, 2))
    off = np.linalg.norm(fit(cloud) - board, axis=1) / size
    wrong = [
        Finding("SCAN-MARKER", f"is {o:.2%} of the board's size from where it should be", where=label)
        for label, o in zip(labels, off, strict=True)
        if o > MISFIT_LIMIT_FRAC
    ]
    if wrong:
        raise RefusedError("the scale cannot be taken from the board", wrong)
    n = len(labels)
    without = [best_similarity(np.delete(cloud, k, 0), np.delete(board, k, 0)).scale_ratio for k in range(n)]
    spread = float(np.sqrt((n - 1) / n * np.sum((np.array(without) - np.mean(without)) ** 2)))
    return Scale(fit.scale_ratio, spread / fit.scale_ratio, n)
