"""Statistics of groups: Fieller's interval against its definition, and how often it covers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from fabctl.indent.compare import bca, describe, fieller, percentile

VALUES = st.lists(st.floats(0.5, 2.0), min_size=4, max_size=8).filter(lambda v: np.std(v) > 1e-3)


@given(VALUES, VALUES)
def test_at_the_ends_of_fiellers_interval_the_t_test_just_refuses(above: list[float], below: list[float]) -> None:
    found = fieller(above, below)
    if found.low_ratio is None or found.high_ratio is None:
        return
    a, b = np.array(above), np.array(below)
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    at = found.value_ratio
    degrees = (va + vb * at**2) ** 2 / (va**2 / (len(a) - 1) + (vb * at**2) ** 2 / (len(b) - 1))
    limit = stats.t.ppf(0.975, degrees)
    for end in (found.low_ratio, found.high_ratio):
        assert abs(a.mean() - end * b.mean()) / np.sqrt(va + end**2 * vb) == pytest.approx(limit, rel=1e-6)
    assert found.low_ratio <= at <= found.high_ratio


def test_fieller_covers_95_percent_at_five_specimens_and_the_percentile_does_not() -> None:
    rng = np.random.default_rng(1)
    hits = {"fieller": 0, "percentile": 0}
    for _ in range(1000):
        above, below = rng.normal(1.5, 0.06, 5), rng.normal(1.0, 0.04, 5)
        for name, found in (("fieller", fieller(above, below)), ("percentile", percentile(above, below, rng))):
            assert found.low_ratio is not None
            assert found.high_ratio is not None
            hits[name] += found.low_ratio <= 1.5 <= found.high_ratio
    assert 930 <= hits["fieller"] <= 970
    assert hits["percentile"] < 930


def test_a_lower_group_around_zero_has_no_interval_and_says_why() -> None:
    found = fieller([1.0, 1.1, 0.9], [-0.1, 0.2, 0.05])
    assert (found.low_ratio, found.high_ratio) == (None, None)
    assert "not clearly above zero" in found.reason


def test_bca_is_reproducible_and_holds_the_value() -> None:
    above, below = [2.0, 2.1, 1.9, 2.05, 2.2], [1.0, 1.02, 0.98, 1.05, 0.95]
    one, two = (bca(above, below, np.random.default_rng(7)) for _ in range(2))
    assert one == two
    assert one.low_ratio is not None
    assert one.high_ratio is not None
    assert one.low_ratio < one.value_ratio < one.high_ratio


def test_one_value_has_no_spread() -> None:
    with pytest.raises(ValueError, match="at least two"):
        describe("lonely", [1.0])
