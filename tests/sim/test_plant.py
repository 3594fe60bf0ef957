"""The laboratory's heat: ranges, lags, and independence of how often it is asked."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict

import pytest

from thermostand.drivers.sim.physics.hysteresis import BoucWen
from thermostand.drivers.sim.physics.plant import NS_PER_S, Plant, PlantSpec, STEP_ns

START_ns = 1_700_000_000 * NS_PER_S
MINUTE_ns = 60 * NS_PER_S
HOUR_ns = 3600 * NS_PER_S


def heat_at(fraction: float, plant: Plant) -> None:
    plant.heater_enabled = True
    plant.heater_on_fraction = fraction


def hold_air(plant: Plant, air_degC: float) -> Callable[[float], None]:
    """An ideal chamber: air and walls at a temperature that the returned function changes."""
    target = [air_degC]

    def pin(time_ns: int, dt_s: float) -> None:
        plant.bulk_air_degC = plant.wall_degC = target[0]

    plant.on_step.append(pin)
    return lambda degC: target.__setitem__(0, degC)


def steady_laboratory(camera_powered: bool = False, initial_degC: float | None = None) -> Plant:
    spec = PlantSpec(laboratory_swing_K=0.0, camera_powered=camera_powered, initial_degC=initial_degC)
    return Plant(spec, START_ns)


def test_the_result_does_not_depend_on_how_often_it_is_asked():
    def busy_plant() -> Plant:
        plant = Plant(PlantSpec(camera="unmodified", camera_powered=True), START_ns)
        plant.flap_open_at = lambda time_ns: 0.5 + 0.5 * math.sin(time_ns / 1e11)

        def drive(time_ns: int, dt_s: float) -> None:
            minute = (time_ns - START_ns) // MINUTE_ns
            heat_at(0.3 if minute % 3 else 0.0, plant)
            plant.compressor_on = minute % 7 > 4

        plant.on_step.append(drive)
        return plant

    at_once, piecewise = busy_plant(), busy_plant()
    end_ns = START_ns + 30 * MINUTE_ns + 123_456_789
    at_once.advance(end_ns)
    now_ns = START_ns
    while now_ns < end_ns:
        now_ns = min(end_ns, now_ns + 777_777_777)
        piecewise.advance(now_ns)
        piecewise.advance(now_ns - NS_PER_S)  # an earlier time is no step back
    assert piecewise.state() == at_once.state()
    assert piecewise.now_ns == at_once.now_ns == START_ns + 3600 * STEP_ns
    assert piecewise.optics(end_ns) == at_once.optics(end_ns)


def test_callbacks_see_every_grid_step_once_before_its_heat_is_integrated():
    plant = steady_laboratory()
    seen: list[tuple[int, float]] = []
    plant.on_step.append(lambda time_ns, dt_s: seen.append((time_ns, dt_s)))
    plant.on_step.append(lambda time_ns, dt_s: heat_at(0.25, plant))
    plant.advance(START_ns + STEP_ns)
    assert plant.heater_W == 500.0
    plant.advance(START_ns + 10 * STEP_ns + 1)
    assert seen == [(START_ns + index * STEP_ns, 0.5) for index in range(10)]


def test_half_a_step_changes_nothing():
    plant = Plant(PlantSpec(camera_powered=True), START_ns)
    before = plant.state()
    plant.advance(START_ns + STEP_ns - 1)
    assert plant.state() == before


def test_an_untouched_laboratory_stays_near_room_temperature():
    plant = steady_laboratory()
    plant.advance(START_ns + 2 * HOUR_ns)
    assert plant.chamber_degC == pytest.approx(24.0, abs=3.0)  # the fan alone warms it
    assert plant.artifact_degC == pytest.approx(24.0, abs=0.01)


def test_the_compressor_reaches_minus_ten():
    plant = steady_laboratory()
    plant.compressor_on = True
    plant.advance(START_ns + 4 * HOUR_ns)
    assert plant.chamber_degC < -10.0


def test_the_heater_reaches_seventy_and_the_cut_out_stops_it():
    plant = steady_laboratory()
    heat_at(1.0, plant)
    air_degC: list[float] = []
    plant.on_step.append(lambda time_ns, dt_s: air_degC.append(plant.bulk_air_degC))
    plant.advance(START_ns + 30 * MINUTE_ns)
    assert plant.cut_out_open
    assert plant.heater_W == 0.0
    assert max(air_degC) > 85.0
    assert plant.bulk_air_degC < 85.0
    plant.cut_out_open = False
    plant.advance(plant.now_ns + STEP_ns)
    assert plant.heater_W == 2000.0


def test_without_the_enable_relay_the_heater_stays_cold():
    plant = steady_laboratory()
    plant.heater_on_fraction = 1.0
    plant.advance(START_ns + MINUTE_ns)
    assert plant.heater_W == 0.0
    assert plant.element_degC == pytest.approx(24.0, abs=0.2)


def test_heat_and_cold_arrive_with_the_lag_of_their_elements():
    def fraction_after(lag_s: int, node: str, switch: Callable[[Plant], None]) -> float:
        plant = steady_laboratory()
        hold_air(plant, 24.0)
        switch(plant)
        plant.advance(START_ns + lag_s * NS_PER_S)
        early_K = plant.state()[node] - 24.0
        plant.advance(START_ns + 20 * lag_s * NS_PER_S)
        return early_K / (plant.state()[node] - 24.0)

    assert fraction_after(25, "element_degC", lambda plant: heat_at(0.5, plant)) == pytest.approx(0.632, abs=0.02)
    assert fraction_after(60, "coil_degC", lambda plant: setattr(plant, "compressor_on", True)) == pytest.approx(
        0.632, abs=0.03
    )


def test_a_controlled_step_of_four_kelvin_settles_within_fifteen_minutes():
    plant = steady_laboratory(camera_powered=True)
    integral = [0.0]
    set_point_degC = [30.0]

    def regulate(time_ns: int, dt_s: float) -> None:
        error_K = set_point_degC[0] - plant.chamber_degC
        output = 0.3 * error_K + integral[0]
        if 0.0 < output < 1.0:
            integral[0] += 0.3 * error_K / 300.0 * dt_s
        heat_at(min(1.0, max(0.0, output)), plant)

    plant.on_step.append(regulate)
    plant.advance(START_ns + HOUR_ns)
    set_point_degC[0] = 34.0
    changed_ns = plant.now_ns
    last_outside_ns = changed_ns
    while plant.now_ns < changed_ns + 40 * MINUTE_ns:
        plant.advance(plant.now_ns + 5 * NS_PER_S)
        if abs(plant.air_degC - 34.1) > 0.3:
            last_outside_ns = plant.now_ns
    assert last_outside_ns - changed_ns < 15 * MINUTE_ns


def test_the_compressor_takes_four_kelvin_within_fifteen_minutes():
    plant = steady_laboratory(camera_powered=True)
    plant.advance(START_ns + HOUR_ns)
    begin_degC = plant.chamber_degC
    plant.compressor_on = True
    plant.advance(START_ns + HOUR_ns + 15 * MINUTE_ns)
    assert plant.chamber_degC < begin_degC - 4.0


def test_an_open_flap_leaks_heat_to_the_laboratory_and_the_artifact():
    closed, opened = steady_laboratory(initial_degC=50.0), steady_laboratory(initial_degC=50.0)
    opened.flap_open_at = lambda time_ns: 1.0
    for plant in (closed, opened):
        plant.advance(START_ns + 20 * MINUTE_ns)
    assert opened.chamber_degC < closed.chamber_degC - 1.0
    assert closed.artifact_degC == pytest.approx(24.0, abs=1e-9)
    assert 24.1 < opened.artifact_degC < 25.0


def test_the_camera_heats_itself_as_the_paper_saw():
    plant = steady_laboratory(camera_powered=True)
    hold_air(plant, 24.0)
    plant.advance(START_ns + 3 * HOUR_ns)
    assert plant.body_degC - 24.0 == pytest.approx(19.0, abs=1.5)
    assert plant.lens_degC - 24.0 == pytest.approx(16.0, abs=1.0)
    assert 15.0 < plant.sensor_degC - 24.0 < 21.0
    assert plant.sensor_degC > plant.body_degC
    assert 24.1 < plant.air_degC < 24.5


def test_after_45_minutes_the_camera_is_nearly_in_equilibrium_and_the_granite_is_not():
    plant = steady_laboratory(camera_powered=True)
    set_air = hold_air(plant, 24.0)
    plant.advance(START_ns + 4 * HOUR_ns)
    before = plant.state()
    set_air(28.0)
    plant.advance(plant.now_ns + 45 * MINUTE_ns)
    after = plant.state()
    share = {name: (after[name] - before[name]) / 4.0 for name in ("body_degC", "lens_degC", "granite_inside_degC")}
    assert 0.85 < share["body_degC"] < 0.95
    assert 0.82 < share["lens_degC"] < share["body_degC"]
    assert 0.35 < share["granite_inside_degC"] < 0.6


def test_the_supply_relay_switches_the_camera_and_its_time_is_kept():
    plant = steady_laboratory()
    plant.advance(START_ns + MINUTE_ns)
    assert plant.camera_power_on_ns is None
    plant.camera_powered = True
    plant.advance(START_ns + 2 * MINUTE_ns)
    plant.camera_powered = True
    assert plant.camera_power_on_ns == START_ns + MINUTE_ns
    warm_degC = plant.body_degC
    plant.camera_powered = False
    plant.advance(START_ns + HOUR_ns)
    assert plant.body_degC < warm_degC


def test_the_laboratory_swings_with_the_time_of_day():
    plant = Plant(PlantSpec(), START_ns)
    seen = [plant.laboratory_degC]
    for hour in range(1, 25):
        plant.advance(START_ns + hour * HOUR_ns)
        seen.append(plant.laboratory_degC)
    assert max(seen) == pytest.approx(24.4, abs=0.02)
    assert min(seen) == pytest.approx(23.6, abs=0.02)
    assert seen[-1] == pytest.approx(seen[0], abs=1e-3)


def test_a_spec_survives_json_and_the_state_is_numbers():
    spec = PlantSpec(camera="unmodified", camera_roll_deg=20.0)
    assert PlantSpec(**json.loads(json.dumps(asdict(spec)))) == spec
    plant = Plant(spec, START_ns)
    assert json.loads(json.dumps(plant.state())) == plant.state()
    assert {"chamber_degC", "heater_W", "flap_open", "tension_0_K"} <= plant.state().keys()


def test_bouc_wen_saturates_and_keeps_tension_after_a_closed_cycle():
    joint = BoucWen(limit_K=4.0, seed=1)
    path: list[float] = []
    for change_K in [0.01] * 1200 + [-0.01] * 1200:
        joint.step(change_K, 0.0)
        path.append(joint.tension_K)
    assert 3.0 < max(path) <= 4.0
    assert -4.0 <= path[-1] < -3.0  # back at the old temperature, not at the old tension


def test_a_tense_joint_creeps_back():
    joint = BoucWen(limit_K=4.0, seed=1, creep_s=100.0)
    joint.step(1.0, 0.0)
    for _ in range(100):
        joint.step(0.0, 1.0)
    assert joint.tension_K == pytest.approx(math.exp(-1.0), abs=0.01)


def test_joints_slip_irregularly_but_repeat_with_their_seed():
    def ride(seed: int) -> list[float]:
        joint = BoucWen(limit_K=9.0, seed=seed)
        path: list[float] = []
        for step in range(40_000):
            joint.step(0.01 if step // 2000 % 2 == 0 else -0.01, 0.5)
            path.append(joint.tension_K)
        return path

    assert ride(1) == ride(1)
    assert max(abs(a - b) for a, b in zip(ride(1), ride(2), strict=True)) > 0.5
