"""A climate chamber of any make on its wire, the plant behind it, and its driver."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from drivers.devices.chambers.chamber_settings import ChamberUnitSettings, ClimateChamberSettings
from drivers.devices.chambers.climate_chamber import ClimateChamber
from drivers.sim.faults import LinkFaults
from drivers.sim.physics.plant import Plant, PlantSpec
from drivers.sim.units.climate_chambers import FakeClimateChamber, FakeCts, FakeEspec, FakeWeiss
from drivers.sim.units.julabo_circulator import FakeJulabo
from drivers.sim.units.simserv_chamber import FakeSimserv
from drivers.sim.wire import PtyWire, TcpWire
from foundation.clock import FollowedClock, WallClock, seconds_ns
from foundation.readings import Reading

START_NS = 1_700_000_000_000_000_000
ALLOWED_DEGC = (-10.0, 60.0)
MAKES = ("espec", "cts", "ascii2", "simserv", "julabo")
WIRES = ("tcp", "serial")
ON_WIRES = [(make, wire) for make in MAKES for wire in WIRES if (make, wire) != ("simserv", "serial")]
SETTINGS: TypeAdapter[ChamberUnitSettings] = TypeAdapter(ClimateChamberSettings)


class Bench:
    """A chamber of one make on its wire, the plant behind it, and its driver."""

    def __init__(self, make: str, wire: str, folder: Path, **settings: object) -> None:
        self.plant = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS)
        self.clock = FollowedClock(START_NS)
        self.faults = LinkFaults(seed=5)
        self.fake = self._fake(make, wire)
        self.fake.limits_degC = ALLOWED_DEGC
        self.line: PtyWire | TcpWire = (
            PtyWire(folder / make, self.fake.engine(), self.faults)
            if wire == "serial"
            else TcpWire("127.0.0.1", 0, self.fake.engine, self.faults)
        )
        known: dict[str, object] = {"protocol": make, "address": self.line.address, "timeout_s": 0.3, "gap_s": 0.0}
        if make not in ("espec", "simserv"):
            known["limits_at_panel_degC"] = list(ALLOWED_DEGC)
        if make in ("cts", "julabo"):
            known["parity"] = "N"  # a pseudo-terminal knows none
        if make == "simserv":
            known["off_channels"] = [2]
        self.driver = ClimateChamber(
            "regulator", SETTINGS.validate_python({**known, **settings}), ALLOWED_DEGC, WallClock()
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
        self.clock.follow(self.clock.now_ns() + seconds_ns(duration_s))
        with self.fake.now():
            pass

    async def read(self) -> dict[str, Reading]:
        return {reading.channel.removeprefix("regulator."): reading for reading in await self.driver.read()}


@asynccontextmanager
async def bench_of(make: str, wire: str, folder: Path, **settings: object) -> AsyncGenerator[Any]:
    bench = Bench(make, wire, folder, **settings)
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
