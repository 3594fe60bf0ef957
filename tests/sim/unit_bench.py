"""A unit of the bus in the plant, with a clock the test moves, and pymodbus as its master."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import BusUnit, RtuEngine, TcpEngine, Unit
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.foundation.clock import FollowedClock, to_ns

START_NS = 1_700_000_000_000_000_000


class UnitBench:
    def __init__(self, make: Callable[[Plant, FollowedClock], BusUnit], initial_degC: float | None = None) -> None:
        self.plant = Plant(PlantSpec(laboratory_swing_K=0.0, initial_degC=initial_degC), START_NS)
        self.clock = FollowedClock(START_NS)
        self.unit = make(self.plant, self.clock)

    def reply(self, request: str) -> bytes:
        reply = self.unit.handle(bytes.fromhex(request))
        assert reply is not None
        return reply

    def ask(self, request: str) -> str | None:
        reply = self.unit.handle(bytes.fromhex(request))
        return None if reply is None else reply.hex(" ").upper()

    def done(self, request: str) -> None:
        """The reply repeats the request."""
        assert self.ask(request) == bytes.fromhex(request).hex(" ").upper()

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + to_ns(duration_s))


@contextmanager
def serial_master(path: Path, units: Sequence[Unit], faults: LinkFaults | None = None) -> Generator[ModbusSerialClient]:
    """Over a pseudo-terminal; without parity, which it does not carry, and some kernels refuse to be asked for."""
    wire = PtyWire(path, RtuEngine(units), faults or LinkFaults())
    client = ModbusSerialClient(str(path), framer=FramerType.RTU, baudrate=115200, timeout=3.0, retries=0)
    assert client.connect()
    yield client
    client.close()
    wire.close()


@contextmanager
def gateway_master(units: Sequence[Unit]) -> Generator[ModbusTcpClient]:
    """Through a gateway."""
    wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine(units), LinkFaults())
    client = ModbusTcpClient("127.0.0.1", port=wire.port, timeout=5, retries=0)
    assert client.connect()
    yield client
    client.close()
    wire.close()
