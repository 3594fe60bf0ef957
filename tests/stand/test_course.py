"""The course of a plan: predicted temperatures against the equation of the chamber's model, solved apart."""

import math

import pytest

from thermostand.experiments.steps import Capture, Role, SetTemperature, Soak, StartChamber, StopChamber, number_steps
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.chamber_model import ChamberModel, Response
from thermostand.stand.estimating.course import predict_course
from thermostand.stand.estimating.estimate import price_plan
from thermostand.stand.estimating.learned_durations import LearnedDurations
from thermostand.stand.estimating.run_estimate import PlanEstimate

MODEL = ChamberModel(
    heating=Response(dead_s=30.0, rate_K_per_s=1 / 30, time_constant_s=120.0), camera_above_air_K=12.0, heating_ramps=1
)
PLAN = (
    StartChamber(24.0),
    Soak(3600.0),
    SetTemperature(52.0),
    Soak(7200.0),
    Capture(5, 0.5, 0.1, Role.FIT, 52.0),
    StopChamber(),
)


@pytest.fixture(scope="module")
def course():
    config = load_config(find_packaged("", "simulated"))
    steps = price_plan(number_steps(PLAN), config, LearnedDurations(chamber=MODEL))
    return predict_course(PlanEstimate(steps, after_s=600.0), config, MODEL)


def _first_s(course, values, reaches):
    return next(t for t, value in zip(course.times_s, values, strict=True) if value is not None and reaches(value))


def test_the_air_arrives_when_the_model_says(course):
    set_s = _first_s(course, course.set_point_degC, lambda degC: degC == 52.0)
    arrived_s = _first_s(course, course.air_degC, lambda degC: degC > 51.5)
    assert arrived_s - set_s == pytest.approx(MODEL.arrival_s(24.0, 52.0), abs=40.0)  # two points of the curve


def test_the_camera_follows_with_its_time_constant_and_stays_above_the_air(course):
    pairs = [(t, c) for t, a, c in zip(course.times_s, course.air_degC, course.camera_degC, strict=True) if a == 52.0]
    left_K = [64.0 - camera for _, camera in (pairs[0], pairs[-1])]
    lasts_s = pairs[-1][0] - pairs[0][0]
    assert left_K[1] == pytest.approx(left_K[0] * math.exp(-lasts_s / MODEL.camera_time_constant_s), abs=0.05)


def test_soaks_and_frames_are_where_the_plan_has_them(course):
    assert [soak.to_s - soak.from_s for soak in course.soaks] == pytest.approx([3600.0, 7200.0])
    capture = course.captures[0]
    assert (capture.chamber_degC, capture.role, capture.frames) == (52.0, "fit", 5)
    assert capture.at_s == pytest.approx(course.soaks[-1].to_s)


def test_nothing_is_stated_of_a_stopped_chamber_but_the_way_back(course):
    config = load_config(find_packaged("", "simulated"))
    assert course.set_point_degC[-1] == config.ending.ambient_degC
    stopped = predict_course(PlanEstimate(price_plan(number_steps([Soak(600.0, band_K=0.0)]), config)), config, MODEL)
    assert set(stopped.air_degC) == {None}


def test_a_plan_of_weeks_has_no_more_points_than_a_screen(course):
    config = load_config(find_packaged("", "simulated"))
    plan = [
        StartChamber(24.0),
        *[step for _ in range(200) for step in (Soak(7200.0), SetTemperature(30.0), Soak(3600.0))],
    ]
    long = predict_course(PlanEstimate(price_plan(number_steps(plan), config)), config, MODEL)
    assert len(long.times_s) < 2000
    assert long.times_s == sorted(long.times_s)
