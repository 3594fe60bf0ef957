"""When a camera that was off counts as soaked again, what is compared after a gap, and when a camera may have been
off."""

import asyncio
import math
import tracemalloc
from typing import Any

import pytest

from thermostand.drivers.settings import EquilibriumSettings
from thermostand.foundation.clock import NS_PER_S, VirtualClock, to_ns
from thermostand.foundation.events import CAMERA_EQUILIBRIUM_LOST
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.imaging.camera_cooling import CameraTemperature
from thermostand.stand.imaging.equilibrium import CameraEquilibrium
from thermostand.stand.running.executing.camera_gap import (
    CameraHistory,
    OffsetGap,
    OffsetWatch,
    explain_possible_power_loss,
)
from thermostand.stand.running.executing.settling_watch import SettlingWatch

TIME_CONSTANT_S, RISE_K = 900.0, 20.0


def publish(hub, channel, time_ns, value):
    bad = bad_reading(channel, "degC", time_ns, "closed")
    hub.publish(Batch("device", time_ns, (bad if math.isnan(value) else Reading(channel, value, "degC", time_ns),)))


async def soaked(camera_degC, limits, limit_s=20_000.0):
    """The events of a camera that loses its equilibrium at 0 s and has `camera_degC(s)` from then on."""
    hub, clock, events = Hub(), VirtualClock(0), []
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    equilibrium = CameraEquilibrium(limits, hub, clock)
    time = asyncio.create_task(clock.run())

    async def poll():
        while True:
            await clock.sleep_until(clock.now_ns() + 5 * NS_PER_S)
            publish(hub, "camera.temperature", clock.now_ns(), camera_degC(clock.now_ns() / NS_PER_S))

    polling = asyncio.create_task(poll())
    equilibrium.lose("it was off")
    await equilibrium.wait_until_regained(lambda: clock.now_ns() > to_ns(limit_s))
    polling.cancel()
    time.cancel()
    await asyncio.gather(time, polling, return_exceptions=True)
    return events


def warming(time_s):
    return 24.0 + RISE_K * (1.0 - math.exp(-time_s / TIME_CONSTANT_S))


def rate_K_per_min(time_s):
    return 60.0 * RISE_K / TIME_CONSTANT_S * math.exp(-time_s / TIME_CONSTANT_S)


@pytest.mark.parametrize("digit_K", [0.0, 0.1, 0.5])
async def test_a_camera_is_soaked_until_it_has_moved_slowly_for_ten_minutes(digit_K):
    def shown(time_s):
        return round(warming(time_s) / digit_K) * digit_K if digit_K else warming(time_s)

    lost, reached = await soaked(shown, EquilibriumSettings(time_constant_s=5000.0))
    assert (lost.kind, lost.data) == ("camera_equilibrium_lost", {"reason": "it was off"})
    assert reached.kind == "camera_equilibrium"
    at_s = reached.time_ns / NS_PER_S
    assert reached.data["soaked_s"] == at_s
    assert rate_K_per_min(at_s) < rate_K_per_min(at_s - 300.0) < 0.2
    assert rate_K_per_min(at_s - 600.0) < 0.25  # rounding is allowed for, the curve within the window nearly
    assert at_s < TIME_CONSTANT_S * math.log(60.0 * RISE_K / TIME_CONSTANT_S / 0.2) + 1500.0


async def test_a_camera_that_tells_no_temperature_is_soaked_for_five_time_constants():
    _, reached = await soaked(lambda _: math.nan, EquilibriumSettings(time_constant_s=600.0))
    assert reached.kind == "camera_equilibrium"
    assert reached.data == {"soaked_s": 3000.0, "rate_K_per_min": None}


async def test_a_camera_that_goes_on_moving_is_reported_and_waited_for():
    events = await soaked(lambda time_s: 24.0 + time_s / 120.0, EquilibriumSettings(time_constant_s=600.0), 7000.0)
    assert [event.kind for event in events] == ["camera_equilibrium_lost"] + 2 * ["camera_equilibrium_late"]


