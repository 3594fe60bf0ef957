"""The stage driver on its way to safety, whatever is under way on its wire."""

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.devices.motion.flap import Flap
from thermostand.drivers.devices.motion.stage import Axis, AxisSettings
from thermostand.drivers.devices.regulators.regulator import Regulator
from thermostand.drivers.devices.relays import Relays
from thermostand.drivers.devices.thermometers import Thermometers
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import Clock, WallClock, to_ns
from thermostand.foundation.errors import DeviceFault, Refused, Superseded
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.stand import Devices, Stand
from thermostand.stand.chamber.chamber import ChamberLimits
from thermostand.stand.chamber.permits import PermitLimits
from thermostand.stand.config.stand_config import CompressorConfig, find_packaged
from thermostand.stand.imaging.camera_supply import SupplyLimits
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.interlock import Interlocked

from .flap_bench import SETTINGS as FLAP
from .stage_bench import SERIAL_NUMBER, Bench, running_bench


@pytest.fixture
async def bench(tmp_path: Path) -> AsyncIterator[Bench]:
    async with running_bench("linear", "serial", tmp_path) as bench:
        yield bench


async def test_make_safe_stops_a_running_move_and_the_move_says_so(bench: Bench) -> None:
    axis = await bench.ready()
    move = asyncio.create_task(axis.move_to(100.0))
    await bench.after(5.0, axis.make_safe)
    stopped = bench.mechanical
    assert 10 < stopped < 13.5
    assert (await axis.read())[1].value == 0
    with pytest.raises(Superseded, match=r"^linear: superseded"):
        await move
    await bench.clock.sleep_until(bench.clock.now_ns() + to_ns(10.0))
    assert bench.mechanical == stopped
    assert await axis.homed()
    assert bench.tap.count("stop") == 0


async def test_make_safe_between_the_two_parts_of_a_move_cancels_the_second(bench: Bench) -> None:
    """Down from 10 to 4.5 mm takes 2.575 s; the driver looks at 2.6 s."""
    axis = await bench.ready()
    await axis.move_to(10.0)
    moves = bench.tap.count("move")
    move = asyncio.create_task(axis.move_to(5.0))
    await bench.after(2.59, axis.make_safe)
    with pytest.raises(Superseded):
        await move
    assert bench.tap.count("move") == moves + 1
    assert bench.mechanical == pytest.approx(4.5, abs=1e-6)


async def test_make_safe_during_homing_does_not_make_zero_of_where_it_stopped(bench: Bench) -> None:
    await bench.axis.open()
    home = asyncio.create_task(bench.axis.home())
    await bench.after(1.0, bench.axis.make_safe)
    with pytest.raises(Superseded):
        await home
    assert bench.tap.count("zero") == 0
    assert not await bench.axis.homed()


async def test_a_homing_that_ends_while_it_is_made_safe_is_no_scale_without_its_zero(bench: Bench) -> None:
    """The controller calls itself homed, but its counter was not set to zero."""
    await bench.axis.open()
    bench.tap.ignored = {"sstp"}  # it ends by itself before the hard stop
    home = asyncio.create_task(bench.axis.home())
    await bench.after(0.1, bench.axis.make_safe)
    with pytest.raises(Superseded):
        await home
    bench.tap.ignored = set()
    assert bench.fake.engine().feed(b"gets")[:4] == b"gets"
    assert not await bench.axis.homed()
    assert (await bench.position()).reason == "not homed"
    bench.axis.allow()
    with pytest.raises(Refused, match="not homed"):
        await bench.axis.move_to(1.0)
    await bench.axis.home()
    await bench.axis.move_to(1.0)
    assert bench.mechanical == pytest.approx(1.0, abs=1e-9)


async def test_once_made_safe_nothing_is_sent_until_it_is_allowed_again(bench: Bench) -> None:
    axis = await bench.ready()
    await axis.make_safe()
    before = bench.tap.count("move"), bench.tap.count("home")
    for verb in (lambda: axis.move_to(5.0), axis.home):
        with pytest.raises(Superseded, match="nothing was sent"):
            await verb()
    assert (bench.tap.count("move"), bench.tap.count("home")) == before
    axis.allow()
    await axis.move_to(5.0)
    assert bench.mechanical == pytest.approx(5.0, abs=1e-9)


class Trip:
    """Makes the axis safe while the wire's thread holds back the answer to the `number`th request of these letters, and
    before that calls `hold`."""

    def __init__(
        self,
        bench: Bench,
        axis: Axis,
        letters: bytes,
        number: int = 1,
        after_s: float = 0.0,
        hold: Callable[[], None] = lambda: None,
    ) -> None:
        self.made_safe: list[asyncio.Task[None]] = []
        self._hold = hold
        self._left = number
        self._loop = asyncio.get_running_loop()
        feed = bench.tap.feed

        def hold_back(data: bytes) -> bytes:
            if data.lstrip(b"\0").startswith(letters):
                self._left -= 1
                if self._left == 0:
                    time.sleep(after_s)  # noqa: TID251 - a slow wire is slow in real seconds
                    begun = threading.Event()
                    self._loop.call_soon_threadsafe(self._begin, axis, begun)
                    begun.wait(10)
            return feed(data)

        bench.tap.feed = hold_back

    def _begin(self, axis: Axis, begun: threading.Event) -> None:
        self._hold()
        self.made_safe.append(asyncio.ensure_future(axis.make_safe()))
        self._loop.call_soon(begun.set)  # when that task has begun


