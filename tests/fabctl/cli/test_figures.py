"""A result as a person reads it."""

from __future__ import annotations

import pytest

from fabctl.cli.figures import figures, spoken


def test_figures_have_their_unit_four_digits_and_the_reason_where_they_are_missing() -> None:
    result = {
        "stiffness_secant_N_mm": 0.49981234567,
        "peak_depth_mm": None,
        "predicted_secant_N_mm": None,
        "hysteresis_ratio": 0.1,
        "curves_count": 2,
        "curves": [{"point": 1}],
        "not_found": {"peak_depth_mm": "the force rises to the end of the loading"},
    }
    assert list(figures(result)) == [
        "stiffness secant: 0.4998 N/mm",
        "peak depth: not found: the force rises to the end of the loading",
        "predicted secant: none",
        "hysteresis ratio: 0.1",
        "curves: 2",
    ]


@pytest.mark.parametrize(
    ("value", "said"), [(123456.789, "123457"), (1e-5, "1e-05"), (True, "yes"), ([], "none"), (float("nan"), "nan")]
)
def test_a_value_is_spoken_plainly(value: object, said: str) -> None:
    assert spoken(value) == said
