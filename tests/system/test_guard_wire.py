"""Every rule against the simulator with its fault, over the real wires: found in time, and the stand is safe.

The guard's callbacks only write down what trips.
"""

import asyncio
import json
import socket
import struct
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from tests.system.conftest import AS_INSTALLED, CORNER, SHORT_RECIPE
from thermostand.foundation.clock import NS_PER_S, Clock, VirtualClock, WallClock, block_until, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.assembly.simulator import ControlSocket, Simulator
from thermostand.stand.chamber.compressor import CompressorState, save_state
from thermostand.stand.config.stand_config import CompressorConfig, StandConfig, find_packaged
from thermostand.stand.guarding.rules import Announcements, make_watches
from thermostand.stand.running.order import Order
from thermostand.stand.safety.fault import Fault
from thermostand.stand.service.run import run_virtual

POLLED = AS_INSTALLED

Start = Callable[[StandConfig, bool], Simulator]


@dataclass
class Bench:
    """A stand without its camera, polled and guarded in virtual time."""

    order: Order
    assembly: Assembly
    clock: Clock
    control: ControlSocket
    events: list[Event]
    trips: list[Fault] = field(default_factory=list[Fault])
    guarding: list[asyncio.Task[None]] = field(default_factory=list[asyncio.Task[None]])

    async def fault(self, name: str, value: object) -> None:
        with self.clock.hold():
            await self.control.request({"do": "fault", "name": name, "value": value})

    async def plant(self, quantity: str) -> float:
        with self.clock.hold():
            return float(str((await self.control.request({"do": "state"}))[quantity]))

    async def wait(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))

    async def start(self, chamber_degC: float, soak_s: float) -> None:
        """A chamber in good order, guarded by a guard with no memory of what was."""
        self.trips.clear()
        guard = self.assembly.make_guard(self.trips.append, self.trips.append)
        assert guard.look()
        self.guarding = [
            asyncio.create_task(guard.run()),
            asyncio.create_task(self.assembly.stand.chamber.permit_renewer.run()),
        ]
        await self.assembly.stand.chamber.start(chamber_degC)
        await self.wait(soak_s)
        assert self.trips == []
        assert await self.plant("heater_enabled") == 1

    async def tripped(self, within_s: float) -> Fault:
        """The trip that comes within that time, after which heat is off at the plant and the flap closed."""
        end_ns = self.clock.now_ns() + to_ns(within_s)
        while not self.trips:
            assert self.clock.now_ns() < end_ns, f"no trip within {within_s} s"
            await self.wait(5)
        await self.wait(5)
        assert len(self.trips) == 1
        assert await self.plant("heater_enabled") == 0
        assert await self.plant("heater_W") == 0
        assert await self.plant("compressor_on") == 0
        await self.end()
        return self.trips[0]

    async def make_safe(self) -> None:
        self.assembly.stand.safety.demand()
        assert await self.assembly.stand.safety.wait_until_confirmed(60)

    async def end(self) -> None:
        await _cancel(self.guarding)


