"""What of a reply is believed, and what is thrown away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.rig.registers import BadReply, Register, check_word, decode_value, encode_value
from drivers.rig.samples import Asked, Freshness, Restarted
from fabctl.config.rig import load_rig

MAP = load_rig("reference", Path("nowhere"))


def block(sequence: int, request: int, heartbeat: int | None = None, **more: float) -> list[int]:
    values: dict[str, float | int | str] = {
        **dict.fromkeys(MAP.blocks["status"].names, 0),
        "sequence": sequence,
        "request_echo": request,
        "heartbeat": sequence % 2**16 if heartbeat is None else heartbeat,
        **more,
    }
    words = MAP.encode("status", values)
    return [*words[:-1], check_word(words[:-1])]


def lived(fresh: Freshness, replies_count: int = 5) -> Freshness:
    """Return the judge after more good replies, 1015 to 1035 in steps of 5 ms: it knows the clocks to 2 ms now."""
    for k in range(replies_count):
        fresh.believe(block(1015 + 5 * k, 3 + k), asked(3 + k, 1.015 + 0.005 * k))
    return fresh


def asked(request: int, at_s: float) -> Asked:
    return Asked(request, at_s, at_s + 0.002)


def awake() -> Freshness:
    """Return a judge that has believed sequence 1010 at 1.01 s."""
    fresh = Freshness(MAP)
    with pytest.raises(BadReply, match="second must agree"):
        fresh.believe(block(1000, 1), asked(1, 1.0))
    fresh.believe(block(1010, 2), asked(2, 1.01))
    return fresh


def test_a_reply_that_goes_on_is_a_sample_in_its_units() -> None:
    sample = awake().believe(block(1020, 3, position=12.3456, force=-0.5, state=2, faults=1), asked(3, 1.02))
    assert (sample.sequence, sample.state, sample.faults) == (1020, "moving", ("overload",))
    assert sample.position_mm == pytest.approx(12.3456)
    assert sample.force_N == pytest.approx(-0.5)
    assert sample.time_s == pytest.approx(0.010)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (block(1020, 3)[:-1], "registers came"),
        ([*block(1020, 3)[:-1], 0], "check"),
        (block(1020, 2), "stale"),
        (block(1010, 3), "frozen"),
        (block(1900, 3), "jumped"),
        (block(1000, 3), "backwards"),
        (block(1020, 3, heartbeat=1010), "heartbeat"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_does_not_go_on_is_thrown_away(words: list[int], why: str) -> None:
    fresh = awake()
    with pytest.raises(BadReply, match=why):
        fresh.believe(words, asked(3, 1.02))
    assert fresh.last_sequence == 1010
    assert fresh.believe(block(1030, 4), asked(4, 1.03)).sequence == 1030


def test_two_replies_of_a_restarted_controller_are_known_as_such() -> None:
    fresh = awake()
    with pytest.raises(BadReply, match="backwards"):
        fresh.believe(block(5, 3), asked(3, 1.02))
    with pytest.raises(Restarted):
        fresh.believe(block(15, 4), asked(4, 1.03))


@given(st.integers(0, 14), st.integers(0, 15))
def test_no_single_flipped_bit_gets_through(word: int, bit: int) -> None:
    fresh, words = awake(), block(1020, 3, position=1.0, force=2.0)
    words[word] ^= 1 << bit
    with pytest.raises(BadReply):
        fresh.believe(words, asked(3, 1.02))


@given(st.sampled_from(["u16", "i16", "u32", "i32"]), st.sampled_from(["big", "little"]), st.data())
def test_numbers_come_back_as_they_were_written(kind: str, order: str, data: st.DataObject) -> None:
    bits = int(kind[1:])
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind[0] == "i" else (0, 2**bits - 1)
    value = data.draw(st.integers(low, high))
    register = Register("value", kind)  # type: ignore[arg-type]
    assert decode_value(register, encode_value(register, value, order), order) == value


def test_the_word_order_of_the_map_counts() -> None:
    register = Register("force", "i32", 1e-5, "N")
    big, little = (encode_value(register, 1.0, order) for order in ("big", "little"))
    assert big == [1, 34464]
    assert little == big[::-1]


def test_a_value_that_does_not_fit_is_refused_with_its_range() -> None:
    with pytest.raises(ValueError, match=r"force = 30000.* is outside -21474\.8 to 21474\.8"):
        encode_value(Register("force", "i32", 1e-5, "N"), 30000.0, "big")


def test_a_map_without_check_echo_and_heartbeat_is_still_judged_by_its_sequence() -> None:
    names = ("check", "request_echo", "heartbeat")
    status = MAP.blocks["status"]
    bare = replace(status, registers=tuple(r for r in status.registers if r.name not in names))
    fresh = Freshness(replace(MAP, blocks={**MAP.blocks, "status": bare}))

    def words(sequence: int) -> list[int]:
        return replace(MAP, blocks={"status": bare}).encode(
            "status", dict.fromkeys(bare.names, 0) | {"sequence": sequence}
        )

    with pytest.raises(BadReply):
        fresh.believe(words(1000), asked(1, 1.0))
    assert fresh.believe(words(1010), asked(2, 1.01)).sequence == 1010
    with pytest.raises(BadReply, match="frozen"):
        fresh.believe(words(1010), asked(3, 1.02))


def test_a_reply_during_which_the_host_stood_still_is_not_believed() -> None:
    # 0.19 s lie within the 0.6 s the question was open, but so would a sequence number that had jumped
    with pytest.raises(BadReply, match="host's clock"):
        awake().believe(block(1200, 3), Asked(3, 1.02, 1.62))


def test_a_force_that_the_converter_stopped_renewing_is_not_believed_though_its_heartbeat_is_new_to_us() -> None:
    # The reply with heartbeat 1040 was lost on the way; the next one repeats its force and heartbeat.
    fresh = lived(awake())
    with pytest.raises(BadReply, match="an old force"):
        fresh.believe(block(1050, 9, heartbeat=1040), asked(9, 1.05))
    assert fresh.believe(block(1060, 10), asked(10, 1.06)).sequence == 1060


def test_the_heartbeat_may_be_one_conversion_off_and_wraps() -> None:
    fresh = Freshness(MAP)
    with pytest.raises(BadReply):
        fresh.believe(block(65520, 1), asked(1, 1.0))
    fresh.believe(block(65530, 2), asked(2, 1.01))
    assert fresh.believe(block(65540, 3, heartbeat=5), asked(3, 1.02)).sequence == 65540


def test_a_reading_a_few_milliseconds_older_than_its_request_is_not_believed() -> None:
    fresh = lived(awake())
    with pytest.raises(BadReply, match="its own request"):
        fresh.believe(block(1042, 9), asked(9, 1.05))
    assert fresh.believe(block(1060, 10), asked(10, 1.06)).sequence == 1060


def test_slow_clocks_are_followed() -> None:
    fresh = awake()
    for k in range(1, 400):  # a controller whose clock is 300 ppm slow
        host_s = 1.01 + 0.1 * k
        fresh.believe(block(1010 + int(100 * k * (1 - 3e-4)), 2 + k), asked(2 + k, host_s))


def test_bounds_from_a_first_reply_that_was_too_old_are_given_up_when_two_agree() -> None:
    fresh = Freshness(MAP)
    with pytest.raises(BadReply):
        fresh.believe(block(985, 1), asked(1, 1.0))
    fresh.believe(block(995, 2), asked(2, 1.01))
    with pytest.raises(BadReply, match="its own request"):
        fresh.believe(block(1020, 3), asked(3, 1.02))
    assert fresh.believe(block(1030, 4), asked(4, 1.03)).sequence == 1030
