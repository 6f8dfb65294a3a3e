"""The simulated controller behind modbus-tk's server: `modbus_tk_rig.py tcp PORT | rtu DEVICE`, prints "ready".

modbus-tk answers function 23 before it has written, against the specification, so this peer is read with two requests
(`exchange: false` in the register map), as a rig without function 23 would be.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import modbus_tk.defines as cst
from modbus_tk import modbus_rtu, modbus_tcp

from simulators.rig import registers as R
from simulators.rig.controller import TICK_S, Controller, Machine
from simulators.specimens.analytic import linear
from simulators.specimens.curve import Specimen

BLOCKS = {rows[0][1]: R.length(rows) for rows in (R.COMMAND, R.SETTINGS, R.FEED)}


class Live:
    """A block of modbus-tk whose values are the controller's at the moment they are asked for."""

    starting_address, size = 0, 200

    def __init__(self, table: str, device: Controller, began_s: float) -> None:
        self._table, self._device, self._began_s = table, device, began_s
        self._coming: dict[int, int] = {}

    def __getitem__(self, item: slice) -> list[int]:
        self._catch_up()
        return self._device.read(self._table, item.start, item.stop - item.start) or [0] * (item.stop - item.start)

    def __setitem__(self, address: int, value: int) -> None:
        self._catch_up()
        self._coming[address] = value
        for start, count in BLOCKS.items():
            if address == start + count - 1:
                self._device.write(start, [self._coming.get(start + k, 0) for k in range(count)])

    def _catch_up(self) -> None:
        behind = int((time.monotonic() - self._began_s) / TICK_S) - self._device.tick_count
        self._device.advance(max(0, behind))


def await_listening(port: int) -> None:
    """Return when the server accepts: it binds in a thread of its own, some time after `start` has returned."""
    for _ in range(500):
        with contextlib.suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        time.sleep(0.01)
    raise SystemExit(f"nothing listens on port {port}")


def main(kind: str, where: str) -> None:
    device = Controller(Machine(noise_N=0.0, zero_N=0.0, backlash_mm=0.0), Specimen(linear(0.5)))
    if kind == "tcp":
        server = modbus_tcp.TcpServer(int(where), "127.0.0.1")
    else:
        import serial

        server = modbus_rtu.RtuServer(serial.Serial(where, 115200))
    slave = server.add_slave(1)
    began_s = time.monotonic()
    slave._memory[cst.HOLDING_REGISTERS].append(Live("holding", device, began_s))
    slave._memory[cst.ANALOG_INPUTS].append(Live("input", device, began_s))
    server.start()
    if kind == "tcp":
        await_listening(int(where))
    print("ready", flush=True)
    while True:
        time.sleep(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
