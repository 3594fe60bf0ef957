"""Thousands of reads over a bus that loses, flips, cuts, delays and garbles replies: none is ever taken for another."""

import asyncio
import random
import resource
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from thermostand.drivers.sim.units.modbus import Handler, RtuEngine, TcpEngine, answer, reads_bits, reads_words
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import Space
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import DeviceError

TIMEOUT_S = 0.05
LATE_S = 0.08  # later than the time-out, within the quarantine that follows it
MIXED = 0.05
UNITS = (1, 2, 3)
SPACES: tuple[Space, ...] = ("holding", "input", "coil", "discrete")


def truth(unit: int, space: Space, address: int) -> int:
    """A word, or a bit, that belongs to one place alone, so that a reply of another place shows."""
    drawn = random.Random(f"{unit} {space} {address}").randrange(0x10000)
    return drawn & 1 if space in ("coil", "discrete") else drawn


class Table:
    """A unit of which every address holds its truth."""

    def __init__(self, unit: int) -> None:
        self.unit = unit

        def words(space: Space) -> Handler:
            return reads_words(lambda address, count: [truth(unit, space, address + i) for i in range(count)])

        def bits(space: Space) -> Handler:
            return reads_bits(lambda address, count: [bool(truth(unit, space, address + i)) for i in range(count)])

        self._functions = {1: bits("coil"), 2: bits("discrete"), 3: words("holding"), 4: words("input")}

    def handle(self, pdu: bytes) -> bytes | None:
        return answer(pdu, self._functions)


@dataclass(frozen=True, slots=True)
class Counted:
    right: int
    wrong: int
    failed: int
    injected: int


@contextmanager
def served(wire: str, folder: Path, faults: LinkFaults) -> Generator[str]:
    units = [Table(unit) for unit in UNITS]
    line: PtyWire | TcpWire
    if wire == "serial":
        line = PtyWire(folder / "bus", RtuEngine(units), faults)
    else:
        line = TcpWire("127.0.0.1", 0, lambda: TcpEngine(units), faults)
    yield line.address
    line.close()


async def read_at_random(address: str, reads: int, faults: LinkFaults) -> Counted:
    drawn, right, wrong, failed = random.Random(reads), 0, 0, 0
    bus = Bus("bus", BusSettings(address=address, baud=115200, timeout_s=TIMEOUT_S, gap_s=0.0), WallClock())
    await bus.open()
    for _ in range(reads):
        unit, space = drawn.choice(UNITS), drawn.choice(SPACES)
        begin, count = drawn.randrange(0x8000), drawn.randint(8, 40)
        try:
            found = await bus.read("dut", unit, space, begin, count)
        except DeviceError:
            failed += 1
            continue
        is_right = found == [truth(unit, space, begin + i) for i in range(count)]
        right, wrong = right + is_right, wrong + (not is_right)
    await bus.close()
    return Counted(right, wrong, failed, sum(faults.injected.values()))


@pytest.mark.parametrize("wire", ["serial", "tcp"])
@pytest.mark.parametrize("reads", [400, pytest.param(10_000, marks=pytest.mark.nightly)])
async def test_of_thousands_of_reads_with_a_fault_in_every_twentieth_reply_none_is_wrong(
    tmp_path: Path, wire: str, reads: int
):
    """Reads that fail are asked again, so that nearly all come through. No bit flips over TCP, which has a checksum of
    its own, and Modbus TCP none."""
    share = MIXED / 5
    faults = LinkFaults(seed=3, drop=share, flip=share, cut=share, junk=share, late=share, late_by_s=LATE_S)
    if wire == "tcp":
        faults.flip, faults.late = 0.0, 2 * share
    with served(wire, tmp_path, faults) as address:
        counted = await read_at_random(address, reads, faults)
    assert counted.wrong == 0
    assert counted.injected >= 0.03 * reads
    assert counted.failed <= 0.01 * reads
    assert counted.right + counted.failed == reads


@pytest.mark.nightly
async def test_minutes_of_faults_leave_nothing_open_and_no_memory(tmp_path: Path):
    faults = LinkFaults(seed=12, drop=0.02, cut=0.02, junk=0.02, late=0.02, late_by_s=LATE_S)
    with served("tcp", tmp_path, faults) as address:
        await read_at_random(address, 300, faults)
        before_kB, files = (
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
            len(list(Path("/proc/self/fd").iterdir())),
        )
        end_s = time.monotonic() + 180
        while time.monotonic() < end_s:
            assert (await read_at_random(address, 300, faults)).wrong == 0
            await asyncio.sleep(0)
    assert memory_kB() - before_kB < 8_000
    assert open_files() <= files + 2


def memory_kB() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))
