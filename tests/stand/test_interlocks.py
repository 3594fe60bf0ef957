import math

import pytest

from drivers.clock import seconds_ns
from drivers.interface import Quality, Reading, bad_reading
from stand.hub import Batch, Hub
from stand.interlocks import first_fault, over_temperature, safety_rules, trustworthy

AIR = "thermometers.air"


def reading(value: float, time_s: float = 0.0, quality: Quality = Quality.GOOD) -> Reading:
    return Reading(AIR, value, "degC", seconds_ns(time_s), quality)


def hub_of(*readings: Reading) -> Hub:
    hub = Hub()
    for one in readings:
        hub.publish(Batch("thermometers", one.time_ns, (one,)))
    return hub


@pytest.mark.parametrize(
    ("value", "trips"), [(64.9, False), (65.0, False), (65.1, True), (-20.0, False), (math.inf, True)]
)
def test_over_temperature_trips_above_its_limit(value: float, trips: bool):
    fault = over_temperature(AIR, 65.0)(hub_of(reading(value)), 0)
    assert (fault is not None) is trips
    if fault is not None:
        assert AIR in fault.text
        assert "65.0 degC" in fault.text


STALE = Quality.STALE


@pytest.mark.parametrize(
    ("readings", "rule"),
    [
        ([], "sensor_missing"),
        ([reading(24.0, 99.0), bad_reading(AIR, "degC", seconds_ns(100), "open wire")], "sensor_bad"),
        ([reading(24.0, 84.0)], "sensor_stale"),
        ([reading(24.0, 86.0)], None),
        ([reading(24.0, 90.0), reading(24.0, 100.0, STALE)], None),
        ([reading(24.0, 80.0), reading(24.0, 90.0, STALE), reading(24.0, 100.0, STALE)], "sensor_stale"),
        ([reading(24.0, 100.0, STALE)], "sensor_stale"),
    ],
    ids=["never read", "bad", "old", "fresh", "one stale poll", "stale for long", "never good"],
)
def test_a_safety_sensor_must_be_there_good_and_fresh(readings: list[Reading], rule: str | None):
    fault = trustworthy(AIR, 15.0)(hub_of(*readings), seconds_ns(100))
    assert (fault.rule if fault else None) == rule


def test_the_first_objection_is_reported():
    rules = safety_rules({AIR: 65.0}, (AIR,), 15.0)
    assert first_fault(rules, hub_of(reading(24.0)), 0) is None
    hot = first_fault(rules, hub_of(reading(99.0)), 0)
    assert hot is not None
    assert hot.rule == "over_temperature"
