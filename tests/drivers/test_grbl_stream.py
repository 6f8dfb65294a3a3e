from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.grbl.faults import DoubledOk
from drivers.grbl.stream import Stream, bare

LINES = st.lists(st.text("GXYFS0123456789.-", min_size=1, max_size=79), max_size=60)


@given(lines=LINES, rx_bytes=st.integers(80, 1024), answers=st.lists(st.integers(0, 3), max_size=300))
def test_never_more_bytes_are_out_than_the_board_can_hold(lines: list[str], rx_bytes: int, answers: list[int]) -> None:
    stream = Stream(lines, rx_bytes)
    out = bytearray()
    for count in [*answers, *[1] * (4 * len(lines) + 4)]:
        out += stream.take()
        waiting = sum(len(line) + 1 for line in lines[stream.answered_count : stream.sent_count])
        assert waiting == stream.outstanding_bytes <= rx_bytes
        for _ in range(min(count, stream.outstanding_count)):
            stream.answered()
    assert stream.done
    assert bytes(out).decode() == "".join(line + "\n" for line in lines)


def test_one_answer_too_many_cannot_overflow_the_buffer() -> None:
    lines = [f"X{k % 10}Y1" for k in range(100)]
    stream = Stream(lines, 128)
    stream.take()
    stream.answered()  # a doubled ok: the board still holds this line
    stream.take()
    longest = max(len(line) + 1 for line in lines)
    assert stream.outstanding_bytes + longest <= 128


def test_an_answer_with_nothing_outstanding_is_a_fault() -> None:
    with pytest.raises(DoubledOk):
        Stream(["G21"], 128).answered()


def test_lines_beyond_the_limit_wait() -> None:
    stream = Stream(["G21", "G90", "G94"], 128)
    assert stream.take(2) == b"G21\nG90\n"
    assert stream.take(2) == b""
    assert stream.take(3) == b"G94\n"


def test_comments_and_blanks_are_not_sent() -> None:
    assert bare(" G1 X1 (a comment) F100 ; more") == "G1X1F100"
    assert bare("G1X2(unterminated") == "G1X2"
