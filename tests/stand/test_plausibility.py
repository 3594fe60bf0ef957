"""Heat that should come and does not, and heat that should not and does: on a simulated chamber, with the defaults."""

import math
from collections.abc import Callable

import pytest

from tests.nightly import mark_nightly
from tests.stand.chamber_run import START_NS, ChamberRun
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.config.guard_section import HeaterOffConfig
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.guarding.plausibility import (
    FollowingBody,
    combine_surroundings,
    forbid_warming_while_off,
    read_channels,
)
from thermostand.stand.guarding.rules import Announcements, make_watches
from thermostand.stand.guarding.stuck_sensor import forbid_stuck_while_other_moves
from thermostand.stand.safety.fault import Fault


def faults_of(run: ChamberRun) -> list[tuple[float, Fault]]:
    """(s, fault) of everything the whole table says in a session, warnings too."""
    config, announced = load_config(find_packaged("", "simulated")), Announcements()
    rules = make_watches(config, announced)
    faults: list[tuple[float, Fault]] = []
    for now_ns in run.polls():
        for fault in (watch.check(run.hub, now_ns) for watch in rules):
            if fault is not None:
                faults.append(((now_ns - START_NS) / NS_PER_S, fault))
        if faults:
            break
    return faults


@pytest.mark.parametrize(
    "run",
    [
        mark_nightly(ChamberRun([24, 60, -10, 52, 10, 24], 3600)),
        ChamberRun([30, 24, 45, 10, 60, 20], 900),
        mark_nightly(ChamberRun([30, 24, 45, 10, 60, 20, 50, 31, 34, 24], 900)),
        ChamberRun([24, 55, 24], 2700, compressor_always=True),
        mark_nightly(ChamberRun([24, 55, 24, 40], 2700, compressor_always=True)),
        mark_nightly(ChamberRun([-10, 60, 0], 3600, laboratory_degC=32)),
        mark_nightly(ChamberRun([60, -10, 60], 3600, laboratory_degC=10)),
        ChamberRun([10], 9000, disturb=lambda run, time_s: run.stop() if time_s == 5400 else None),
        mark_nightly(ChamberRun([10], 18_000, disturb=lambda run, time_s: run.stop() if time_s == 5400 else None)),
        mark_nightly(ChamberRun([52], 18_000, disturb=lambda run, time_s: run.stop() if time_s == 5400 else None)),
    ],
    ids=[
        "far",
        "fast",
        "fast for long",
        "compressor fights",
        "compressor fights for long",
        "hot laboratory",
        "cold laboratory",
        "warming up",
        "warming up for long",
        "cooling down",
    ],
)
def test_a_good_session_trips_nothing_and_warns_of_nothing(run: ChamberRun):
    assert faults_of(run) == []


def dead_heater(from_s: float) -> Callable[[ChamberRun, float], None]:
    def disturb(run: ChamberRun, time_s: float) -> None:
        run.plant.cut_out_open = time_s >= from_s

    return disturb


def welded(share: float) -> Callable[[float], Callable[[ChamberRun, float], None]]:
    """The solid-state relay conducts for that share, whatever the regulator says."""

    def from_(from_s: float) -> Callable[[ChamberRun, float], None]:
        def disturb(run: ChamberRun, time_s: float) -> None:
            def conduct(time_ns: int, dt_s: float) -> None:
                run.plant.heater_on_fraction = max(share, run.plant.heater_on_fraction)

            if time_s == from_s:
                run.plant.on_step.append(conduct)

        return disturb

    return from_


def stuck_probe(pv_degC: float) -> Callable[[float], Callable[[ChamberRun, float], None]]:
    def from_(from_s: float) -> Callable[[ChamberRun, float], None]:
        def disturb(run: ChamberRun, time_s: float) -> None:
            run.regulator.stuck_pv_degC = pv_degC if time_s >= from_s else None

        return disturb

    return from_


def lost_permit(from_s: float) -> Callable[[ChamberRun, float], None]:
    def disturb(run: ChamberRun, time_s: float) -> None:
        run.permitted = time_s < from_s

    return disturb


