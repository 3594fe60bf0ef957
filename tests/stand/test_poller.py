"""A poller says when its device is too slow for the period, and when it no longer is."""

from typing import cast

import pytest

from thermostand.drivers.devices.protocols import Sensor
from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.errors import DeviceError, GarbledReply, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Reading
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.stand.assembly.poller import Poller


class Slow:
    """A device whose reads take `takes_s`, or fail."""

    name = "thermometers"

    def __init__(self, clock: "Hands") -> None:
        self.clock, self.takes_s, self.failures = clock, 0.0, list[DeviceError]()

    async def read(self) -> tuple[Reading, ...]:
        self.clock.advance_ns(to_ns(self.takes_s))
        if self.failures:
            raise self.failures.pop()
        return (Reading("thermometers.air", 20.0, "degC", self.clock.now_ns()),)


class Hands(VirtualClock):
    """A clock moved by hand."""

    def __init__(self) -> None:
        super().__init__(0)
        self.ns = 0

    def now_ns(self) -> int:
        return self.ns

    def advance_ns(self, ns: int) -> None:
        self.ns += ns


async def test_a_device_that_is_slower_than_its_period_is_an_event_once_and_when_it_is_fast_again_too():
    clock, hub, events = Hands(), Hub(), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    device = Slow(clock)
    poller = Poller(cast(Sensor, device), 1.0, hub, clock)
    await poller.first()
    for device.takes_s in (0.9, 1.2, 1.5, 0.8, 0.4, 0.9):
        await poller.poll()
    assert [(event.kind, event.data["took_s"]) for event in events] == [("device_slow", 1.2), ("device_fast", 0.4)]
    assert events[0].text.startswith("thermometers took 1.2 s")


@pytest.mark.parametrize(("kind", "over"), [("device_slow", "device_fast"), ("device_lost", "device_back")])
async def test_a_device_that_comes_and_goes_is_reported_three_times_and_its_end_once_that_lasts(kind: str, over: str):
    clock, hub, events = Hands(), Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    device = Slow(clock)
    poller = Poller(cast(Sensor, device), 1.0, hub, clock)
    await poller.first()
    for number in range(2400):
        clock.advance_ns(to_ns(3.0))
        if number < 1000 and number % 4 == 0:
            if kind == "device_slow":
                device.takes_s = 1.5
            else:
                kind_of_error = GarbledReply if number % 8 == 0 else Unreachable
                device.failures.append(kind_of_error("thermometers", f"try {number} is in vain"))
        await poller.poll()
        device.takes_s = 0.0
    assert [event.kind for event in events] == 3 * [kind, over]
    assert events[-1].data["repeated"] == 247
    last_ns = 996 * to_ns(3.0)
    assert to_ns(1190) < events[-1].time_ns - last_ns < to_ns(1600)
