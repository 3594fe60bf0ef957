"""What the bus layer costs: regulator.read() beside pymodbus' own client with the same reads of the same fake.

Ours goes through the register map, the bus and its lane; the peer asks for the same blocks and gives raw words. On a
serial line the bus keeps 5 ms of silence between frames, which no reply of the fake needs; without it the layer's own
cost shows. pymodbus polls a serial port every millisecond.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.client.base import ModbusBaseSyncClient

from tests.bench.fakes import fakes
from tests.bench.figures import Figure, in_turns, per_second, progress, side_by_side
from thermostand.drivers.devices.regulators.regulator import Regulator
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.modbus_unit import Block, plan_blocks
from thermostand.drivers.wires.registers import RegisterMap, load_register_map
from thermostand.foundation.clock import WallClock
from thermostand.stand.config.stand_config import packaged

ROUNDS = 9
READS = 40  # of the regulator, in one measurement
BAUD = 115200
TIMEOUT_s = 1.0
UNIT = 1


def figures(directory: Path) -> list[Figure]:
    """Transactions per second over TCP, and over a serial line with and without the gap."""
    register_map = load_register_map(packaged("registers", "omron-e5cc")).at_unit(UNIT)
    ours, other = directory / "modbus-ours", directory / "modbus-other"
    with fakes("modbus", ours, other) as port:
        tcp = ModbusTcpClient("127.0.0.1", port=int(port), timeout=TIMEOUT_s)
        line = ModbusSerialClient(str(other), baudrate=BAUD, timeout=TIMEOUT_s)
        return [
            _compare("Modbus TCP, regulator.read()", f"tcp:127.0.0.1:{port}", 0.0, tcp, register_map),
            _compare("Modbus pty, regulator.read()", f"serial:{ours}", 0.005, line, register_map),
            _compare("Modbus pty, the same, no gap", f"serial:{ours}", 0.0, line, register_map),
        ]


def _compare(what: str, address: str, gap_s: float, client: ModbusBaseSyncClient, register_map: RegisterMap) -> Figure:
    progress(what)
    blocks = plan_blocks(register_map, register_map.polled())
    bus = Bus("bus", BusSettings(address=address, baud=BAUD, timeout_s=TIMEOUT_s, gap_s=gap_s), WallClock())
    regulator = Regulator("regulator", bus, register_map, WallClock())
    with asyncio.Runner() as runner:
        runner.run(bus.open())
        runner.run(regulator.open())
        client.connect()
        own, other = in_turns(
            lambda: runner.run(_transactions_per_second(bus, regulator)),
            lambda: len(blocks) * per_second(_reads(client, blocks), READS),
            ROUNDS,
        )
        client.close()
        runner.run(bus.close())
    return side_by_side(what, "transactions/s", "bare pymodbus client, same reads", own, other)


async def _transactions_per_second(bus: Bus, regulator: Regulator) -> float:
    before = bus.counters.transactions
    begin_s = time.perf_counter()
    for _ in range(READS):
        await regulator.read()
    return (bus.counters.transactions - before) / (time.perf_counter() - begin_s)


def _reads(client: ModbusBaseSyncClient, blocks: tuple[Block, ...]) -> Callable[[], None]:
    def read() -> None:
        for block in blocks:
            reply = client.read_holding_registers(block.address, count=block.count, device_id=UNIT)
            if len(reply.registers) != block.count:
                raise ValueError(f"the peer read {reply}")

    return read
