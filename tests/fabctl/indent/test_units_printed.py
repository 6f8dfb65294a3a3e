"""What an indentation prints has a unit at every figure."""

from __future__ import annotations

from fabctl.cli.indent import NAMED, _lines


def test_shares_are_printed_in_percent_and_no_line_ends_in_a_blank() -> None:
    told = list(_lines({name: 0.25 for _, name, _ in NAMED}))
    assert [line for line in told if "hysteresis" in line or "recovery" in line] == [
        f"  {'hysteresis':22} 25 %",
        f"  {'recovery':22} 25 %",
    ]
    assert not [line for line in told if line.endswith(" ")]
