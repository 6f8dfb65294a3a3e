"""YAML files are read whole, and every fault is named with its line."""

from __future__ import annotations

import pytest

from fabctl.config.bench import BenchConfig
from fabctl.config.loader import parse
from fabctl.config.spec import SpecConfig
from fabctl.errors import ConfigError

GOOD = """
name: lab
laser:
  url: serial:///dev/ttyUSB0?baud=115200
  travel_mm: [300, 2e2]
"""


def complaints(text: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        parse(text, BenchConfig, "lab.yaml")
    return caught.value.complaints


def test_a_number_with_an_exponent_is_a_number() -> None:
    laser = parse(GOOD, BenchConfig, "lab.yaml").laser
    assert laser is not None
    assert laser.travel_mm == (300, 200.0)


def test_all_faults_are_named_at_once_with_their_lines() -> None:
    found = complaints("name: lab\nlaser:\n  url: tcp://x:1\n  travel_mm: [300, wide]\n  travle_mm: 3\nname: again\n")
    assert [line.split(": ")[0] for line in found] == ["lab.yaml:4", "lab.yaml:5", "lab.yaml:6"]
    assert "laser.travel_mm.1" in found[0]
    assert "not 'wide'" in found[0]
    assert "laser.travle_mm: unknown key" in found[1]
    assert "given twice" in found[2]


def test_the_word_on_stays_a_word() -> None:
    assert "bool" in " ".join(complaints("name: lab\nlaser: {url: x, travel_mm: [1, 1], homing: on}\n"))


def test_what_is_not_yaml_says_where() -> None:
    assert complaints("name: [lab\n")[0].startswith("lab.yaml:2: not YAML")


def test_an_empty_file_lacks_its_keys() -> None:
    assert complaints("") == ("lab.yaml:1: name: Field required",)


@pytest.mark.parametrize(
    "text", ["a: &a [*a]\n", "a: " + "[" * 3000, "name: lab\nlaser: " + "9" * 5000 + "\n", "- 1\n- 2\n"]
)
def test_what_would_exhaust_the_reader_is_refused_with_its_place(text: str) -> None:
    assert complaints(text)[0].startswith("lab.yaml:")


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("{mak: cap, radius_mm: wide}", {"target.make: Field required", "target.mak: unknown key"}),
        ("5", {"target: a mapping of keys was expected, not 5"}),
    ],
)
def test_a_key_of_several_kinds_is_told_by_its_own_names(target: str, said: set[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(f"name: cap\ntarget: {target}\n", SpecConfig, "spec.yaml")
    texts = {line.removeprefix("spec.yaml:2: ") for line in caught.value.complaints}
    assert said <= texts
    assert not [text for text in texts if "MadeTarget" in text or ".str" in text]
