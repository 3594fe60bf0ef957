"""A stand on its wires in virtual time, guarded and kept, without a run: regulator, relays, thermometers, chamber. And
a run of such a stand in real time, in a process of its own, once it heats."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from tests import fork_server
from tests.sections import change
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory, relocate
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.opening.open_stand import OpenStand, open_assembly
from thermostand.stand.running.opening.stop import Stop


@dataclass
class VirtualStand:
    """The open stand, what was polled (channel -> instants in s since the begin, values), and its events."""

    assembly: Assembly
    open_stand: OpenStand
    control: ControlSocket
    clock: VirtualClock
    begin_ns: int
    series: dict[str, list[tuple[float, float]]] = field(default_factory=dict[str, list[tuple[float, float]]])
    events: list[Event] = field(default_factory=list[Event])

    def receive(self, item: Item) -> None:
        if isinstance(item, Event):
            self.events.append(item)
        elif isinstance(item, Batch):
            for reading in item.readings:
                time_s = (reading.time_ns - self.begin_ns) / 1e9
                self.series.setdefault(reading.channel, []).append((time_s, reading.value))

    @property
    def time_s(self) -> float:
        return (self.clock.now_ns() - self.begin_ns) / 1e9

    async def wait(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))

    async def hold(self, set_point_degC: float, duration_s: float) -> None:
        """Go to a set-point and stay there."""
        chamber = self.assembly.stand.chamber
        go = chamber.set_temperature if chamber.permits.is_granted else chamber.start
        await go(set_point_degC)
        await self.wait(duration_s)

    async def break_(self, name: str, value: object) -> None:
        """Inject a fault of the simulated laboratory."""
        with self.clock.hold():  # its socket moves time, too
            await self.control.request({"do": "fault", "name": name, "value": value})

    async def true(self, name: str) -> float:
        """Of the plant."""
        with self.clock.hold():
            return float(str((await self.control.request({"do": "state"}))[name]))

    def trips(self) -> list[str]:
        """What the guard has objected to."""
        return [event.kind.removeprefix("guard.") for event in self.events if event.kind.startswith("guard.")]


def bare_config(name: str, folder: Path, sections: Mapping[str, dict[str, object]] | None = None) -> StandConfig:
    """An installed stand's file without stages and cameras; `sections` replaces entries."""
    data = yaml.safe_load(find_packaged("", name).read_text())
    data |= {"axes": {}, "cameras": {}}
    change(data, dict(sections or {}))
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(data))
    return load_config(path)


@asynccontextmanager
async def virtual_stand(config: StandConfig) -> AsyncGenerator[VirtualStand]:
    """With a simulated laboratory of its own, at free addresses."""
    assert config.simulation is not None
    begin_ns = to_ns(config.simulation.start.timestamp())
    async with Stop(has_signals=False) as stop, AsyncExitStack() as stack:
        simulator = await asyncio.to_thread(
            Simulator, describe_laboratory(config, virtual=True, seed=None, is_anywhere=True)
        )
        stack.push_async_callback(asyncio.to_thread, simulator.stop)
        control = ControlSocket(simulator.addresses["control"])
        stack.push_async_callback(control.close)
        await control.open()
        clock = VirtualClock(begin_ns, control.advance, control.settle)
        assembly = assemble(relocate(config, simulator.addresses), Hub(), clock)
        open_stand = await stack.enter_async_context(open_assembly(assembly, clock.run, stop, is_for_one=True))
        stand = VirtualStand(assembly, open_stand, control, clock, begin_ns)
        assembly.hub.subscribe(stand.receive)
        open_stand.prepare()
        await open_stand.read_once()
        open_stand.start()
        try:
            yield stand
        finally:
            await open_stand.close()


LIMIT_S = 60.0  # real, for what takes a few seconds on a machine that has other things to do
SOAK_RECIPE = "name: soak\nexperiments:\n  - steps:\n      - start_chamber: 45\n      - soak: 100000\n"
REAL_TIME: dict[str, dict[str, object]] = {
    "regulator": {"poll_s": 0.25, "sample_s": 0.25},
    "thermometer_module": {"poll_s": 0.25},
    "relays": {"poll_s": 0.5, "self_test_s": 0.6},
    "flap": {"poll_s": 0.5},
    "guard": {"period_s": 0.5, "heater_hold_s": 30.0, "heater_renew_s": 5.0},
    "recording": {"telemetry_commit_s": 0.2},
}

PlantQuantity = Callable[[str], Awaitable[float]]
"""Of the simulated plant, by its name."""


@asynccontextmanager
async def heating_process(path: Path) -> AsyncGenerator[tuple[subprocess.Popen[str], PlantQuantity]]:
    """A run of the stand in that file, which soaks and heats; and what tells a quantity of its plant."""
    simulated = describe_laboratory(load_config(path), virtual=False, seed=None, is_anywhere=True)
    simulator = await asyncio.to_thread(Simulator, simulated)
    control = ControlSocket(simulator.addresses["control"])
    await control.open()

    async def plant(quantity: str) -> float:
        return float(str((await control.request({"do": "state"}))[quantity]))

    data = yaml.safe_load(path.read_text())
    data["bus"]["address"] = simulator.addresses["bus"]
    data["flap"]["backend_address"] = simulator.addresses["flap"]
    data["simulation"]["control"] = simulator.addresses["control"]
    path.write_text(yaml.safe_dump(data))
    recipe = path.with_name("recipe.yaml")
    recipe.write_text(SOAK_RECIPE)
    run = ["run", recipe, "--config", path, "--out", path.with_name("out")]
    process = fork_server.popen([sys.executable, "-m", "thermostand.stand.cli", *run], stdout=subprocess.DEVNULL)
    try:
        async with asyncio.timeout(LIMIT_S):
            while await plant("heater_W") == 0:
                await asyncio.sleep(0.05)
        yield process, plant
    finally:
        process.kill()
        process.wait(LIMIT_S)
        await control.close()
        await asyncio.to_thread(simulator.stop)