def drifting_probe(K_per_h: float) -> Callable[[float], Callable[[ChamberRun, float], None]]:
    def from_(from_s: float) -> Callable[[ChamberRun, float], None]:
        def disturb(run: ChamberRun, time_s: float) -> None:
            run.regulator.pv_offset_K = max(0.0, time_s - from_s) * K_per_h / 3600

        return disturb

    return from_


@pytest.mark.parametrize(
    ("break_it", "from_s", "set_points_degC", "rule", "action", "within_s"),
    [
        (dead_heater, 0, [40], "first_heat", "hold", 150),
        (dead_heater, 3600, [30, 45], "no_heat_response", "abort", 200),
        (dead_heater, 2700, [45], "no_heat_response", "abort", 300),
        (welded(0.6), 1800, [30], "warming_while_off", "abort", 500),
        (welded(0.8), 1800, [10], "warming_while_off", "abort", 300),
        (welded(0.36), 2700, [24, 24], "cooling_in_vain", "hold", 900),
        (welded(0.36), 2700, [45, 45], "cooling_in_vain", "hold", 900),
        (stuck_probe(23.9), 3000, [30], "no_heat_response", "abort", 100),
        (stuck_probe(30.0), 3605, [30, 45], "air_warmer_than_shown", "abort", 100),
        (drifting_probe(6.0), 1800, [30, 30], "sensors_disagree", "warn", 2600),
        (drifting_probe(60.0), 1800, [30], "sensors_disagree", "abort", 600),
        (lost_permit, 1800, [40], "permit_missing", "hold", 100),
    ],
    ids=[
        "dead heater at the start",
        "dead heater on a ramp",
        "dead heater at a set-point",
        "welded relay",
        "welded relay in the cold",
        "welded relay that the cold balances",
        "welded relay that the cold balances in the heat",
        "detached probe",
        "probe stuck on a ramp",
        "probe that drifts",
        "probe that drifts fast",
        "relay that fell",
    ],
)
def test_what_breaks_is_found_in_time(
    break_it: Callable[[float], Callable[[ChamberRun, float], None]],
    from_s: float,
    set_points_degC: list[float],
    rule: str,
    action: str,
    within_s: float,
):
    time_s, fault = faults_of(ChamberRun(set_points_degC, 3600, disturb=break_it(from_s)))[0]
    assert (fault.rule, fault.action) == (rule, action)
    assert from_s < time_s <= from_s + within_s


PV, AIR = "regulator.pv", "thermometers.air"
LABORATORY, GRANITE, PERMIT = "thermometers.laboratory", "thermometers.granite_inside", "relays.heater_enable"


def publish(hub: Hub, channel: str, value: float) -> None:
    reading = bad_reading(channel, "degC", 0, "lost") if math.isnan(value) else Reading(channel, value, "degC", 0)
    hub.publish(Batch("device", 0, (reading,)))


