"""Registers over Modbus TCP or RTU. The only file that knows pymodbus; its errors end here.

One owner, one thread, no retries, no reconnect. After a request that went unanswered the line is listened to, and what
comes is thrown away, for as long as the device may still answer: otherwise the next request is answered by this one's
reply.
"""

from __future__ import annotations

import logging
import socket
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol
from urllib.parse import SplitResult, parse_qs, urlsplit

from drivers.errors import DeviceRefused, DeviceTimeout, TransportError
from drivers.rig.registers import BadReply, Table
from drivers.transport.tcp import claim, why

# pymodbus logs what it also raises; said once, by us, is enough.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

WRITE_TIMEOUT_S = 1.0  # a request is some thirty bytes: three milliseconds on the slowest line that keeps a rate

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, still working",
    6: "device busy",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}


class RegisterBus(Protocol):
    """Reads and writes 16-bit registers of one device.

    Every call returns what was asked for in full, or raises: `DeviceTimeout` (nothing usable came; the line is drained
    already), `BadReply`, `ExceptionReply`, `TransportError` (the line is gone).
    """

    url: str

    def read(self, table: Table, address: int, count: int) -> list[int]:
        """Return `count` registers."""
        ...

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write holding registers in one request."""
        ...

    def exchange(self, read_address: int, count: int, write_address: int, values: Sequence[int]) -> list[int]:
        """Write holding registers and then read some, in one request."""
        ...

    def drain(self) -> None:
        """Throw away what comes for as long as the device may take to answer."""
        ...

    def close(self) -> None:
        """Let go of the line."""
        ...


class ExceptionReply(DeviceRefused):
    """The device answered with a Modbus exception."""

    def __init__(self, who: str, command: str, code: int) -> None:
        super().__init__(who, command, f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}")
        self.code = code


class ModbusBus:
    """A pymodbus client held to the rules at the head of this file."""

    def __init__(
        self, url: str, client: Any, unit: int, timeout_s: float, response_max_s: float, sign: socket.socket | None
    ) -> None:
        self.url, self._sign = url, sign
        self._client, self._unit = client, unit
        self._timeout_s, self._response_max_s = timeout_s, response_max_s
        self._serial = sign is None  # a serial port is locked itself
        self.drained_bytes_count = 0

    def read(self, table: Table, address: int, count: int) -> list[int]:
        """Return `count` registers of `table` from `address`."""
        ask = self._client.read_input_registers if table == "input" else self._client.read_holding_registers
        what = f"{table} registers {address} to {address + count - 1}"
        reply = self._ask(what, 4 if table == "input" else 3, lambda: ask(address, count=count, device_id=self._unit))
        return self._registers(what, reply, count)

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write `values` to the holding registers from `address`, once."""
        what = f"write of registers {address} to {address + len(values) - 1}"
        reply = self._ask(what, 16, lambda: self._client.write_registers(address, list(values), device_id=self._unit))
        if (reply.address, reply.count) != (address, len(values)):
            self.drain()
            raise BadReply(f"{self.url}: {what}: the reply speaks of {reply.count} registers at {reply.address}")

    def exchange(self, read_address: int, count: int, write_address: int, values: Sequence[int]) -> list[int]:
        """Write `values` at `write_address`, then read `count` registers from `read_address`, in one request."""
        what = f"exchange of registers {read_address} to {read_address + count - 1}"
        reply = self._ask(
            what,
            23,
            lambda: self._client.readwrite_registers(
                read_address=read_address,
                read_count=count,
                write_address=write_address,
                values=list(values),
                device_id=self._unit,
            ),
        )
        return self._registers(what, reply, count)

    def close(self) -> None:
        """Close the line, and give the rig free."""
        self._client.close()
        if self._sign is not None:
            self._sign.close()

    def _ask(self, what: str, function: int, ask: Callable[[], Any]) -> Any:
        from pymodbus.exceptions import ConnectionException, ModbusException

        if not self._client.connected:  # pymodbus would connect again by itself, in the middle of a motion
            raise TransportError(self.url, "the line is closed", "check cable and power, then start again")
        try:
            reply = ask()
        except (ConnectionException, OSError) as fault:
            self._client.close()
            raise TransportError(self.url, f"{what}: the line broke", "check cable and power") from fault
        except (ModbusException, struct.error, IndexError, ValueError) as fault:
            # What cannot be parsed is as good as no reply, and the rest of it may still be on its way.
            self.drain()
            raise DeviceTimeout(self.url, what, self._timeout_s, "check unit id, baud rate and cable") from fault
        if reply.isError():
            raise ExceptionReply(self.url, what, int(reply.exception_code))
        if reply.function_code != function:
            self.drain()
            raise BadReply(f"{self.url}: {what}: a reply of function {reply.function_code} came, not {function}")
        return reply

    def _registers(self, what: str, reply: Any, count: int) -> list[int]:
        registers = [int(word) for word in reply.registers]
        if len(registers) != count:
            self.drain()
            raise BadReply(f"{self.url}: {what}: {len(registers)} registers came, {count} were asked for")
        return registers

    def drain(self) -> None:
        """Throw away what comes for as long as the device may take to answer."""
        until_s = time.monotonic() + self._response_max_s
        try:
            while self._client.connected and (left_s := until_s - time.monotonic()) > 0:
                self.drained_bytes_count += self._throw_away(left_s)
        except OSError:
            self._client.close()  # the next request says that the line is gone

    def _throw_away(self, wait_s: float) -> int:
        line = self._client.socket
        if self._serial:
            line.timeout = wait_s
            try:
                return len(line.read(max(1, line.in_waiting)))
            finally:
                line.timeout = self._timeout_s
        line.settimeout(wait_s)
        try:
            got = line.recv(4096)
        except TimeoutError:
            return 0
        if not got:
            self._client.close()
        return len(got)


