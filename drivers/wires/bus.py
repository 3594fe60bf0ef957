"""Modbus master: one bus, one lane, quarantine after any error, dead units kept from slowing the others.

RTU has no transaction number: a reply that comes after its time-out would be taken for the answer to the next request.
So after any error the line is left silent for longer than the slowest reply, then flushed, then used again
(over TCP the connection is dropped as well). Time-outs, gaps and silences are real seconds; probing a dead unit and
reopening a lost line are on the stand's clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from thermostand.drivers.wires.modbus_client import BusSettings, FaultKind, ModbusClient, WireFault
from thermostand.drivers.wires.registers import Space
from thermostand.foundation.clock import Clock, compute_call_pause_s, to_ns
from thermostand.foundation.errors import DeviceError, GarbledReply, Refused, Unreachable
from thermostand.foundation.workers import WorkerThread

__all__ = ["Bus", "BusCounters", "BusSettings"]

Result = TypeVar("Result")

# Round numbers; nothing was measured. More repeats of a read delay all other units of the bus by a time-out each.
READ_RETRIES = 2
DEAD_AFTER_FAILURES = 5  # transactions: one read with its repeats, and two more
PROBE_PERIODS_S = (1.0, 2.0, 4.0, 8.0, 10.0)  # of a dead unit, the last for good
REOPEN_PERIOD_S = 1.0  # round number; nothing was measured
# Modbus RTU has no transaction numbers: after any error the bus is silent for longer than the slowest reply, then
# flushed. In the soak test no value was wrong with it, some were without.
QUARANTINE_MARGIN_S = 0.05

ERRORS: dict[FaultKind, type[DeviceError]] = {
    FaultKind.LINE_DOWN: Unreachable,
    FaultKind.SILENCE: Unreachable,
    FaultKind.GARBLED: GarbledReply,
    FaultKind.REFUSED: Refused,
}


@dataclass
class BusCounters:
    """What happened on the wire since the bus was made. `skipped`: reads not sent because the unit was dead;
    `stray`: bytes that came without a request; `lines_down`: failures of the port or connection itself."""

    transactions: int = 0
    retries: int = 0
    silences: int = 0
    garbled: int = 0
    refused: int = 0
    lines_down: int = 0
    stray: int = 0
    skipped: int = 0

    def count(self, fault: FaultKind) -> None:
        """One more transaction failed this way."""
        match fault:
            case FaultKind.LINE_DOWN:
                self.lines_down += 1
            case FaultKind.SILENCE:
                self.silences += 1
            case FaultKind.GARBLED:
                self.garbled += 1
            case FaultKind.REFUSED:
                self.refused += 1


@dataclass
class _Health:
    """Failures of one unit in a row, whether the last was silence, and when a dead one is next asked."""

    failures: int = 0
    silent: bool = False
    probe_ns: int = 0

    def failed(self, silent: bool, now_ns: int) -> _Health:
        """Return the health after one more failure."""
        failures = self.failures + 1
        period_s = PROBE_PERIODS_S[min(max(0, failures - DEAD_AFTER_FAILURES), len(PROBE_PERIODS_S) - 1)]
        return _Health(failures, silent, now_ns + to_ns(period_s))


class Bus:
    """A Modbus line that several devices share: `serial:PATH` (RTU) or `tcp:HOST:PORT` (a Modbus TCP gateway).

    All calls raise Unreachable, GarbledReply or Refused naming `device`. Reads are tried up
    to three times when the unit answered last time, be it garbled. Writes go out once, and to a dead unit or line too,
    so that a make-safe is never withheld. `counters` are public.
    """

    def __init__(self, name: str, settings: BusSettings, clock: Clock) -> None:
        self.name = name
        self.address = settings.address
        self.counters = BusCounters()
        self.clock = clock
        self._client = ModbusClient(settings, clock)
        self._gap_s = compute_call_pause_s(clock, settings.gap_s) if self._client.serial else 0.0
        self._quarantine_s = settings.timeout_s + QUARANTINE_MARGIN_S
        self._worker: WorkerThread | None = None
        self._health: dict[int, _Health] = {}
        self._line_fault = ""  # why the line is down, "" while it is up
        self._reopen_ns = 0
        self._free_s = 0.0  # time.monotonic() from which the line may be used again
        self._suspect = False  # an error whose late bytes have not been flushed away yet

    @property
    def is_up(self) -> bool:
        """Whether the port or connection itself works, as far as is known."""
        return not self._line_fault

    async def open(self) -> None:
        """Open the port or connection; raises Unreachable with the reason. Later losses are reopened by themselves."""
        if self._worker is None:
            self._worker = WorkerThread(self.name, self.clock)
        try:
            await self._worker.call(self._client.connect)
        except WireFault as fault:
            raise self._make_failure(self.name, 0, fault) from fault

    async def close(self) -> None:
        """Let go of the line; may be called twice."""
        lane, self._worker = self._worker, None
        if lane is not None:
            await lane.call(self._client.close)
            lane.close()

    async def read(self, device: str, unit: int, space: Space, address: int, count: int) -> list[int]:
        """`count` registers (0..65535) or bits (0 or 1) from `address` (base 0) on."""
        health = self._health.setdefault(unit, _Health())
        if health.failures >= DEAD_AFTER_FAILURES and self.clock.now_ns() < health.probe_ns:
            self.counters.skipped += 1
            raise Unreachable(
                device, f"unit {unit} on {self.name} is dead; asked again every {PROBE_PERIODS_S[-1]:g} s"
            )
        retries = 0 if health.silent else READ_RETRIES
        while True:
            if self._line_fault and self.clock.now_ns() < self._reopen_ns:
                raise Unreachable(device, self._line_fault)
            try:
                return await self._call(device, unit, self._client.read, space, address, count)
            except DeviceError as error:
                if not error.retryable or retries == 0:
                    raise
            retries -= 1
            self.counters.retries += 1

    async def write_register(self, device: str, unit: int, address: int, value: int) -> None:
        """FC 06; after an error it is unknown whether the write took: read back."""
        await self._call(device, unit, self._client.write_register, address, value)

    async def write_registers(self, device: str, unit: int, address: int, values: Sequence[int]) -> None:
        """FC 16; after an error it is unknown whether the write took: read back."""
        await self._call(device, unit, self._client.write_registers, address, values)

    async def write_coil(self, device: str, unit: int, address: int, raw_value: int) -> None:
        """FC 05 with any 16-bit value (0xFF00 on, 0x0000 off, or what the unit defines)."""
        await self._call(device, unit, self._client.write_coil, address, raw_value)

    async def _call(self, device: str, unit: int, function: Callable[..., Result], *args: object) -> Result:
        """One transaction in the lane, its outcome entered in the unit's health and the counters."""
        if self._worker is None:
            raise Unreachable(device, f"{self.name} is not open")
        self.counters.transactions += 1
        try:
            result = await self._worker.call(self._transact, function, unit, *args)
        except WireFault as fault:
            raise self._make_failure(device, unit, fault) from fault
        self._health[unit] = _Health()
        self._line_fault = ""
        return result

    def _make_failure(self, device: str, unit: int, fault: WireFault) -> DeviceError:
        """Count `fault` against the unit, 0 for none, or the line; the error to raise."""
        self.counters.count(fault.fault)
        now_ns = self.clock.now_ns()
        match fault.fault:
            case FaultKind.LINE_DOWN:
                # The first loss is retried at once (a gateway hangs up when idle), a lasting one once a second.
                self._reopen_ns = now_ns + to_ns(REOPEN_PERIOD_S) if self._line_fault else now_ns
                self._line_fault = str(fault)
            case FaultKind.SILENCE | FaultKind.GARBLED:
                silent = fault.fault is FaultKind.SILENCE
                self._health[unit] = self._health.get(unit, _Health()).failed(silent, now_ns)
            case FaultKind.REFUSED:
                self._health[unit] = _Health()
        where = f"unit {unit} on {self.name}: " if unit else ""
        return ERRORS[fault.fault](device, f"{where}{fault}")

    def _transact(self, function: Callable[..., Result], *args: object) -> Result:
        """Wait in the worker thread until the line is free and clean, run one transaction, and set when it is free
        again."""
        self._settle()
        hang_ups = self._client.hang_ups
        try:
            result = function(*args)
        except WireFault as fault:
            if fault.fault is not FaultKind.LINE_DOWN:  # a line that was reopened has nothing late on it
                self._suspect = True
                self._free_s = time.monotonic() + self._quarantine_s
            raise
        finally:
            self.counters.lines_down += self._client.hang_ups - hang_ups
        self._free_s = time.monotonic() + self._gap_s
        return result

    def _settle(self) -> None:
        """Keep the gap, or the quarantine and its flush; unrequested bytes are an error too."""
        _wait_until(self._free_s)
        if not self._suspect and self._client.unread_bytes():
            self.counters.stray += 1
            self._suspect = True
            _wait_until(time.monotonic() + self._quarantine_s)
        if self._suspect:
            self._client.discard_input()
            self._suspect = False


def _wait_until(deadline_s: float) -> None:
    """Silence on the wire until time.monotonic() reaches `deadline_s`."""
    if (left_s := deadline_s - time.monotonic()) > 0:
        time.sleep(left_s)  # noqa: TID251 - silence on a wire is real seconds
