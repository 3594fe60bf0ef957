import math

import pytest

from drivers.clock import seconds_ns
from drivers.interface import Quality, Reading, bad_reading
from stand.interlocks import first_fault, over_temperature, safety_rules, trustworthy

AIR = "thermometers.air"


def reading(value: float, time_s: float = 0.0, quality: Quality = Quality.GOOD) -> Reading:
    return Reading(AIR, value, "degC", seconds_ns(time_s), quality)


@pytest.mark.parametrize(
    ("value", "trips"), [(64.9, False), (65.0, False), (65.1, True), (-20.0, False), (math.inf, True)]
)
def test_over_temperature_trips_above_its_limit(value: float, trips: bool):
    fault = over_temperature(AIR, 65.0)(lambda _: reading(value), 0)
    assert (fault is not None) is trips
    if fault is not None:
        assert AIR in fault.text
        assert "65.0 degC" in fault.text


@pytest.mark.parametrize(
    ("latest", "rule"),
    [
        (None, "sensor_missing"),
        (bad_reading(AIR, "degC", seconds_ns(100), "open wire"), "sensor_bad"),
        (reading(24.0, 84.0), "sensor_stale"),
        (reading(24.0, 86.0), None),
        (reading(24.0, 100.0, Quality.STALE), None),
    ],
)
def test_a_safety_sensor_must_be_there_good_and_fresh(latest: Reading | None, rule: str | None):
    fault = trustworthy(AIR, 15.0)(lambda _: latest, seconds_ns(100))
    assert (fault.rule if fault else None) == rule


def test_a_value_that_is_stale_for_long_trips():
    """One poll without its fault bits is STALE and tolerated; the next must confirm it."""
    stale = reading(24.0, 80.0, Quality.STALE)
    fault = trustworthy(AIR, 15.0)(lambda _: stale, seconds_ns(100))
    assert fault is not None


def test_the_first_objection_is_reported():
    rules = safety_rules({AIR: 65.0}, (AIR,), 15.0)
    assert first_fault(rules, lambda _: reading(24.0), 0) is None
    hot = first_fault(rules, lambda _: reading(99.0), 0)
    assert hot is not None
    assert hot.rule == "over_temperature"
