"""The failure table, row by row: a device of the stand, a fault of it or its wire, what must be seen, and the return.

One simulated laboratory serves every row, over its real wires and in virtual time; each row opens a stand of its own,
breaks one thing, waits for what must be seen, mends it, and waits until the device is as before.
"""

import asyncio
import json
import socket
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from tests.nightly import mark_nightly
from tests.system.conftest import SHORT_RECIPE
from tests.system.simulated_orders import simulated_order
from thermostand.drivers.wires import camera_connection
from thermostand.foundation.clock import NS_PER_S, VirtualClock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceError, DeviceFault, GarbledReply, Refused, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Quality, Reading
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory
from thermostand.stand.running.order import Order
from thermostand.stand.running.simulated_faults import break_or_mend, list_simulated_faults
from thermostand.stand.serving.api_models import FaultRequest, Missing

PERIOD_S = 1.0
OTHERS = ("regulator.pv", "thermometers.air", "relays.heater_enable", "linear.position", "flap.position")


@dataclass(frozen=True, slots=True)
class Row:
    """`fault` = `value` makes `channel` BAD for a failed read of this kind (`error`), or just of this `quality` with a
    reason that `says` so; `back_s` after it is mended with `mended` it is GOOD, None: it needs a person."""

    fault: str
    value: object
    mended: object
    channel: str
    quality: Quality = Quality.BAD
    error: type[DeviceError] | None = None
    says: str = ""
    back_s: float | None = 2.0


BAD, STALE, GOOD = Quality.BAD, Quality.STALE, Quality.GOOD
PROBED_S = 11.0  # a unit that was dead is asked every 10 s
ROWS = (
    # Serial line and bus.
    Row("bus.silent", True, False, "regulator.pv", BAD, Unreachable, "no reply", PROBED_S),
    Row("bus.unplugged", True, False, "regulator.pv", BAD, Unreachable, "", 2.0),
    Row("bus.garbled", 10**6, 0, "regulator.pv", BAD, GarbledReply, "no valid reply", PROBED_S),
    Row("bus.delay_s", 0.02, 0, "regulator.pv", GOOD),
    Row("bus.byte_by_byte", True, False, "regulator.pv", GOOD),
    Row("linear.silent", True, False, "linear.position", BAD, Unreachable, "does not answer"),
    Row("linear.unplugged", True, False, "linear.position", BAD, Unreachable, "gone|cannot open", 2.0),
    Row("linear.garbled", 10**6, 0, "linear.position", BAD, Unreachable),
    Row("linear.delay_s", 0.02, 0, "linear.homed", GOOD),
    Row("linear.byte_by_byte", True, False, "linear.homed", GOOD),
    # Regulator.
    Row("regulator.silent", True, False, "regulator.pv", BAD, Unreachable, "Modbus still", PROBED_S),
    Row("regulator.compoway", True, False, "regulator.pv", BAD, Unreachable, "CompoWay/F", PROBED_S),
    Row("regulator.sensor_break", True, False, "regulator.pv", BAD, None, "sensor_break"),
    Row("regulator.ad_error", True, False, "regulator.pv", BAD, None, "ad_error"),
    Row("regulator.decimals", 0, 1, "regulator.pv", BAD, DeviceFault, "decimal_point is 0", 31.0),
    # Contact thermometers.
    Row("thermometers.silent", True, False, "thermometers.air", BAD, Unreachable, "no reply", PROBED_S),
    Row("thermometer.open", "air", None, "thermometers.air", BAD, None, "range|open"),
    Row("thermometer.shorted", "air", None, "thermometers.air", BAD, None, "range|open"),
    Row("thermometer.offset_K", {"air": 90}, None, "thermometers.air", BAD, None, "range"),
    Row("thermometers.no_fault_bits", True, False, "thermometers.air", STALE, None, "fault bits unreadable"),
    # Relays.
    Row("relays.silent", True, False, "relays.heater_enable", BAD, Unreachable, "no reply", PROBED_S),
    # Stages.
    Row("linear.overheated", True, False, "linear.position", STALE, None, "alarm, flags 0x00000100", None),
    Row("linear.winding", True, False, "linear.position", STALE, None, "alarm, flags 0x00100000", None),
    Row("linear.ctp_error", True, False, "linear.position", STALE, None, "alarm, flags 0x00000080", None),
    Row("linear.restart", True, False, "linear.position", STALE, None, "not homed", None),
    # Flap.
    Row("flap.unplugged", True, False, "flap.position", BAD, Unreachable, "", 2.0),
    Row("flap.timeout", True, False, "flap.position", BAD, Unreachable, "", 2.0),
    Row("flap.stall", True, False, "flap.position", BAD, Refused, "", 2.0),
    Row("flap.short_read", True, False, "flap.position", BAD, GarbledReply, "", 2.0),
    Row("flap.error", "feedback", None, "flap.position", BAD, None, "feedback", None),
    # Camera.
    Row("camera.no_temperature", True, False, "camera.temperature", BAD, None, "0"),
    Row("camera.refused_temperature", True, False, "camera.temperature", BAD, None, ""),
)

