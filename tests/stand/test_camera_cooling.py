"""When a camera without power is reported to be cold, every part of the simulated one is; time is virtual."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress

import pytest

from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.experiments.steps import CoolDown
from thermostand.experiments.warm_up import WarmUp
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Quality, Reading, bad_reading
from thermostand.stand.imaging.camera_cooling import CameraTemperature, cool_down, get_last_temperature

BAND_K, TIME_CONSTANT_S = WarmUp().band_K, WarmUp().time_constant_s


class Cooling:
    """A simulated camera that has been on for 90 min, the air around it on the hub, and the clock of both."""

    def __init__(self) -> None:
        self.plant = Plant(PlantSpec(), 0)
        self.plant.camera_powered = True
        self.plant.advance(to_ns(5400))
        self.clock = VirtualClock(to_ns(5400), self._advance)
        self.hub = Hub()
        self.events: list[Event] = []
        self.hub.subscribe(self._note)
        self._tell_air()

    def _note(self, item: Item) -> None:
        if isinstance(item, Event):
            self.events.append(item)

    async def _advance(self, time_ns: int) -> None:
        self.plant.advance(time_ns)
        self._tell_air()

    def _tell_air(self) -> None:
        air = Reading("thermometers.air", self.plant.air_degC, "degC", self.clock.now_ns())
        self.hub.publish(Batch("thermometers", self.clock.now_ns(), (air,)))

    def switched_off(self) -> CameraTemperature:
        self.plant.camera_powered = False
        return CameraTemperature(self.plant.sensor_degC, self.clock.now_ns())

    @property
    def waited_s(self) -> float:
        return self.clock.now_ns() / 1e9 - 5400

    @property
    def excess_K(self) -> float:
        """Of the warmest part over the air."""
        plant = self.plant
        return max(plant.sensor_degC, plant.body_degC, plant.lens_degC) - plant.air_degC


@pytest.fixture
async def bench() -> AsyncIterator[Cooling]:
    bench = Cooling()
    driver = asyncio.create_task(bench.clock.run())
    yield bench
    driver.cancel()
    with suppress(asyncio.CancelledError):
        await driver


async def test_when_the_wait_is_over_every_part_of_the_camera_is_within_the_band(bench: Cooling) -> None:
    cooling = bench.switched_off()
    assert bench.excess_K > 15.0
    await cool_down(cooling, BAND_K, TIME_CONSTANT_S, 7200.0, bench.hub, bench.clock)
    assert 0.0 <= bench.excess_K < BAND_K
    assert bench.waited_s == pytest.approx(CoolDown(BAND_K, TIME_CONSTANT_S, 7200.0).needed_s, rel=0.05)
    assert [event.kind for event in bench.events] == ["cooled_down"]


async def test_a_cold_camera_is_not_waited_for(bench: Cooling) -> None:
    cooling = CameraTemperature(bench.plant.air_degC + 0.4, bench.clock.now_ns())
    await cool_down(cooling, BAND_K, TIME_CONSTANT_S, 7200.0, bench.hub, bench.clock)
    assert bench.waited_s == 0.0


async def test_the_wait_ends_at_its_limit_and_says_that_the_camera_is_still_warm(bench: Cooling) -> None:
    await cool_down(bench.switched_off(), BAND_K, TIME_CONSTANT_S, 600.0, bench.hub, bench.clock)
    assert bench.waited_s == pytest.approx(600.0)
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "cool_down_unsure")]
    assert "continuing outside 0.5 K" in bench.events[0].text


async def test_a_camera_that_showed_no_temperature_is_given_all_the_time(bench: Cooling) -> None:
    await cool_down(None, BAND_K, TIME_CONSTANT_S, 7200.0, bench.hub, bench.clock)
    assert bench.waited_s == pytest.approx(7200.0)
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "cool_down_unsure")]


async def test_air_that_nobody_measures_does_not_make_a_camera_cold(bench: Cooling) -> None:
    hub = Hub()
    hub.publish(Batch("thermometers", 0, (bad_reading("thermometers.air", "degC", 0, "open"),)))
    events: list[Item] = []
    hub.subscribe(events.append)
    await cool_down(bench.switched_off(), BAND_K, TIME_CONSTANT_S, 900.0, hub, bench.clock)
    assert bench.waited_s == pytest.approx(900.0)
    assert "is not measured" in events[0].text


def test_only_a_good_temperature_is_a_cameras_last_one() -> None:
    good = Reading("camera.temperature", 44.0, "degC", 7)
    assert get_last_temperature(good) == CameraTemperature(44.0, 7)
    assert get_last_temperature(Reading("camera.temperature", 44.0, "degC", 7, Quality.STALE, "old")) is None
    assert get_last_temperature(bad_reading("camera.temperature", "degC", 7, "lost")) is None
    assert get_last_temperature(None) is None


def test_the_excess_decays_towards_the_air_by_its_time_constant() -> None:
    cooled = CameraTemperature(44.0, 0).after(to_ns(1200), 24.0, 1200.0)
    assert cooled.camera_degC == pytest.approx(24.0 + 20.0 * 0.36788, abs=1e-4)
    assert CameraTemperature(44.0, 0).after(0, 24.0, 1200.0).camera_degC == 44.0
