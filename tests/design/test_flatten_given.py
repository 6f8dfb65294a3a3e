"""A flat that the target's file brings is taken as it is, and checked as our own is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from design.errors import FlattenError, MeshError
from design.flatten import FlattenOptions, flatten
from design.meshfiles import read_given_flat, read_mesh, write_obj
from design.surface import TriMesh
from design.targets import cap
from fabctl.designing import read_inputs
from fabctl.errors import ConfigError, UsageError

MESH = cap(edge_mm=12)


def corners(scale_ratio: float = 1.0) -> np.ndarray:
    own = flatten(MESH)
    return np.asarray(scale_ratio * own.flat_mm[own.faces])


def test_a_given_flat_has_the_expansions_of_its_faces() -> None:
    own, given = flatten(MESH), flatten(MESH, FlattenOptions(given_mm=corners(0.5)))
    assert given.expansion_ratio == pytest.approx(2 * own.expansion_ratio)
    assert given.spread_ratio() == pytest.approx(own.spread_ratio())
    assert given.flat_mm[given.faces] == pytest.approx(corners(0.5))
    assert not given.findings


def test_a_cut_in_a_given_flat_doubles_its_vertices() -> None:
    apart = corners()
    right = MESH.vertices_mm[MESH.faces].mean(axis=1)[:, 0] > 0
    apart[right] += [500.0, 0.0]
    given = flatten(MESH, FlattenOptions(given_mm=apart))
    assert len(given.flat_mm) > len(MESH.vertices_mm)
    assert [finding.code for finding in given.findings] == ["FLAT-GIVEN-SEAM"]


@pytest.mark.parametrize("wrong", ["mirrored", "folded", "short"])
def test_a_given_flat_that_cannot_be_cut_is_refused(wrong: str) -> None:
    flat = corners()
    flat = {"mirrored": flat * [-1, 1], "folded": np.abs(flat), "short": flat[1:]}[wrong]
    with pytest.raises(FlattenError):
        flatten(MESH, FlattenOptions(given_mm=flat))


def write_with_flat(path: Path, mesh: TriMesh, flat: np.ndarray) -> Path:
    write_obj(path, mesh)
    lines = [line for line in path.read_text().splitlines() if not line.startswith("f ")]
    lines += [f"vt {u!r} {v!r}" for u, v in flat.reshape(-1, 2).tolist()]
    for k, (a, b, c) in enumerate((mesh.faces + 1).tolist()):
        lines.append(f"f {a}/{3 * k + 1} {b}/{3 * k + 2} {c}/{3 * k + 3}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_specification_takes_the_flat_of_its_target(tmp_path: Path) -> None:
    write_with_flat(tmp_path / "cap.obj", MESH, corners(0.7))
    text = "name: x\ntarget: cap.obj\nflatten: {source: target}\n"
    (tmp_path / "x.yaml").write_text(text)
    spec = read_inputs(str(tmp_path / "x.yaml"), tmp_path).spec
    assert spec.flatten.given_mm == pytest.approx(corners(0.7))
    (tmp_path / "x.yaml").write_text(text.replace("}", ", cones_count: 1}"))
    with pytest.raises(ConfigError, match="takes the file's flat as it is"):
        read_inputs(str(tmp_path / "x.yaml"), tmp_path)
    (tmp_path / "x.yaml").write_text(text.replace("cap.obj", "{make: cap}"))
    with pytest.raises(UsageError, match="this target has none"):
        read_inputs(str(tmp_path / "x.yaml"), tmp_path)


def test_a_file_without_a_flat_for_every_corner_is_refused(tmp_path: Path) -> None:
    write_obj(tmp_path / "bare.obj", MESH)
    with pytest.raises(MeshError):
        read_given_flat(tmp_path / "bare.obj", MESH)
    path = write_with_flat(tmp_path / "double.obj", MESH, corners())
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[-1]]) + "\n")  # a face twice: one is left out on reading
    with pytest.raises(MeshError):
        read_given_flat(path, read_mesh(path)[0])
