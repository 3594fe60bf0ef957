"""Replies that are garbled or late, and devices that say that they measure nothing, in whole runs over the bus."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.conftest import AS_INSTALLED
from tests.system.test_run import at_step
from tests.system.test_run_ends import SHORTER, break_now
from thermostand.foundation.errors import StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Quality
from thermostand.recording.reading.session import Session
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

POLLED = AS_INSTALLED

QUICK = {"timeout_s": 0.05}


def bad_polls_ns(session: Session, channel: str, cause: str) -> list[int]:
    batches = [item for item in session.items() if isinstance(item, Batch)]
    readings = [reading for batch in batches for reading in batch.readings if reading.channel == channel]
    return [reading.time_ns for reading in readings if reading.quality is Quality.BAD and reading.cause == cause]


@pytest.mark.parametrize(("name", "value", "wire"), [("bus.garbled", 3, "tcp"), ("bus.late_s", 1.0, "serial")])
async def test_a_poll_that_fails_on_the_wire_is_asked_again_and_ends_no_session(
    tmp_path: Path, order: Callable[..., Order], name: str, value: object, wire: str
):
    """Three garbled replies are one poll with all its repeats; a reply 20 time-outs late spoils the repeats as well."""
    ordered = order(SHORTER, wire=wire, bus=QUICK)
    watch = at_step("soak", lambda: break_now(ordered, name, value))
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, watch))
    lost = [event for event in session.events() if event.kind == "device_lost"]
    assert len(lost) >= 1
    assert not [event for event in session.events() if event.kind.startswith("guard.")]
    (name, *_) = lost[0].text.split(":")
    channel = {"regulator": "regulator.pv", "thermometers": "thermometers.air", "relays": "relays.heater_enable"}[name]
    bad_ns = bad_polls_ns(session, channel, "wire")
    assert bad_ns
    assert bad_polls_ns(session, channel, "device") == []
    times_ns, values = session.readings(channel)
    again_ns = min(
        time_ns for time_ns, found in zip(times_ns, values, strict=True) if found == found and time_ns > bad_ns[0]
    )
    assert again_ns - bad_ns[0] <= 2e9  # asked again after a second, not after its period of 5 s


async def test_a_line_that_stays_garbled_trips_when_no_good_reading_is_young_enough(
    tmp_path: Path, order: Callable[..., Order]
):
    ordered = order(SHORTER, bus=QUICK)
    garble = at_step("soak", lambda: break_now(ordered, "bus.garbled", 1_000_000))

    def mend(item: Item) -> None:
        if isinstance(item, Event) and item.kind.startswith("guard."):
            break_now(ordered, "bus.garbled", 0)

    def watch(hub: Hub) -> None:
        garble(hub)
        hub.subscribe(mend)

    with pytest.raises(StandTripped, match=r"is BAD: .* was last good 2?\d\.\d s ago, limit 15\.0 s"):
        await run_virtual(ordered, tmp_path / "out", None, watch)


@pytest.mark.parametrize(
    ("name", "value", "channel"),
    [
        ("regulator.sensor_break", True, "regulator.pv"),
        ("thermometer.open", "air", "thermometers.air"),
        ("thermometer.offset_K", {"air": 90.0}, "thermometers.air"),
    ],
)
async def test_a_device_that_says_itself_that_it_measures_nothing_trips_at_the_second_poll(
    tmp_path: Path, order: Callable[..., Order], name: str, value: object, channel: str
):
    ordered = order(SHORTER)
    watch = at_step("soak", lambda: break_now(ordered, name, value))
    with pytest.raises(StandTripped, match=f"{channel} is BAD"):
        await run_virtual(ordered, tmp_path / "out", None, watch)
    (directory,) = (tmp_path / "out").iterdir()
    session = Session.open(directory)
    (trip,) = [event for event in session.events() if event.kind == "guard.sensor_bad"]
    bad_ns = bad_polls_ns(session, channel, "device")
    guard_ns = int(ordered.config.guard.period_s * 1e9)
    assert bad_ns[1] <= trip.time_ns <= bad_ns[1] + guard_ns
