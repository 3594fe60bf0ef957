"""A climate chamber of any make on its wire, the plant behind it, and its driver."""

from __future__ import annotations

import threading
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from thermostand.drivers.devices.chambers.chamber_language import ChamberUnitSettings
from thermostand.drivers.devices.chambers.climate_chamber import ClimateChamber, ClimateChamberSettings
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.climate_chambers import (
    FakeClimateChamber,
    FakeCts,
    FakeEspec,
    FakeJulabo,
    FakeSimserv,
    FakeWeiss,
)
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.line_client import LineClient
from thermostand.foundation.clock import Clock, FollowedClock, WallClock, to_ns
from thermostand.foundation.readings import Reading

LIMIT_S = 60.0  # of what comes at once; a test that fails is not to hang
START_NS = 1_700_000_000_000_000_000
ALLOWED_DEGC = (-10.0, 60.0)
MAKES = ("espec", "cts", "ascii2", "simserv", "julabo")
WIRES = ("tcp", "serial")
ON_WIRES = [(make, wire) for make in MAKES for wire in WIRES if (make, wire) != ("simserv", "serial")]
SETTINGS: TypeAdapter[ChamberUnitSettings] = TypeAdapter(ClimateChamberSettings)


class Sent(list[bytes]):
    """Pieces of a reply, and what is called when the last has been written."""

    def __init__(self, pieces: Iterable[bytes], then: Callable[[], None]) -> None:
        super().__init__(pieces)
        self._then = then

    def __iter__(self) -> Iterator[bytes]:
        yield from super().__iter__()
        self._then()


class Held(LinkFaults):
    """Faults, and a reply that comes when who asked has given up, and before it asks again: however busy the machine
    is. `noticed` has a client tell when it gives up."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._is_held = False
        self._given_up, self._sent = threading.Event(), threading.Event()

    def hold(self) -> None:
        """The next reply is too late."""
        self._given_up.clear()
        self._sent.clear()
        self._is_held = True

    def apply(self, request: bytes, reply: bytes) -> list[bytes]:
        if not self._is_held:
            return super().apply(request, reply)
        assert self._given_up.wait(LIMIT_S)
        self._is_held = False
        return Sent([reply], self._sent.set)

    def noticed(self, quarantine: Callable[[LineClient], None]) -> Callable[[LineClient], None]:
        """The same, after which a reply that is held has come."""

        def begins(client: LineClient) -> None:
            is_held = self._is_held
            quarantine(client)
            self._given_up.set()
            assert not is_held or self._sent.wait(LIMIT_S)

        return begins


class Bench:
    """A chamber of one make on its wire, the plant behind it, and its driver."""

    def __init__(self, make: str, wire: str, folder: Path, clock: Clock | None = None, /, **settings: object) -> None:
        self.plant = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS)
        self.clock = FollowedClock(START_NS)
        self.faults = Held(seed=5)
        self.fake = self._fake(make, wire)
        self.fake.limits_degC = ALLOWED_DEGC
        self.line: PtyWire | TcpWire = (
            PtyWire(folder / make, self.fake.engine(), self.faults)
            if wire == "serial"
            else TcpWire("127.0.0.1", 0, self.fake.engine, self.faults)
        )
        known: dict[str, object] = {"protocol": make, "address": self.line.address, "timeout_s": 1.0, "gap_s": 0.0}
        if make not in ("espec", "simserv"):
            known["limits_at_panel_degC"] = list(ALLOWED_DEGC)
        if make in ("cts", "julabo"):
            known["parity"] = "N"  # a pseudo-terminal knows none
        if make == "simserv":
            known["off_channels"] = [2]
        self.driver = ClimateChamber(
            "regulator", SETTINGS.validate_python({**known, **settings}), ALLOWED_DEGC, clock or WallClock()
        )

    def _fake(self, make: str, wire: str) -> FakeClimateChamber:
        if make == "espec":
            return FakeEspec(self.plant, self.clock)
        if make == "cts":
            return FakeCts(self.plant, self.clock, is_serial=wire == "serial")
        if make == "simserv":
            return FakeSimserv(self.plant, self.clock)
        if make == "julabo":
            return FakeJulabo(self.plant, self.clock)
        return FakeWeiss(self.plant, self.clock)

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + to_ns(duration_s))
        with self.fake.now():
            pass

    async def read(self) -> dict[str, Reading]:
        return {reading.channel.removeprefix("regulator."): reading for reading in await self.driver.read()}


@asynccontextmanager
async def bench_of(
    make: str, wire: str, folder: Path, clock: Clock | None = None, /, **settings: object
) -> AsyncGenerator[Any]:
    bench = Bench(make, wire, folder, clock, **settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LineClient, "_quarantine", bench.faults.noticed(vars(LineClient)["_quarantine"]))
        try:
            yield bench
        finally:
            await bench.driver.close()
            bench.line.close()


@asynccontextmanager
async def running_at_30_degC(make: str, folder: Path) -> AsyncGenerator[Any]:
    async with bench_of(make, "tcp", folder) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        await bench.driver.run()
        yield bench