# What ends a grab, and how: lost until the camera is opened again.
CAMERA_LOST = (
    "camera.silent",
    mark_nightly("camera.deaf"),
    "camera.stalled",
    mark_nightly("camera.restart"),
    "camera.control_lost",
    mark_nightly("camera.power"),
)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Order]:
    order = simulated_order(tmp_path_factory.mktemp("laboratory"), SHORT_RECIPE, poll_s=PERIOD_S)
    bus = order.config.bus.model_copy(update={"timeout_s": 0.1})
    order = _with(order, bus=bus)
    simulator = Simulator(describe_laboratory(order.config, virtual=True, seed=None))
    yield order
    simulator.stop()


def _with(order: Order, **sections: object) -> Order:
    config = order.config.model_copy(update=sections)
    return Order(config, order.recipe, order.config_text, order.recipe_text, order.target_text)


@dataclass
class Watched:
    """A stand that is polled, and all that it has published."""

    assembly: Assembly
    clock: VirtualClock
    control: ControlSocket
    events: list[Event]
    latest: dict[str, Reading]
    counts: dict[str, int]

    async def fault(self, name: str, value: object) -> None:
        with self.clock.hold():
            await self.control.request({"do": "fault", "name": name, "value": value})

    async def until(self, is_so: Callable[[], bool], within_s: float, what: str) -> float:
        """Stand time that it took, s."""
        begin_ns = self.clock.now_ns()
        while not is_so():
            took_s = (self.clock.now_ns() - begin_ns) / NS_PER_S
            assert took_s <= within_s, f"not within {within_s} s: {what}; {self.latest}"
            await self.clock.sleep_until(self.clock.now_ns() + to_ns(0.25))
        return (self.clock.now_ns() - begin_ns) / NS_PER_S


@asynccontextmanager
async def watched(order: Order, devices: tuple[str, ...]) -> AsyncGenerator[Watched]:
    """These devices of the stand, opened and polled; the laboratory goes on from where it is."""
    simulation = order.config.simulation
    assert simulation is not None
    driver, faults = ControlSocket(simulation.control), ControlSocket(simulation.control)
    await driver.open()
    await faults.open()
    start_ns = int(str((await driver.request({"do": "state"}))["now_ns"]))
    clock, hub = VirtualClock(start_ns, driver.advance), Hub()
    assembly = assemble(order.config, hub, clock)
    found = Watched(assembly, clock, faults, [], {}, {})

    def receive(item: Item) -> None:
        if isinstance(item, Event):
            found.events.append(item)
        if isinstance(item, Batch):
            for reading in item.readings:
                found.latest[reading.channel] = reading
                found.counts[reading.channel] = found.counts.get(reading.channel, 0) + 1

    hub.subscribe(receive)
    everything: dict[str, Any] = {
        "regulator": assembly.devices.regulator,
        "relays": assembly.devices.relays,
        "thermometers": assembly.devices.thermometers,
        "flap": assembly.devices.flap,
        **assembly.devices.axes,
        **assembly.devices.cameras,
    }
    opened = [everything[name] for name in devices]
    tasks = [asyncio.create_task(clock.run())]
    try:
        await assembly.bus.open()
        for device in opened:
            if device is assembly.devices.cameras["camera"]:
                await assembly.devices.relays.switch("camera_power", on=True)
                await clock.sleep_until(clock.now_ns() + to_ns(5.0))
            await device.open()
            if device is assembly.devices.axes.get("linear"):
                await device.home()
                await device.move_to(1.0)
        for poller in assembly.make_pollers():
            if poller.sensor in opened:
                await poller.first()
                tasks.append(asyncio.create_task(poller.run()))
        yield found
    finally:
        for task in tasks[1:]:
            task.cancel()
        await asyncio.gather(*tasks[1:], return_exceptions=True)
        for device in opened:
            await device.close()
        await assembly.bus.close()
        tasks[0].cancel()
        await asyncio.gather(tasks[0], return_exceptions=True)
        await driver.close()
        await faults.close()


