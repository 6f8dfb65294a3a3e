from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.grbl.meanings import ALARMS, ERRORS, alarm_meaning, error_meaning
from drivers.grbl.messages import Alarm, Banner, Error, Garbled, Info, Listener, Ok, Report, Setting, parse_line
from drivers.grbl.settings import identify


def test_an_ok_is_exactly_ok() -> None:
    assert parse_line("ok") == [Ok()]
    for text in ("okok", "o", "k", "OK", "ok ", "oj", "ook"):
        assert not any(isinstance(message, Ok) for message in parse_line(text)), text


@given(st.binary(max_size=40))
def test_noise_never_becomes_an_answer(noise: bytes) -> None:
    if re.search(rb"(^|\n)\0*o\0*k\0*\r*\0*\r*\n", noise) or b"error" in noise or b"ALARM" in noise:
        return
    reportless = re.sub(rb"<[^<>]*>", b"", noise.replace(b"\0", b""))
    if re.search(rb"(^|\n)ok\r*(\n|$)", reportless):
        return
    found = Listener().feed(noise + b"\r\n")
    assert not any(isinstance(message, Ok | Error | Alarm) for message in found)


def test_a_report_that_merged_with_an_answer_is_both() -> None:
    for text in ("<Idle|MPos:1.000,2.000,0.000|FS:0,0>ok", "ok<Idle|MPos:1.000,2.000,0.000|FS:0,0>"):
        found = parse_line(text)
        assert Ok() in found
        assert any(isinstance(m, Report) and m.machine_mm == (1.0, 2.0, 0.0) for m in found)


def test_a_report_tells_everything_in_it() -> None:
    text = "<Hold:1|MPos:-1.500,2.000,0.000|Bf:12,100|FS:1500,400|Pn:XD|WCO:1.000,2.000,3.000|Ov:110,50,90|A:CF>"
    (found,) = parse_line(text)
    assert found == Report(
        "Hold", 1, (-1.5, 2.0, 0.0), None, (1.0, 2.0, 3.0), 1500.0, 400.0, 12, 100, (110, 50, 90), "CF", "XD"
    )
    assert isinstance(found, Report)
    assert found.moving
    assert not found.standing


@pytest.mark.parametrize("text", ["<Run|MPos:1.0,x,0|FS:0,0>", "<Rin|MPos:0,0,0>", "<Run|MPos:1.0", "Run|FS:0,0>"])
def test_a_garbled_report_is_known_as_one(text: str) -> None:
    (found,) = parse_line(text)
    assert isinstance(found, Garbled)
    assert found.is_report


def test_a_zero_byte_is_left_out_and_counted() -> None:
    listener = Listener()
    assert listener.feed(b"o\0k\r\n") == [Ok()]
    assert listener.nul_count == 1


def test_bytes_may_come_in_any_pieces() -> None:
    text = b"ok\r\n<Idle|MPos:0.000,0.000,0.000|FS:0,0>\r\nerror:20\r\nALARM:3\r\n$110=500.000\r\n"
    whole, pieces = Listener(), Listener()
    one = whole.feed(text)
    two = [m for byte in text for m in pieces.feed(bytes([byte]))]
    assert one == two
    assert one[-1] == Setting(110, "500.000")
    assert [type(m) for m in one] == [Ok, Report, Error, Alarm, Setting]


@pytest.mark.parametrize(
    "text",
    [
        "Grbl 1.1h ['$' for help]",
        "GrblHAL 1.1f ['$' or '$HELP' for help]",
        "Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]",
    ],
)
def test_every_dialect_has_a_banner(text: str) -> None:
    assert parse_line(text) == [Banner(text)]


def test_the_receive_buffer_is_the_third_field_not_the_second() -> None:
    assert identify([Info("OPT", "V,15,128")], None).rx_bytes == 128
    assert identify([Info("OPT", "V,35,1024,3,0")], None).rx_bytes == 1024
    assert identify([Info("OPT", "V,15,128")], None).planner_count == 15


def test_without_the_field_the_idle_buffer_counts_and_else_128() -> None:
    idle = Report("Idle", free_blocks=15, free_bytes=255)
    assert identify([Info("OPT", "PHS")], idle).rx_bytes == 255
    assert identify([Info("OPT", "PHS")], None).rx_bytes == 128
    assert identify([Info("OPT", "PHS")], Report("Run", free_bytes=3)).rx_bytes == 128


@pytest.mark.parametrize(
    ("told", "free", "most"), [(1024, 1023, 1023), (1024, 128, 128), (128, 255, 128), (128, 3, 128)]
)
def test_of_two_buffer_sizes_the_smaller_one_counts(told: int, free: int, most: int) -> None:
    for state in ("Idle", "Alarm"):
        assert identify([Info("OPT", f"V,15,{told}")], Report(state, free_bytes=free)).rx_bytes == most
    assert identify([Info("OPT", f"V,15,{told}")], Report("Run", free_bytes=free)).rx_bytes == told


@pytest.mark.parametrize("text", ["error:{}", "ALARM:{}", "${}=1", "$N{}=", "<Hold:{}|FS:0,0>", "<Idle|Bf:{},1>"])
def test_a_number_of_thousands_of_digits_is_noise(text: str) -> None:
    (found,) = parse_line(text.format("1" * 5000))
    assert isinstance(found, Garbled)


def test_dialects_name_themselves() -> None:
    assert identify([Info("VER", "1.1h.20190830:")], None).firmware == "grbl"
    assert identify([Info("VER", "3.7 FluidNC v3.7.8:")], None).firmware == "FluidNC"
    assert identify([Info("FIRMWARE", "grblHAL")], None).firmware == "grblHAL"


def test_every_number_has_a_meaning_and_a_remedy() -> None:
    assert set(ERRORS) >= set(range(1, 18)) | set(range(20, 39))
    assert set(ALARMS) >= set(range(1, 10))
    for meaning, hint in [*ERRORS.values(), *ALARMS.values(), error_meaning(999), alarm_meaning(999)]:
        assert meaning
        assert hint


@pytest.mark.parametrize(
    "line", ["<Idle|MPos:nan,0.000,0.000|FS:0,0>", "<Idle|MPos:1e999,0,0>", "<Idle|MPos:0,0,0|FS:inf,0>"]
)
def test_a_place_that_is_no_number_is_not_a_report(line: str) -> None:
    assert isinstance(parse_line(line)[0], Garbled)