@pytest.mark.parametrize(
    ("was_supplied", "boot_id", "camera_degC", "lost", "text"),
    [
        (True, "a", 40.3, "", ""),
        (True, None, 40.3, "", ""),  # virtual time has no host that is started
        (False, "a", 40.0, "", "its supply was found off"),
        (None, "a", 40.0, "", "its supply was found off"),
        (True, "b", 40.0, "", "the host has restarted"),
        (True, "", 40.0, "", "the host has restarted"),
        (True, "a", 38.5, "", "it is -1.5 K from its last temperature"),
        (True, "a", 40.0, "its equilibrium had been lost before", "its equilibrium had been lost before"),
    ],
)
def test_a_camera_of_unknown_supply_was_off(was_supplied, boot_id, camera_degC, lost, text):
    before = CameraHistory(CameraTemperature(40.0, 0), "a", lost)
    reading = Reading("camera.temperature", camera_degC, "degC", NS_PER_S)
    found = explain_possible_power_loss(before, boot_id, was_supplied, reading)
    assert found.startswith(text)
    assert bool(found) == bool(text)


@pytest.mark.parametrize(("after_K", "kind"), [(14.3, "camera_offset_same"), (12.9, "camera_offset_changed")])
def test_camera_minus_air_is_compared_once_at_the_nearest_set_point(after_K, kind):
    hub, clock, events = Hub(), VirtualClock(1000 * NS_PER_S), []
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    watch = OffsetWatch(hub, clock, OffsetGap({24.0: 15.0, 45.0: 14.0}, 7, 9))
    watch.note_settled(38.0)  # nothing is known of camera and air yet
    for time_s in range(900, 1001, 5):
        publish(hub, "camera.temperature", time_s * NS_PER_S, 38.0 + after_K)
        publish(hub, "thermometers.air", time_s * NS_PER_S, 38.0)
    watch.note_settled(38.0)
    watch.note_settled(38.0)
    (event,) = events
    assert event.kind == kind
    assert event.data == {
        "before_K": 14.0,
        "after_K": pytest.approx(after_K),
        "before_degC": 45.0,
        "after_degC": 38.0,
        "gap_ns": 7,
        "gap_end_ns": 9,
    }


def test_a_camera_that_still_warms_up_is_no_offset_to_compare_with():
    hub, clock, events = Hub(), VirtualClock(1000 * NS_PER_S), []
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    watch = OffsetWatch(hub, clock)
    for time_s in range(900, 1001, 5):
        publish(hub, "camera.temperature", time_s * NS_PER_S, 41.0 + 0.02 * (time_s - 900))
        publish(hub, "thermometers.air", time_s * NS_PER_S, 38.0)
    watch.note_settled(38.0)
    hub.publish(Event(clock.now_ns(), "warning", CAMERA_EQUILIBRIUM_LOST, "its supply was off", {}))
    for time_s in range(1001, 1200, 5):
        publish(hub, "camera.temperature", time_s * NS_PER_S, 55.0)
        publish(hub, "thermometers.air", time_s * NS_PER_S, 38.0)
    watch.note_settled(38.0)
    assert [event.kind for event in events] == [CAMERA_EQUILIBRIUM_LOST]


def test_what_is_kept_of_a_camera_does_not_grow_with_the_hours():
    hub = Hub()
    equilibrium = CameraEquilibrium(EquilibriumSettings(), hub, VirtualClock(0))
    nobody: Any = None  # neither the stand nor its target is asked
    settling = SettlingWatch(nobody, hub, VirtualClock(0), nobody)
    sizes: list[int] = []
    tracemalloc.start(1)
    for second in range(12_000):
        publish(hub, "camera.temperature", second * NS_PER_S, 24.0 + second / 1000)
        if second in (2_000, 11_999):
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    settling.close()
    equilibrium.forget()
    assert sizes[1] - sizes[0] < 400_000  # bytes: two numbers a second, and not two objects