def devices_of(row: Row) -> tuple[str, ...]:
    """The one that breaks and those that must go on beside it."""
    name = row.channel.partition(".")[0]
    if name == "camera":
        return ("relays", "camera", "thermometers")
    return ("regulator", "thermometers", "relays", "linear", "flap")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.fault}")
async def test_each_fault_is_seen_as_what_it_is_and_its_device_is_back_when_it_is_mended(laboratory: Order, row: Row):
    device = row.channel.partition(".")[0]
    async with watched(laboratory, devices_of(row)) as stand:
        await stand.fault(row.fault, row.value)
        try:
            await seen(stand, row, device)
            await others_keep_their_rate(stand, row, device)
        finally:
            await stand.fault(row.fault, row.mended)
        if row.back_s is not None and row.quality is not GOOD:
            lost = bool(row.error)
            await stand.until(lambda: stand.latest[row.channel].quality is GOOD, row.back_s, f"{row.channel} is GOOD")
            backs = [event.data["device"] for event in stand.events if event.kind == "device_back"]
            assert (device in backs) == lost
        await heal(laboratory, row)


async def seen(stand: Watched, row: Row, device: str) -> None:
    """Quality, reason, and the event that says which device was lost by which kind of error."""
    if row.quality is GOOD:
        counted = stand.counts[row.channel]
        await stand.until(lambda: stand.counts[row.channel] >= counted + 3, 6.0, "three more readings")
        assert stand.latest[row.channel].quality is GOOD
        assert [event for event in stand.events if event.kind == "device_lost"] == []
        return
    limit_s = 31.0 + PERIOD_S  # the regulator's scaling is looked at every 30 s
    await stand.until(lambda: stand.latest[row.channel].quality is row.quality, limit_s, f"{row.channel} {row.quality}")
    assert any(word in stand.latest[row.channel].reason for word in row.says.split("|")), stand.latest[row.channel]
    lost = {str(event.data["device"]): event.data["error"] for event in stand.events if event.kind == "device_lost"}
    if row.error is None:
        assert lost == {}
    else:
        assert lost[device] == row.error.__name__


async def others_keep_their_rate(stand: Watched, row: Row, device: str) -> None:
    """Devices on other wires, and other units of the bus unless it is the bus that is broken, are read each period."""
    is_shared = row.fault.startswith("bus.")
    on_bus = ("regulator", "thermometers", "relays")
    others = [
        channel
        for channel in OTHERS
        if channel in stand.latest
        and channel.partition(".")[0] != device
        and not (is_shared and channel.partition(".")[0] in on_bus)
    ]
    before = dict(stand.counts)
    await stand.clock.sleep_until(stand.clock.now_ns() + to_ns(5 * PERIOD_S + 0.5))
    for channel in others:
        assert stand.counts[channel] - before[channel] >= 5, channel
        assert stand.latest[channel].quality is GOOD, channel


