"""A Modbus peer that is not ours: pymodbus servers over TCP and over a pair of joined pseudo-terminals; and a bus
whose far end answers as a test tells it to."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from pymodbus.pdu import ModbusPDU
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import SimDevice

from tests.drivers.bus_responder import TIMEOUT_S, Responder
from thermostand.drivers.sim.wire import LinkFaults, PtyWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.foundation.clock import WallClock

Serve = Callable[[list[SimDevice], list[type[ModbusPDU]]], Awaitable[str]]


class PtyPair:
    """A null-modem cable: what is written to `left` comes out of `right`, and back."""

    def __init__(self) -> None:
        masters, self._slaves = zip(*(os.openpty() for _ in range(2)), strict=True)
        self.left, self.right = (os.ttyname(slave) for slave in self._slaves)
        for slave in self._slaves:
            tty.setraw(slave)
        self._masters = masters
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def _pump(self) -> None:
        other = {self._masters[0]: self._masters[1], self._masters[1]: self._masters[0]}
        while True:
            ready, _, _ = select.select([*self._masters, self._stop_read], [], [])
            if self._stop_read in ready:
                return
            for master in ready:
                os.write(other[master], os.read(master, 4096))

    def close(self) -> None:
        os.write(self._stop_write, b"x")
        self._thread.join()
        for descriptor in (*self._masters, *self._slaves, self._stop_read, self._stop_write):
            os.close(descriptor)


@pytest.fixture(params=["tcp", "serial"])
async def serve_modbus(request: pytest.FixtureRequest) -> AsyncIterator[Serve]:
    """`await serve_modbus(devices, custom_pdus)` -> the address for a Bus."""
    async with contextlib.AsyncExitStack() as stack:

        async def serve(devices: list[SimDevice], custom_pdus: list[type[ModbusPDU]]) -> str:
            if request.param == "tcp":
                tcp = ModbusTcpServer(devices, address=("127.0.0.1", 0), custom_pdu=custom_pdus)
                await tcp.serve_forever(background=True)
                stack.push_async_callback(tcp.shutdown)
                return f"tcp:127.0.0.1:{tcp.transport.sockets[0].getsockname()[1]}"
            cable = PtyPair()
            stack.callback(cable.close)
            server = ModbusSerialServer(devices, port=cable.left, baudrate=9600, custom_pdu=custom_pdus)
            await server.serve_forever(background=True)
            stack.push_async_callback(server.shutdown)
            return f"serial:{cable.right}"

        yield serve


@pytest.fixture
def responder() -> Responder:
    """The far end of `bus`."""
    return Responder()


@pytest.fixture
async def bus(responder: Responder, tmp_path: Path) -> AsyncIterator[Bus]:
    """A bus whose far end answers as it is reported to."""
    wire = PtyWire(tmp_path / "rs485", responder, LinkFaults())
    bus = Bus("rs485", BusSettings(address=f"serial:{tmp_path / 'rs485'}", timeout_s=TIMEOUT_S, gap_s=0.0), WallClock())
    await bus.open()
    yield bus
    await bus.close()
    wire.close()
