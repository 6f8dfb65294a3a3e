"""A URL names a line; one that names none is said so, with what would."""

from __future__ import annotations

import contextlib
import os
import select
import socket

import pytest

from drivers.errors import TransportError
from drivers.rig.bus import open_bus
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


def test_a_serial_port_in_use_is_not_written_to() -> None:
    master, slave = os.openpty()
    first = open_transport(os.ttyname(slave))
    try:
        with pytest.raises(TransportError, match="in use"):
            open_transport(f"serial://{os.ttyname(slave)}?baud=9600")
        assert not select.select([master], [], [], 0)[0]
        first.close()
        open_transport(os.ttyname(slave)).close()
    finally:
        first.close()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize("again", ["127.0.0.1", "localhost"])
def test_a_device_in_use_over_tcp_is_not_even_connected_to(again: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with contextlib.closing(open_transport(f"tcp://127.0.0.1:{port}")):
            server.accept()[0].close()
            with pytest.raises(TransportError, match="in use"):
                open_transport(f"tcp://{again}:{port}")
            assert not select.select([server], [], [], 0)[0]
        open_transport(f"tcp://{again}:{port}").close()


def test_a_connection_that_fails_leaves_the_device_free() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    for _ in range(2):
        with pytest.raises(TransportError, match="refused"):
            open_transport(url)


def test_a_rig_in_use_over_tcp_is_not_even_connected_to_and_free_afterwards() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with contextlib.closing(open_bus(f"modbus-tcp://127.0.0.1:{port}?unit=1", 0.2, 0.1)):
            server.accept()[0].close()
            with pytest.raises(TransportError, match="in use"):
                open_bus(f"modbus-tcp://localhost:{port}?unit=2", 0.2, 0.1)
            assert not select.select([server], [], [], 0)[0]
        open_bus(f"modbus-tcp://localhost:{port}", 0.2, 0.1).close()
    for _ in range(2):
        with pytest.raises(TransportError, match="cannot be opened"):
            open_bus(f"modbus-tcp://127.0.0.1:{port}", 0.2, 0.1)


def test_a_rig_on_a_serial_line_in_use_is_not_opened_and_free_afterwards() -> None:
    master, slave = os.openpty()
    url = f"modbus-rtu://{os.ttyname(slave)}?baud=115200&parity=N"
    try:
        with contextlib.closing(open_bus(url, 0.2, 0.1)), pytest.raises(TransportError, match="in use"):
            open_bus(url, 0.2, 0.1)
        open_bus(url, 0.2, 0.1).close()
    finally:
        os.close(master)
        os.close(slave)
