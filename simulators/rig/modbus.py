"""Modbus on the device's side: frames in, frames out. Written from the specification; no library."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Protocol

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4


class Registers(Protocol):
    """What a device must offer to be spoken to."""

    def read(self, table: str, address: int, count: int) -> list[int] | None:
        """Return registers, or None where there are none."""
        ...

    def write(self, address: int, words: list[int]) -> bool:
        """Take registers, or say no."""
        ...


@dataclass(frozen=True)
class Request:
    """One request frame: `transaction` is 0 on a serial line; `length_bytes_count` is its length on the wire."""

    transaction: int
    unit: int
    pdu: bytes
    length_bytes_count: int


def answer(pdu: bytes, device: Registers) -> bytes:
    """Return the reply to one request, an exception where the device says no."""
    function = pdu[0]
    try:
        if function in (3, 4):
            address, count = struct.unpack(">HH", pdu[1:5])
            return _read(function, device, address, count)
        if function == 16:
            address, count, size = struct.unpack(">HHB", pdu[1:6])
            return _write(device, address, count, pdu[6 : 6 + size])
        if function == 23:
            read_at, count, write_at, writes, size = struct.unpack(">HHHHB", pdu[1:10])
            wrote = _write(device, write_at, writes, pdu[10 : 10 + size])
            return _refuse(23, wrote[1]) if wrote[0] & 0x80 else _read(23, device, read_at, count)
    except struct.error:
        return _refuse(function, ILLEGAL_VALUE)
    return _refuse(function, ILLEGAL_FUNCTION)


def _read(function: int, device: Registers, address: int, count: int) -> bytes:
    if not 1 <= count <= 125:
        return _refuse(function, ILLEGAL_VALUE)
    words = device.read("input" if function == 4 else "holding", address, count)
    if words is None:
        return _refuse(function, ILLEGAL_ADDRESS)
    return struct.pack(f">BB{count}H", function, 2 * count, *words)


def _write(device: Registers, address: int, count: int, raw: bytes) -> bytes:
    if len(raw) != 2 * count:
        return _refuse(16, ILLEGAL_VALUE)
    if not device.write(address, list(struct.unpack(f">{count}H", raw))):
        return _refuse(16, ILLEGAL_VALUE)
    return struct.pack(">BHH", 16, address, count)


def _refuse(function: int, code: int) -> bytes:
    return bytes([function | 0x80, code])


def crc16(data: bytes) -> int:
    """Return the Modbus RTU check of `data` (low byte goes first on the line)."""
    check = 0xFFFF
    for byte in data:
        check ^= byte
        for _ in range(8):
            check = check >> 1 ^ (0xA001 if check & 1 else 0)
    return check


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Return a serial frame."""
    body = bytes([unit]) + pdu
    return body + crc16(body).to_bytes(2, "little")


def tcp_frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return a frame with the MBAP header."""
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


def take_tcp(buffer: bytearray) -> Request | None:
    """Take the first whole request from `buffer`, or None while there is none."""
    if len(buffer) < 8:
        return None
    transaction, _, length, unit = struct.unpack(">HHHB", buffer[:7])
    if len(buffer) < 6 + length:
        return None
    pdu = bytes(buffer[7 : 6 + length])
    del buffer[: 6 + length]
    return Request(transaction, unit, pdu, 6 + length)


def take_rtu(buffer: bytearray) -> Request | None:
    """Take the first whole request with a good check, skipping what is none; None while there is none."""
    while len(buffer) >= 4:
        length = _rtu_length(buffer)
        if length is None or len(buffer) < length:
            return None
        frame = bytes(buffer[:length])
        if crc16(frame[:-2]).to_bytes(2, "little") == frame[-2:]:
            del buffer[:length]
            return Request(0, frame[0], frame[1:-2], length)
        del buffer[0]
    return None


def _rtu_length(buffer: bytearray) -> int | None:
    """Return the length of the request that begins the buffer; 4 for an unknown function, to skip it."""
    function = buffer[1]
    if function in (3, 4, 6):
        return 8
    if function == 16:
        return 9 + buffer[6] if len(buffer) > 6 else None
    if function == 23:
        return 13 + buffer[10] if len(buffer) > 10 else None
    return 4
