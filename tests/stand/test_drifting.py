"""A thermometer that drifts by 10 mK/h is found by comparing it with another one in the same air."""

import random
from collections.abc import Callable

from thermostand.foundation.clock import to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.guarding.rules import limit_sensor_drift

AIR, OTHER, SP, FLAP = "thermometers.air", "thermometers.ceiling", "regulator.sp", "flap.position"
STEP_S = 30.0
HOUR_S = 3600.0


def reported(
    hours: float,
    air_K: Callable[[float], float],
    sp_degC: Callable[[float], float] = lambda hour: 40.0,
    flap: Callable[[float], float] = lambda hour: 0.0,
    *,
    is_bad: Callable[[float], bool] = lambda hour: False,
) -> dict[str, float]:
    """What the rule says first of each kind, and after how many hours; with 3 mK of noise."""
    hub, rule, chance = Hub(), limit_sensor_drift((AIR, OTHER), SP, (FLAP,), limit_K=0.08), random.Random(3)
    found: dict[str, float] = {}
    for number in range(round(hours * HOUR_S / STEP_S)):
        hour, now_ns = number * STEP_S / HOUR_S, to_ns(number * STEP_S)
        true_degC = sp_degC(hour)
        air = Reading(AIR, true_degC + air_K(hour) + chance.gauss(0, 0.003), "degC", now_ns)
        readings = (
            bad_reading(AIR, "degC", now_ns, "open") if is_bad(hour) else air,
            Reading(OTHER, true_degC - 0.3 * flap(hour) + chance.gauss(0, 0.003), "degC", now_ns),
            Reading(SP, true_degC, "degC", now_ns),
            Reading(FLAP, flap(hour), "1", now_ns),
        )
        hub.publish(Batch("all", now_ns, readings))
        if (fault := rule(hub, now_ns)) is not None:
            found.setdefault(fault.rule, hour)
            found["text"] = float(fault.text.count("mK/h"))
    return found


def test_ten_millikelvin_an_hour_are_found_and_reported_as_such():
    found = reported(12.0, lambda hour: 0.2 + 0.010 * hour)
    assert 8 < found["sensor_drifts"] < 10.5
    assert found["text"] == 1


def test_it_is_found_over_visits_of_the_same_set_point():
    visits = {0: 40.0, 1: 10.0, 2: 40.0, 3: 10.0, 4: 40.0}
    found = reported(15.0, lambda hour: 0.010 * hour, lambda hour: visits[int(hour // 3)])
    assert 12 < found["sensor_drifts"] < 15


def test_what_does_not_drift_is_not_reported():
    assert reported(12.0, lambda hour: 0.3) == {}


def test_another_set_point_an_open_flap_and_a_thermometer_that_is_away_are_no_drift():
    assert reported(12.0, lambda hour: 0.004 * (40 if hour < 6 else 10), lambda hour: 40.0 if hour < 6 else 10.0) == {}
    assert reported(12.0, lambda hour: 0.0, flap=lambda hour: float(4 < hour < 8)) == {}
    assert reported(8.0, lambda hour: 5.0 if 3 < hour < 4 else 0.0, is_bad=lambda hour: 3 <= hour <= 4) == {}
