"""A message that repeats is published at most six times an hour, with those between counted, but for what counts."""

import pytest

from thermostand.foundation.clock import to_ns
from thermostand.foundation.events import DEVICE_BACK, DEVICE_LOST, SENSOR_BELIEVED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.repeat_limit import RepeatLimit


def published(kind: str, every_s: float, count: int, data: dict[str, object] | None = None) -> list[Event]:
    hub, events = Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    for number in range(count):
        text = f"relays.heater_enable is off {number * 0.1:.1f} s before its time"
        hub.publish(Event(to_ns(number * every_s), "warning", kind, text, data or {}))
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


@pytest.mark.parametrize(("kind", "data"), [("run.end", {}), ("guard.heater_off", {"action": "hold"}), ("held", {})])
def test_what_begins_or_ends_a_state_is_always_published(kind: str, data: dict[str, object]):
    assert len(published(kind, 5.0, 100, data)) == 100


def test_what_is_always_published_is_beyond_six_an_hour_an_information_unless_somebody_has_to_act():
    levels = [event.level for event in published("held", 5.0, 100)]
    assert (levels.count("warning"), set(levels)) == (3, {"warning", "info"})
    assert {event.level for event in published("run.end", 5.0, 100)} == {"warning"}


@pytest.mark.parametrize("every_s", [2.0, 700.0, 1500.0])
def test_a_state_that_comes_and_goes_is_reported_six_times_an_hour_at_most_of_each_device(every_s: float):
    hub, events = Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    for number in range(int(30000 / every_s)):
        for device in ("flap", "linear"):
            now_ns = to_ns(number * every_s)
            hub.publish(Batch(device, now_ns, ()))
            row = DEVICE_BACK.at(now_ns, device=device, lost_s=1.0)
            hub.publish(row if number % 2 else DEVICE_LOST.at(now_ns, f"{device}: {number}", device=device))
    for kind in ("device_lost", "device_back"):
        times_s = [each.time_ns / 1e9 for each in events if each.kind == kind and each.data["device"] == "flap"]
        assert max(sum(begin <= each < begin + 3600 for each in times_s) for begin in times_s) <= 6
    if every_s > 1200:
        assert len(events) == 2 * int(30000 / every_s)


def test_a_sensor_that_flickers_is_not_believed_again_without_end():
    hub, events = Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    for second in range(3600):
        data = {"channels": ["thermometers.air"], "value_degC": 0.1 * second, "suspect_s": 1.0}
        hub.publish(SENSOR_BELIEVED.at(to_ns(second), "outside", **data))
    assert len(events) == 5
    assert events[-1].data["repeated"] == 1199


def test_a_state_that_lasts_is_never_without_its_begin_nor_its_end():
    hub, events = Hub(RepeatLimit()), list[Event]()
    hub.subscribe(lambda item: events.append(item) if isinstance(item, Event) else None)
    is_lost = False
    for second in range(10000):
        was, is_lost = is_lost, second % 10 < 5 if second < 3000 else second < 6000
        if is_lost and not was:
            hub.publish(DEVICE_LOST.at(to_ns(second), "no answer", device="flap"))
        if was and not is_lost:
            hub.publish(DEVICE_BACK.at(to_ns(second), device="flap", lost_s=1.0))
        hub.publish(Batch("flap", to_ns(second), ()))
    assert [event.kind for event in events] == 3 * ["device_lost", "device_back"]
    assert (events[-2].time_ns, events[-1].time_ns) == (to_ns(20), to_ns(6000))
    assert events[-1].data["repeated"] == 298


def test_another_sentence_or_an_information_is_not_withheld():
    hub, events = Hub(RepeatLimit()), list[object]()
    hub.subscribe(events.append)
    for number in range(40):
        for name in ("air", "pv"):
            hub.publish(Event(number, "warning", "guard.stuck", f"{name} does not move", {"action": "warn"}))
        hub.publish(Event(number, "info", "compressor", "compressor started"))
    assert len(events) == 3 + 3 + 40
    assert Hub is type(hub)
