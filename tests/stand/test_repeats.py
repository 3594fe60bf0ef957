"""A message that repeats is published at most six times an hour, with those between counted, but for what counts."""

import pytest

from thermostand.foundation.clock import seconds_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.repeats import RepeatLimit


def published(kind: str, every_s: float, count: int, data: dict[str, object] | None = None) -> list[Event]:
    hub, events = Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    for number in range(count):
        text = f"relays.heater_enable is off {number * 0.1:.1f} s before its time"
        hub.publish(Event(seconds_ns(number * every_s), "warning", kind, text, data or {}))
    return events


@pytest.mark.parametrize("every_s", [0.5, 5.0, 60.0, 601.0, 1199.0])
def test_in_no_hour_more_than_six_and_the_rest_is_counted(every_s: float):
    count = int(20000 / every_s)
    events = published("heater_enable_dropped", every_s, count)
    times_s = [event.time_ns / 1e9 for event in events]
    assert times_s[0] == 0
    assert max(sum(begin <= each < begin + 3600 for each in times_s) for begin in times_s) <= 6
    withheld = sum(int(str(event.data.get("repeated", 0))) for event in events)
    assert 0 <= count - len(events) - withheld <= 1200 / every_s  # those since the last are still to be counted


def test_after_a_quiet_hour_it_is_a_new_message():
    assert len(published("heater_enable_dropped", 3600.0, 30)) == 30


@pytest.mark.parametrize(
    ("kind", "data"), [("device_lost", {}), ("guard.heater_off", {"action": "hold"}), ("held", {})]
)
def test_what_begins_or_ends_a_state_is_always_published(kind: str, data: dict[str, object]):
    assert len(published(kind, 5.0, 100, data)) == 100


def test_another_sentence_or_an_information_is_not_withheld():
    hub, events = Hub(RepeatLimit()), list[object]()
    hub.subscribe(events.append)
    for number in range(40):
        for name in ("air", "pv"):
            hub.publish(Event(number, "warning", "guard.stuck", f"{name} does not move", {"action": "warn"}))
        hub.publish(Event(number, "info", "compressor", "compressor started"))
    assert len(events) == 3 + 3 + 40
    assert Hub is type(hub)
