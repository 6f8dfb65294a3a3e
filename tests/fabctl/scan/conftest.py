"""Targets and scans that the scan tests share; each is made once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from design.surface import TriMesh
from design.targets import cap, freeform
from fabctl.scan.similarity import Similarity
from fabctl.scan.symmetry import Symmetries, find_symmetries
from fabctl.scan.target import Target
from simulators.photogrammetry import Scan, ScanPlan, scan


@lru_cache(maxsize=32)
def scanned(name: str, plan: ScanPlan) -> Scan:
    """Return a simulated scan of the shared target called `name`."""
    mesh = TARGETS[name].mesh
    return scan(mesh.vertices_mm, mesh.faces, plan)


def true_pose(made: Scan) -> Similarity:
    """Return the map from the cloud to the mesh that the simulator kept to itself."""
    return Similarity(made.rotation, made.translation, made.scale_ratio).inverse()


@lru_cache(maxsize=8)
def symmetries_of(name: str) -> Symmetries:
    """Return the symmetries of the shared target called `name`."""
    return find_symmetries(TARGETS[name])


def _tilted(mesh: TriMesh) -> TriMesh:
    """Return the surface with a slant of its own, so that nothing about it is symmetric."""
    v = mesh.vertices_mm.copy()
    v[:, 2] += 0.12 * v[:, 0] + 8 * np.sin(v[:, 1] / 40) + 0.0015 * v[:, 0] * v[:, 1]
    return TriMesh(v, mesh.faces)


TARGETS = {"freeform": Target(_tilted(freeform()), "freeform"), "cap": Target(cap(), "cap")}


@pytest.fixture(scope="session")
def freeform_target() -> Target:
    return TARGETS["freeform"]


@pytest.fixture(scope="session")
def cap_target() -> Target:
    return TARGETS["cap"]