async def in_real_time(bench: Bench) -> Axis:
    """The same stage, homed and at 20 mm, with a driver whose calls wait for each other in their lane's thread."""
    axis = await bench.ready()
    await axis.move_to(20.0)
    await axis.close()
    settings = AxisSettings(
        address=bench.address, serial_number=SERIAL_NUMBER, profile="8MT160-300", limits=(0.0, 299.95)
    )
    real = Axis("linear", settings, WallClock())
    await real.open()
    return real


@pytest.mark.parametrize(("verb", "letters"), [("move_to", b"gets"), ("home", b"gser"), ("home", b"gets")])
async def test_made_safe_while_what_comes_before_a_motion_is_answered_the_motion_does_not_begin(
    bench: Bench, verb: str, letters: bytes
) -> None:
    axis = await in_real_time(bench)
    before = bench.tap.count("move"), bench.tap.count("home")
    trip = Trip(bench, axis, letters)
    with pytest.raises(Superseded):
        await (axis.move_to(5.0) if verb == "move_to" else axis.home())
    await trip.made_safe[0]
    assert (bench.tap.count("move"), bench.tap.count("home")) == before
    await axis.close()


def stand_with(axis: Axis, clock: Clock) -> Stand:
    """A stand of which only this axis answers."""
    bus = Bus("bus", BusSettings(address="tcp:127.0.0.1:9"), clock)
    maps = [load_register_map(find_packaged("registers", name)) for name in ("omron-e5cc", "waveshare-relay")]
    relays = Relays("relays", bus, maps[1], {"heater_enable": 0, "compressor": 1, "camera_power": 2})
    regulator, flap = Regulator("regulator", bus, maps[0], clock), Flap("flap", FLAP, clock, None)
    camera = AravisCamera("camera", GigeCameraSettings(address="127.0.0.1"), clock)
    thermometers = Thermometers("thermometers", bus, maps[0], {}, clock)
    chamber = ChamberLimits((-10.0, 60.0), PermitLimits(15.0, 3.0, CompressorConfig()), 5.0)
    every = {each.name: each for each in (regulator, relays, thermometers, flap, axis, camera)}
    devices = Devices(every, {"linear": axis}, {"camera": camera})
    return Stand(devices, chamber, SupplyLimits(1.0, 15.0), Hub(), clock)


async def test_a_trip_while_homed_is_answered_lets_no_move_of_the_plan_begin(bench: Bench) -> None:
    """The stand asks whether the axis has its scale, and the guard holds it before the answer is there."""
    axis = await in_real_time(bench)
    stand, before = stand_with(axis, WallClock()), bench.tap.count("move")
    fault = Fault("stage_alarm", "linear has an alarm", "hold")
    trip = Trip(bench, axis, b"gets", hold=lambda: stand.latch.trip(fault))
    with pytest.raises(Interlocked):
        await stand.table.move_to("linear", 5.0)
    await trip.made_safe[0]
    assert bench.tap.count("move") == before
    with pytest.raises(Superseded):  # a program that does not ask the stand
        await axis.move_to(5.0)
    stand.latch.reset()
    move = asyncio.create_task(stand.table.move_to("linear", 25.0))
    while bench.tap.count("move") == before:
        await asyncio.sleep(0.01)
    move.cancel()
    await asyncio.wait([move])
    await axis.close()


async def test_made_safe_while_a_move_waits_for_the_wire_it_is_not_sent(bench: Bench) -> None:
    """A reading holds the wire when the move, all checks behind it, is next."""
    axis = await in_real_time(bench)
    before = bench.tap.count("move")
    trip = Trip(bench, axis, b"gets", number=2, after_s=0.1)
    move, read = asyncio.create_task(axis.move_to(5.0)), asyncio.create_task(axis.read())
    with pytest.raises(Superseded):
        await move
    await asyncio.gather(read, trip.made_safe[0])
    assert bench.tap.count("move") == before
    assert bench.tap.count("sstp") == 1
    await axis.close()


async def test_make_safe_stops_hard_when_softly_does_not_help(bench: Bench) -> None:
    axis = await bench.ready()
    bench.tap.ignored = {"sstp"}
    move = asyncio.create_task(axis.move_to(100.0))
    begun_s = bench.now_s
    await bench.after(5.0, axis.make_safe)
    assert bench.now_s - begun_s == pytest.approx(7.0, abs=0.2)
    assert (await axis.read())[1].value == 0
    with pytest.raises(Superseded):
        await move


async def test_make_safe_that_cannot_be_confirmed_is_a_fault(bench: Bench) -> None:
    axis = await bench.ready()
    bench.tap.ignored = {"sstp", "stop"}
    move = asyncio.create_task(axis.move_to(100.0))
    with pytest.raises(DeviceFault, match="still moving"):
        await bench.after(5.0, axis.make_safe)
    with pytest.raises(Superseded):
        await move


@pytest.mark.parametrize("lost", ["lost_requests", "lost_replies"])
async def test_make_safe_gets_through_a_lossy_line(bench: Bench, lost: str) -> None:
    axis = await bench.ready()
    move = asyncio.create_task(axis.move_to(100.0))
    getattr(bench.tap, lost)["sstp"] = 1
    await bench.after(5.0, axis.make_safe)
    assert (await axis.read())[1].value == 0
    assert bench.tap.count("stop") == 0
    with pytest.raises(Superseded):
        await move


async def test_a_stage_at_rest_is_made_safe_without_moving(bench: Bench) -> None:
    axis = await bench.ready()
    await axis.move_to(7.0)
    await axis.make_safe()
    assert bench.mechanical == pytest.approx(7.0, abs=1e-9)
    assert await axis.homed()