@pytest.mark.parametrize(
    ("air_K", "found_s"),
    [
        (lambda after_s: 1.3, 65),  # once it is no scatter of the last dozen
        (lambda after_s: 1.3 if after_s == 5 else 0.0, None),  # one reading says nothing
        (lambda after_s: 1.0 * (-1) ** (after_s // 5), None),  # noise
    ],
)
def test_a_regulator_that_holds_its_temperature_is_not_stuck_one_that_misses_a_change_is(
    air_K: Callable[[int], float], found_s: int | None
):
    hub, rule, times_s = Hub(), forbid_stuck_while_other_moves(PV, AIR), list[int]()
    publish(hub, PV, 24.0)
    for second in range(0, 4600, 5):
        now_ns, after_s = to_ns(second), second - 4000
        air_degC = 24.0 + 0.4 * math.sin(second / 300) + (air_K(after_s) if after_s >= 0 else 0.0)
        hub.publish(Batch("device", now_ns, (Reading(AIR, air_degC, "degC", now_ns),)))
        if (fault := rule(hub, now_ns)) is not None:
            assert fault.rule == "sensor_stuck"
            times_s.append(after_s)
    assert times_s[:1] == ([] if found_s is None else [found_s])
    publish(hub, PV, 24.1)
    assert rule(hub, to_ns(4601)) is None


def publish_all(hub: Hub, values: dict[str, float]) -> None:
    for channel, value in values.items():
        publish(hub, channel, value)


WELDED = {
    "regulator.mv_heat": 0.0,
    "regulator.running": 1.0,
    "regulator.sp": 24.0,
    PERMIT: 1.0,
    LABORATORY: 24.0,
    GRANITE: 25.0,
}


@pytest.mark.parametrize(
    ("changed", "trips"),
    [
        ({}, True),
        ({"regulator.mv_heat": 1.0}, False),
        ({"regulator.mv_heat": 1.0, PERMIT: 0.0}, True),
        ({"regulator.sp": 50.0}, False),
        ({"regulator.sp": 50.0, "regulator.running": 0.0}, True),
        ({LABORATORY: 32.0}, False),
        ({GRANITE: 32.0}, False),
        ({LABORATORY: math.nan}, True),
        ({LABORATORY: math.nan, GRANITE: math.nan}, False),
    ],
    ids=[
        "welded",
        "a little heat",
        "permit off",
        "on its way up",
        "stopped",
        "hot laboratory",
        "hot granite",
        "laboratory unknown",
        "surroundings unknown",
    ],
)
def test_air_that_rises_with_the_heater_off_was_heated_unless_something_else_can_have_warmed_it(
    changed: dict[str, float], trips: bool
):
    """From 30 to 36 degC in 500 s, with one look, the first that counts, in which the air could not be read."""
    hub = Hub()
    rule = forbid_warming_while_off(
        HeaterOffConfig(rise_K=2.0),
        AIR,
        "regulator",
        PERMIT,
        read_channels(LABORATORY, GRANITE),
    )
    publish_all(hub, WELDED | changed)
    found_s: list[int] = []
    for second in range(0, 500, 10):
        publish(hub, AIR, math.nan if second == 120 else 30.0 + second / 80)
        if rule(hub, to_ns(second)) is not None:
            found_s.append(second)
    assert found_s[:1] == ([290] if trips else [])


def test_a_granite_without_a_thermometer_is_taken_for_what_the_air_makes_of_it():
    hub, granite = Hub(), FollowingBody(AIR, lag_s=4000.0, warmest_degC=40.0)
    around = combine_surroundings(read_channels(LABORATORY), granite)
    publish_all(hub, {AIR: 20.0, LABORATORY: 24.0})
    assert around(hub, 0) == (24.0, 40.0)
    for second in range(10, 4001, 10):
        found = around(hub, to_ns(second))
    assert found == (24.0, pytest.approx(20 + 20 * math.exp(-1)))
    publish(hub, AIR, math.nan)  # unknown air leaves it as it is
    assert around(hub, to_ns(8000)) == found
    publish(hub, AIR, 60.0)
    for second in range(8000, 40_000, 100):
        found = around(hub, to_ns(second))
    assert found[1] == pytest.approx(60.0, abs=0.1)


def test_on_a_stand_without_the_granite_a_welded_relay_is_found_once_the_air_is_above_all_that_could_warm_it():
    hub = Hub()
    rule = forbid_warming_while_off(HeaterOffConfig(), AIR, "regulator", PERMIT, FollowingBody(AIR, 4300.0, 40.0))
    publish_all(hub, WELDED | {GRANITE: math.nan, LABORATORY: math.nan})
    found_s: list[int] = []
    for second in range(0, 30_000, 10):
        publish(hub, AIR, 24.0 if second < 20_000 else 24.0 + (second - 20_000) / 100)
        if rule(hub, to_ns(second)) is not None:
            found_s.append(second)
    assert 20_500 <= found_s[0] < 20_600  # 5 K above what the air was, 24.4 degC by then