def open_bus(url: str, timeout_s: float, response_max_s: float) -> ModbusBus:
    """Open `modbus-tcp://host:port?unit=1` or `modbus-rtu:///dev/ttyUSB0?baud=115200&parity=E&unit=1`."""
    try:
        parts = urlsplit(url)
        options = {key: values[-1] for key, values in parse_qs(parts.query).items()}
        unit = int(options.pop("unit", "1"))
        client, serial_line = _client(url, parts, options, timeout_s)
    except ValueError as fault:
        raise TransportError(url, str(fault)) from fault
    if options:
        raise TransportError(url, f"unknown option {', '.join(options)}", "known: unit, and for RTU baud, parity, stop")
    sign = None if serial_line else _claimed(url, client.comm_params.host, client.comm_params.port)
    if serial_line:
        _probe(url, parts.path)
    if not client.connect():
        if sign is not None:
            sign.close()
        raise TransportError(url, "cannot be opened", "check the address, the cable and who else uses the port")
    if serial_line:
        # pyserial calls a write that took longer a broken line, though its bytes are out: a host that was held up.
        client.socket.write_timeout = max(timeout_s, WRITE_TIMEOUT_S)
    # By default pymodbus hangs up after a few lost replies; here the caller decides.
    client.set_max_no_responses(2**31)
    return ModbusBus(url, client, unit, timeout_s, response_max_s, sign)


def _claimed(url: str, host: str, port: int) -> socket.socket:
    """Return the sign that the rig at an address is ours; raise `TransportError` where another program has it.

    Modbus serves several masters at once: without it two of them would move one stage.
    """
    sign = socket.socket(socket.AF_UNIX)
    try:
        claim(sign, host, port)
    except OSError as fault:
        sign.close()
        raise TransportError(url, *why(fault)) from fault
    return sign


def _probe(url: str, port: str) -> None:
    """Raise `TransportError` with the reason why a serial port cannot be opened, which pymodbus keeps to itself."""
    import serial

    try:
        serial.Serial(port, exclusive=True).close()
    except OSError as fault:
        if "lock" in str(fault):
            raise TransportError(url, "the port is in use by another program", "close it, or wait") from fault
        hint = "`ls -l /dev/serial/by-id/` lists the ports; only one program can have one"
        raise TransportError(url, fault.strerror or str(fault), hint) from fault


def _client(url: str, parts: SplitResult, options: dict[str, str], timeout_s: float) -> tuple[Any, bool]:
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient

    if parts.scheme == "modbus-tcp":
        if not parts.hostname:
            raise TransportError(url, "no host in the URL", "write modbus-tcp://host:502?unit=1")
        return ModbusTcpClient(parts.hostname, port=parts.port or 502, timeout=timeout_s, retries=0), False
    if parts.scheme == "modbus-rtu":
        baud, parity = int(options.pop("baud", "115200")), options.pop("parity", "E").upper()
        stop = int(options.pop("stop", "1"))
        client = ModbusSerialClient(
            parts.path, baudrate=baud, parity=parity, stopbits=stop, timeout=timeout_s, retries=0
        )
        return client, True
    raise TransportError(url, f"unknown scheme {parts.scheme!r}", "write modbus-tcp://… or modbus-rtu://…")
