"""The house rules hold, and breaking one is noticed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOLS = Path(sys.executable).parent


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    command = [str(TOOLS / "lint-imports"), "--no-cache"]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, env={"PYTHONPATH": str(root)})


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for name in ("fabctl", "drivers", "design", "simulators", "benchmarks"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_the_import_rules_hold(copy: Path) -> None:
    done = lint_imports(copy)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("design", "fabctl"),
        ("design", "drivers"),
        ("drivers", "design"),
        ("simulators", "drivers"),
        ("fabctl", "simulators"),
        ("drivers", "simulators"),
    ],
)
def test_breaking_an_import_rule_fails_the_check(copy: Path, importer: str, imported: str) -> None:
    (copy / importer / "intruder.py").write_text(
        f"import {imported}.errors\n" if imported != "simulators" else "import simulators.grbl\n"
    )
    done = lint_imports(copy)
    assert done.returncode != 0
    assert f"{importer}.intruder" in done.stdout


def test_no_address_of_a_registry_and_no_path_of_a_machine_is_in_the_lock() -> None:
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text
    assert "/home/" not in text


def test_triangle_whose_licence_forbids_commercial_use_is_never_called() -> None:
    packages = ("fabctl", "drivers", "design", "simulators", "benchmarks")
    sources = [path for name in packages for path in (ROOT / name).rglob("*.py")]
    assert [
        str(p) for p in sources if re.search(r"igl\.triangle|import triangle\b|igl import triangle", p.read_text())
    ] == []
