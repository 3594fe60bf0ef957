"""A poller says when its device is too slow for the period, and when it no longer is."""

from typing import cast

from thermostand.drivers.devices.protocols import Sensor
from thermostand.foundation.clock import VirtualClock, seconds_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Reading
from thermostand.stand.poller import Poller


class Slow:
    """A device whose reads take `takes_s`."""

    name = "thermometers"

    def __init__(self, clock: "Hands") -> None:
        self.clock, self.takes_s = clock, 0.0

    async def read(self) -> tuple[Reading, ...]:
        self.clock.advance_ns(seconds_ns(self.takes_s))
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
    for takes_s, rests_s in (
        (0.9, 0),
        (1.2, 0),
        (1.5, 0),
        (0.8, 0),
        (0.4, 0),
        (1.1, 0),
        (0.4, 400),
        (0.4, 300),
        (0.4, 0),
    ):
        device.takes_s = takes_s
        clock.advance_ns(round(rests_s * 1e9))
        await poller.poll()
    assert [(event.kind, event.data["took_s"]) for event in events] == [("device_slow", 1.2), ("device_fast", 0.4)]
    assert events[0].text.startswith("thermometers took 1.2 s to answer and is read every 1 s")
