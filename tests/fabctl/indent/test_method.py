"""Methods: what they become, and what speaks against them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fabctl.config.bench import RigConfig
from fabctl.config.loader import parse
from fabctl.config.method import MethodConfig, load_method
from fabctl.errors import ConfigError
from fabctl.indent.method import Predicted, actions, check
from fabctl.indent.resume import resumed

RIG = RigConfig(url="x", map="reference", travel_mm=60.0, force_limit_N=20.0, indenter_radius_mm=8.0)
NOWHERE = Path("nowhere")
HEAD = "name: m\nlimits: {force_N: 5, travel_mm: 40}\nsteps:\n"


def method(steps: str) -> MethodConfig:
    return parse(HEAD + steps, MethodConfig, "m.yaml")


def codes(found: MethodConfig, predicted: Predicted | None = None, has_stage: bool = True) -> set[str]:
    return {finding.code for finding in check(actions(found), found, RIG, predicted, has_stage)}


@pytest.mark.parametrize("name", ["dome", "quick", "grid", "creep", "relaxation", "cap"])
def test_the_shipped_methods_pass_their_own_check(name: str) -> None:
    found = load_method(name, NOWHERE)
    assert codes(found) == {"METHOD-NO-PREDICTION"}


def test_cycles_become_numbered_curves() -> None:
    found = actions(load_method("dome", NOWHERE))
    assert [(a.kind, a.curve, a.condition) for a in found if a.kind == "load"] == [
        ("load", 1, True),
        ("load", 2, True),
        ("load", 3, False),
        ("load", 4, False),
    ]


def test_a_grid_visits_every_point_with_its_own_tare() -> None:
    found = actions(load_method("grid", NOWHERE))
    travels = [a.at_mm for a in found if a.kind == "travel"]
    assert len(set(travels)) == 9
    assert [a.point for a in found if a.kind == "tare"] == list(range(1, 10))


def test_what_is_left_after_an_interruption_begins_with_a_tare() -> None:
    plan = actions(load_method("grid", NOWHERE))
    left = resumed(plan, [(point, 1) for point in (1, 2, 3)])
    assert {a.point for a in left} == {4, 5, 6, 7, 8, 9}
    assert [a.kind for a in left[:3]] == ["travel", "tare", "approach"]
    dome = resumed(actions(load_method("dome", NOWHERE)), [(0, 1), (0, 2), (0, 3)])
    assert dome[0].kind == "tare"
    assert [a.curve for a in dome if a.kind == "load"] == [4]
    assert resumed(plan, [(point, 1) for point in range(1, 10)]) == ()
    assert {a.point for a in resumed(plan, [(1, 1)], untouched=[2, 5])} == {3, 4, 6, 7, 8, 9}


def test_a_load_without_an_approach_is_refused() -> None:
    found = method("  - {step: tare}\n  - {step: load, depth_mm: 2, speed_mm_s: 1}\n")
    assert "METHOD-APPROACH" in codes(found)


def test_an_approach_without_a_tare_is_refused() -> None:
    assert "METHOD-TARE" in codes(method("  - {step: approach, speed_mm_s: 1, trigger_N: 0.1}\n"))


def test_a_preload_without_a_zero_after_it_is_told() -> None:
    begin = "  - {step: tare}\n  - {step: approach, speed_mm_s: 1, trigger_N: 0.1}\n"
    preload = "  - {step: preload, force_N: 0.2, speed_mm_s: 1}\n"
    load = "  - {step: load, depth_mm: 2, speed_mm_s: 1}\n"
    assert "METHOD-PRELOAD" in codes(method(begin + preload + load))
    assert "METHOD-PRELOAD" not in codes(method(begin + preload + "  - {step: zero}\n" + load))


def test_a_tare_while_the_specimen_is_pressed_is_refused() -> None:
    begin = "  - {step: tare}\n  - {step: approach, speed_mm_s: 1, trigger_N: 0.1}\n"
    load, tare = "  - {step: load, depth_mm: 2, speed_mm_s: 1}\n", "  - {step: tare}\n"
    for way_out, refused in (("", True), ("force_N: 0.1, ", True), (None, False)):
        unload = "" if way_out == "" else f"  - {{step: unload, {way_out or ''}speed_mm_s: 1}}\n"
        assert ("METHOD-TARE-PRESSED" in codes(method(begin + load + unload + tare))) == refused


def test_a_rest_after_the_way_out_belongs_to_no_curve() -> None:
    found = actions(load_method("relaxation", NOWHERE))
    assert [(a.time_s, a.curve) for a in found if a.kind == "hold"] == [(60.0, 1), (10.0, 0)]


def test_a_force_cannot_be_held_where_nothing_is_pressed() -> None:
    begin = "  - {step: tare}\n  - {step: approach, speed_mm_s: 1, trigger_N: 0.1}\n"
    hold = "  - {step: hold, time_s: 5, force_N: 0.5}\n"
    assert "METHOD-HOLD" in codes(method(begin + hold))
    assert "METHOD-HOLD" not in codes(method(begin + "  - {step: load, force_N: 0.5, speed_mm_s: 1}\n" + hold))


def test_a_predicted_force_above_the_limit_is_refused() -> None:
    stiff = Predicted(np.linspace(0, 10, 11), np.linspace(0, 20, 11))
    assert "METHOD-PREDICTED-FORCE" in codes(load_method("dome", NOWHERE), stiff)


def test_a_force_that_the_specimen_is_predicted_never_to_reach_is_told() -> None:
    soft = Predicted(np.linspace(0, 10, 11), np.linspace(0, 0.02, 11))
    assert "METHOD-OUT-OF-REACH" not in codes(load_method("creep", NOWHERE), soft)
    softer = Predicted(np.linspace(0, 10, 11), np.linspace(0, 0.01, 11))
    plan = load_method("creep", NOWHERE)
    told = [f.message for f in check(actions(plan), plan, RIG, softer) if f.code == "METHOD-OUT-OF-REACH"]
    assert [text.split(":")[0] for text in told] == ["hold to 0.012 N", "load to 0.012 N"]


def test_a_snap_in_the_prediction_counts_with_its_peak() -> None:
    snapping = Predicted(np.array([0.0, 1.0, 5.0]), np.array([0.0, 6.0, 0.1]))
    assert "METHOD-PREDICTED-FORCE" in codes(load_method("dome", NOWHERE), snapping)


def test_a_grid_on_a_rig_without_a_stage_is_refused() -> None:
    assert "METHOD-STAGE" in codes(load_method("grid", NOWHERE), has_stage=False)


def test_depths_and_safe_heights_beyond_the_travel_are_refused() -> None:
    steps = "  - {step: tare}\n  - {step: approach, speed_mm_s: 1, trigger_N: 0.1}\n"
    steps += "  - {step: load, depth_mm: 1.0e+300, speed_mm_s: 1}\n"
    found = parse(HEAD.replace("steps:", "safe_height_mm: 400\nsteps:") + steps, MethodConfig, "m.yaml")
    assert {"METHOD-SAFE-HEIGHT", "METHOD-DEPTH"} <= codes(found)


def test_limits_beyond_the_bench_are_refused() -> None:
    found = parse(HEAD.replace("5", "50").replace("40", "80") + "  - {step: tare}\n", MethodConfig, "m.yaml")
    assert {"METHOD-FORCE", "METHOD-TRAVEL"} <= codes(found)


def test_all_faults_of_a_method_file_are_named_with_their_lines() -> None:
    with pytest.raises(ConfigError) as caught:
        method("  - {step: load, speed_mm_s: 1}\n  - {step: wiggle}\n  - {step: hold, time_s: -1}\n")
    assert [line.split(": ")[0] for line in caught.value.complaints] == ["m.yaml:4", "m.yaml:5", "m.yaml:6"]
    assert "give either depth_mm or force_N" in caught.value.complaints[0]