async def _cancel(tasks: Sequence[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


@asynccontextmanager
async def bench_of(order: Order, start: Start) -> AsyncIterator[Bench]:
    """A bench against a simulator of its own."""
    simulation = order.config.simulation
    assert simulation is not None
    await asyncio.to_thread(start, order.config, True)
    async with bench_from(order, to_ns(simulation.start.timestamp())) as bench:
        yield bench


def write_by_another_master(order: Order, unit: int, function: int, address: int, value: int) -> None:
    """FC 05 or 06 at the bus' gateway, as any other program could send it."""
    _, host, port = order.config.bus.address.split(":")
    with socket.create_connection((host, int(port)), 5.0) as line:
        request = struct.pack(">HHHBBHH", 1, 0, 6, unit, function, address, value)
        line.sendall(request)
        assert line.recv(64) == request


@asynccontextmanager
async def bench_from(order: Order, start_ns: int | None) -> AsyncIterator[Bench]:
    """A bench, which begins at that instant, or in real time, against the simulator that runs."""
    simulation = order.config.simulation
    assert simulation is not None
    driver, faults = ControlSocket(simulation.control), ControlSocket(simulation.control)
    await driver.open()
    await faults.open()
    clock, hub = WallClock() if start_ns is None else VirtualClock(start_ns, driver.advance), Hub()
    assembly = assemble(order.config, hub, clock)
    events: list[Event] = []
    bench = Bench(
        order, assembly, clock, faults, events
    )  # which the hub must not know: pyusb closes what nobody refers to
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    tasks = [asyncio.create_task(clock.run() if isinstance(clock, VirtualClock) else asyncio.Event().wait())]
    devices = assembly.devices
    try:
        await assembly.bus.open()
        for device in (devices.relays, devices.regulator, devices.flap, *devices.axes.values()):
            await device.open()
            assembly.stand.opened(device)
        await devices.thermometers.open()
        await devices.regulator.stop()
        await devices.flap.move_closed()
        pollers = [poller for poller in assembly.make_pollers() if poller.sensor is not devices.cameras["camera"]]
        for poller in pollers:
            await poller.first()
        tasks.extend(asyncio.create_task(poller.run()) for poller in pollers)
        yield bench
    finally:
        await bench.end()
        await assembly.stand.safety.close()
        await _cancel(tasks[1:])
        for close in (*(axis.close for axis in devices.axes.values()), devices.flap.close):
            await close()
        await assembly.bus.close()
        await _cancel(tasks[:1])
        await driver.close()
        await faults.close()


@dataclass(frozen=True, slots=True)
class Row:
    """A chamber that was started at start_degC and soaked; `fault` = `value` then trips `rule` within a time, and the
    fault's text has `says`. before: the fault is there when the chamber is started. then_degC: the next set-point, at
    which it shows."""

    fault: str
    value: object
    rule: str
    action: str
    says: str = ""
    within_s: float = 60
    start_degC: float = 26
    soak_s: float = 60
    before: bool = False
    then_degC: float | None = None


ROWS = (
    Row("regulator.set_point_degC", 45, "device_fault", "hold", "set point changed at the unit"),
    Row("regulator.stop_key", True, "regulator_stopped", "hold"),
    Row("regulator.manual_percent", 30, "device_fault", "hold", "manual"),
    Row("relays.lost_writes", True, "permit_missing", "hold", within_s=120),
    Row("axis.alarm", "rotary", "stage_alarm", "hold", "rotary.position: controller alarm"),
    Row("thermometer.offset_K", {"granite_inside": 40.0}, "over_temperature", "abort", "granite_inside is", 20),
    Row("thermometer.offset_K", {"air": 9.0}, "sensors_disagree", "abort", "", 140, 28, 20, before=True),
    Row("thermometer.open", "air", "sensor_bad", "abort", "thermometers.air is BAD", 20, 24, 20),
    Row("regulator.stuck_pv_degC", 20.0, "sensor_stuck", "hold", "", 120, 20, 1200, then_degC=45),
    Row("heater.cut_out", True, "first_heat", "hold", "", 700, 22, then_degC=50),  # no heat was needed before
    Row("heater.welded_share", 0.7, "warming_while_off", "abort", "", 600, 30, 1200),
)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.fault}-{row.rule}")
async def test_a_fault_trips_its_rule_in_time_and_the_stand_is_safe(
    order: Callable[..., Order], simulator: Start, row: Row
):
    async with bench_of(order(), simulator) as bench:
        if row.before:
            await bench.fault(row.fault, row.value)
        await bench.start(row.start_degC, row.soak_s)
        if not row.before:
            await bench.fault(row.fault, row.value)
        if row.then_degC is not None:
            await bench.assembly.stand.chamber.set_temperature(row.then_degC)
        trip = await bench.tripped(row.within_s)
        assert (trip.rule, trip.action) == (row.rule, row.action)
        assert row.says in trip.text
        missing = "permit_not_renewed" in {event.kind for event in bench.events}
        assert missing == (row.rule == "permit_missing")


async def test_a_flap_that_is_left_open_holds_the_stand_and_is_closed(order: Callable[..., Order], simulator: Start):
    async with bench_of(order(), simulator) as bench:
        await bench.start(26, 60)
        await bench.assembly.stand.imaging.open_flap()
        trip = await bench.tripped(400)
        assert (trip.rule, trip.action) == ("flap_open", "hold")
        assert await bench.plant("flap_open") < 0.05


async def test_a_flap_that_cannot_be_closed_is_not_confirmed_safe(order: Callable[..., Order], simulator: Start):
    async with bench_of(order(), simulator) as bench:
        await bench.start(26, 60)
        await bench.assembly.stand.imaging.open_flap()
        await bench.fault("flap.jam", 2000)
        await bench.tripped(400)
        assert await bench.plant("flap_open") > 0.3
        unsafe = [event for event in bench.events if event.kind == "not_confirmed_safe"]
        assert [event.level for event in unsafe] == ["error"]
        assert "flap: jammed" in unsafe[0].text


async def test_a_thermometer_that_sticks_is_a_warning(order: Callable[..., Order], simulator: Start):
    async with bench_of(order(), simulator) as bench:
        await bench.start(28, 60)
        await bench.fault("thermometer.stuck_degC", {"granite_outside": 24.0})
        await bench.wait(1000)
        stuck = [event for event in bench.events if event.kind == "guard.sensor_stuck"]
        assert [event.level for event in stuck] == ["warning"]
        assert "thermometers.granite_outside has been exactly" in stuck[0].text
        assert bench.trips == []
        await bench.end()


async def test_a_daemon_that_starts_again_spares_the_compressor_as_one_that_goes_on(
    tmp_path: Path, order: Callable[..., Order], simulator: Start
):
    """Off for 100 s before the restart leaves 200 of the 300 s; the starts of the last hour count, too."""
    ordered = order()
    compressor = CompressorConfig(state_file=tmp_path / "state" / "compressor.json", max_starts_per_h=2)
    ordered = replace(ordered, config=ordered.config.model_copy(update={"compressor": compressor}))
    async with bench_of(ordered, simulator) as bench:
        await bench.start(10, 290)
        assert await bench.plant("compressor_on") == 0
        await bench.wait(20)
        assert await bench.plant("compressor_on") == 1
        await bench.end()
        await bench.make_safe()
        await bench.wait(100)
        restart_ns = bench.clock.now_ns()
    async with bench_from(ordered, restart_ns) as bench:
        await bench.start(10, 190)
        assert await bench.plant("compressor_on") == 0
        await bench.wait(20)
        assert await bench.plant("compressor_on") == 1
        await bench.end()
        await bench.make_safe()
        await bench.wait(900)
        restart_ns = bench.clock.now_ns()
    async with bench_from(ordered, restart_ns) as bench:
        await bench.start(10, 1000)
        assert await bench.plant("compressor_on") == 0  # a third start within the hour
        await bench.end()


async def test_a_relay_board_that_stays_silent_holds_the_stand(order: Callable[..., Order], simulator: Start):
    """Its timed-on relays have dropped by themselves meanwhile."""
    ordered = order(bus={"timeout_s": 0.05}, relays={"poll_s": 5.0}, guard={"panel_change_grace_s": 10.0})
    async with bench_of(ordered, simulator) as bench:
        await bench.start(26, 60)
        await bench.fault("relays.silent_s", 22)
        await bench.wait(19)
        assert (bench.trips, await bench.plant("heater_enabled")) == ([], 0)
        trip = await bench.tripped(60)
        assert (trip.rule, trip.action) == ("sensor_bad", "hold")
        assert trip.text.startswith("relays.heater_enable is BAD")


async def test_what_somebody_left_switched_on_is_switched_off_and_reported_before_anything_else(
    tmp_path: Path, order: Callable[..., Order], simulator: Start
):
    """Relays that are on for good, a running regulator and its old set-point; the compressor's rest begins now,
    whatever its file says."""
    ordered, state_file = order(), tmp_path / "compressor.json"
    simulation = ordered.config.simulation
    assert simulation is not None
    start_ns = to_ns(simulation.start.timestamp())
    save_state(state_file, CompressorState(False, start_ns - to_ns(7200)), boot=None)
    compressor = CompressorConfig(state_file=state_file)
    ordered = replace(ordered, config=ordered.config.model_copy(update={"compressor": compressor}))
    await asyncio.to_thread(simulator, ordered.config, True)
    for unit, function, address, value in [
        (1, 6, 0x0000, 0x0001),
        (1, 6, 0x2103, 550),
        (1, 6, 0x0000, 0x0100),
        (2, 5, 0, 0xFF00),
        (2, 5, 1, 0xFF00),
    ]:
        await asyncio.to_thread(write_by_another_master, ordered, unit, function, address, value)
    async with bench_from(ordered, start_ns) as bench:
        assert (await bench.plant("heater_enabled"), await bench.plant("compressor_on")) == (1, 1)
        await bench.assembly.stand.chamber.permits.switch_off_left_on()
        assert (await bench.plant("heater_enabled"), await bench.plant("compressor_on")) == (0, 0)
        left = [event.text for event in bench.events if event.kind == "left_on"]
        assert left == [f"relays.{name} was on; switched off" for name in ("compressor", "heater_enable")]
        await bench.start(10, 290)
        assert await bench.plant("compressor_on") == 0
        assert await bench.plant("air_degC") < 25  # and not on its way to 55
        await bench.wait(20)
        assert await bench.plant("compressor_on") == 1


def first_seen_off_s(address: str, clock: Clock, limit_s: float) -> float:
    """s until the plant's heater is not enabled any more, asked over a connection of its own."""
    _, host, port = address.split(":")
    begin_ns = clock.now_ns()
    with socket.create_connection((host, int(port)), 5.0) as line, line.makefile("rwb") as lines:
        while (past_s := (clock.now_ns() - begin_ns) / NS_PER_S) < limit_s:
            lines.write(b'{"do": "state"}\n')
            lines.flush()
            if json.loads(lines.readline())["heater_enabled"] == 0:
                return past_s
            block_until(clock, clock.now_ns() + NS_PER_S // 50)
    return limit_s


async def test_a_daemon_whose_event_loop_is_held_up_does_not_heat(order: Callable[..., Order], simulator: Start):
    """In real time, with the shortest permit there is: 2 s."""
    ordered = order(guard={"heater_hold_s": 2.0, "heater_renew_s": 0.5, "period_s": 0.2})
    simulation = ordered.config.simulation
    assert simulation is not None
    await asyncio.to_thread(simulator, ordered.config, False)
    async with bench_from(ordered, None) as bench:
        await bench.start(26, 0.5)
        asking = asyncio.ensure_future(asyncio.to_thread(first_seen_off_s, simulation.control, bench.clock, 4.0))
        await asyncio.sleep(0)
        block_until(bench.clock, bench.clock.now_ns() + to_ns(3.0))
        assert await asking < 3.0
        await bench.wait(0.5)
        assert "guard_late" in {event.kind for event in bench.events}
        assert bench.trips == []
        await bench.end()
        await bench.make_safe()


SESSIONS = [
    pytest.param(SHORT_RECIPE.replace("600", "300"), id="short"),
    pytest.param(find_packaged("recipes", "demo").read_text(), id="demo", marks=pytest.mark.nightly),
]


@pytest.mark.parametrize("recipe", SESSIONS)
async def test_a_good_session_trips_nothing_and_warns_of_nothing(
    tmp_path: Path, order: Callable[..., Order], recipe: str
):
    """As the guard of the run saw it, and the recording of it once more, asked every 5 s."""
    ordered = order(recipe, camera=CORNER)
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, lambda hub: None))
    assert [event.text for event in session.events() if event.kind.startswith("guard.")] == []
    hub, announced = Hub(), Announcements()
    hub.subscribe(announced.receive)
    rules = make_watches(ordered.config, announced)
    items = session.items()
    looked_ns = next(items).time_ns + to_ns(10)  # by then every device has been read
    for item in items:
        while looked_ns < item.time_ns:
            assert [fault for watch in rules if (fault := watch.check(hub, looked_ns)) is not None] == []
            looked_ns += 5 * NS_PER_S
        hub.publish(item)
