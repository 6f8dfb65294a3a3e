"""A URL names a line; one that names none is said so, with what would."""

from __future__ import annotations

import os

import pytest

from drivers.errors import TransportError
from drivers.transport import open_transport


@pytest.mark.parametrize("prefix", ["", "serial://"])
def test_a_pseudo_terminal_is_opened_by_its_bare_path_too(prefix: str) -> None:
    master, slave = os.openpty()
    port = open_transport(prefix + os.ttyname(slave))
    try:
        port.write(b"?")
        assert os.read(master, 1) == b"?"
        os.write(master, b"ok")
        assert port.read(1.0) == b"ok"
    finally:
        port.close()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("/dev/nowhere", "no such port"), ("serial:///dev/nowhere", "no such port"), ("tcp://host", "port is missing"),
        ("tcp://host:x", "Port could not"), ("serial:///dev/x?baud=fast", "not a number"),
        ("serial:///dev/x?bits=7", "bits"), ("ttyUSB0", "unknown kind"), ("usb://1", "unknown kind"),
        ("http://[", "write serial"),
    ],
)  # fmt: skip
def test_what_is_no_line_is_said(url: str, said: str) -> None:
    with pytest.raises(TransportError) as caught:
        open_transport(url)
    assert said in str(caught.value)