@pytest.mark.parametrize("name", CAMERA_LOST)
async def test_a_camera_that_gives_no_frame_is_lost_and_returns_with_its_settings(
    laboratory: Order, name: str, monkeypatch: pytest.MonkeyPatch
):
    """The thermometers are read each period meanwhile. The exposure is no camera's own at power-on."""
    monkeypatch.setattr(camera_connection, "VIRTUAL_TIMEOUT_S", 4.0)  # what each of three frames is waited for
    async with watched(laboratory, ("relays", "camera", "thermometers")) as stand:
        camera = stand.assembly.devices.cameras["camera"]
        await camera.grab()
        await broken(stand, name, True)
        read = stand.counts["thermometers.air"]
        with pytest.raises(Unreachable):
            await camera.grab()
        await stand.clock.sleep_until(stand.clock.now_ns() + to_ns(3 * PERIOD_S + 0.5))
        assert stand.counts["thermometers.air"] - read >= 3
        assert stand.latest["thermometers.air"].quality is GOOD
        await broken(stand, name, False)
        await stand.clock.sleep_until(stand.clock.now_ns() + to_ns(5.0))  # its boot
        await camera.open()
        frame = await camera.grab()
        assert frame.exposure_s == pytest.approx(camera.settings.exposure_s)
        assert frame.image.shape == (2048, 2448)


async def test_what_an_operator_breaks_on_the_page_is_broken_for_that_long(laboratory: Order):
    async with watched(laboratory, ("thermometers",)) as stand:
        text = await break_or_mend(stand.assembly, FaultRequest(name="thermometer.open", value="air", for_s=5.0))
        assert text == "thermometer.open is broken for 5 s"
        known = await list_simulated_faults(stand.assembly)
        assert {fault.name for fault in known.faults} > {"thermometer.open", "bus.drop", "camera.restart"}
        assert known.standing == {"thermometer.open": "air"}
        await stand.until(lambda: stand.latest["thermometers.air"].quality is BAD, 2.0, "it is open")
        await stand.until(lambda: stand.latest["thermometers.air"].quality is GOOD, 5.0, "its time is over")
        assert (await list_simulated_faults(stand.assembly)).standing == {}
        await break_or_mend(stand.assembly, FaultRequest(name="thermometers.no_fault_bits", for_s=2.0))
        await break_or_mend(stand.assembly, FaultRequest(name="thermometers.no_fault_bits", mend=True))
        await break_or_mend(stand.assembly, FaultRequest(name="thermometers.no_fault_bits"))
        await stand.clock.sleep_until(stand.clock.now_ns() + to_ns(3.0))  # the first one's end is no end of this
        assert (await list_simulated_faults(stand.assembly)).standing == {"thermometers.no_fault_bits": True}
        await break_or_mend(stand.assembly, FaultRequest(name="thermometers.no_fault_bits", mend=True))
        await break_or_mend(stand.assembly, FaultRequest(name="relays.brown_out"))  # which just happens
        assert (await list_simulated_faults(stand.assembly)).standing == {}
        for name, value, error in (("bus.dorp", 1.0, Missing), ("thermometer.open", "cellar", ConfigError)):
            with pytest.raises(error, match=name):
                await break_or_mend(stand.assembly, FaultRequest(name=name, value=value))


async def broken(stand: Watched, name: str, is_broken: bool) -> None:
    if name == "camera.power":
        await stand.assembly.devices.relays.switch("camera_power", on=not is_broken)
    else:
        await stand.fault(name, is_broken)


async def heal(laboratory: Order, row: Row) -> None:
    """What a fault leaves behind for the next row."""
    device = row.fault.partition(".")[0]
    if device in ("linear", "flap") and row.back_s is None:
        assert laboratory.config.simulation is not None
        host, port = laboratory.config.simulation.control.removeprefix("tcp:").rsplit(":", 1)
        with socket.create_connection((host, int(port))) as control, control.makefile("rwb") as lines:
            lines.write(json.dumps({"do": "fault", "name": f"{device}.restart", "value": True}).encode() + b"\n")
            lines.flush()
            assert b"error" not in lines.readline()
