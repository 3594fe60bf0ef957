"""Motion as a pure function of time, against formulas worked by hand and against its own continuity."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.drivers.sim.motion.kinematics import (
    Pace,
    Path,
    make_rest,
    plan_path_onward,
    plan_path_to,
    plan_path_to_halt,
)

PACES = st.builds(Pace, st.integers(1, 5_000), st.integers(10, 20_000), st.integers(10, 20_000))
POSITIONS = st.integers(-120_000 * 256, 120_000 * 256).map(lambda microsteps: microsteps / 256)
SPEEDS = st.one_of(st.just(0.0), st.integers(-5_000 * 256, 5_000 * 256).map(lambda microsteps: microsteps / 256))


def test_a_long_move_is_a_trapezoid() -> None:
    path = plan_path_to(0.0, 0.0, 1_000.0, Pace(1_000, 2_000, 4_000))
    assert path.duration_s == pytest.approx(0.5 + 0.625 + 0.25)
    instants = {0.25: (62.5, 500), 0.5: (250, 1_000), 0.75: (500, 1_000), 1.125: (875, 1_000), 1.25: (968.75, 500)}
    for elapsed_s, (position, speed) in instants.items():
        assert path.at(elapsed_s) == pytest.approx((position, speed))
    assert path.at(9.0) == (1_000.0, 0.0)


def test_a_short_move_turns_from_acceleration_to_braking() -> None:
    path = plan_path_to(0.0, 0.0, -3.0, Pace(1_000, 2_000, 4_000))
    assert len(path.phases) == 2
    assert path.at(path.phases[0].duration_s) == pytest.approx((-2.0, -math.sqrt(8_000)))


def test_a_move_that_cannot_stop_in_time_comes_back() -> None:
    path = plan_path_to(0.0, 1_000.0, 100.0, Pace(1_000, 2_000, 4_000))
    assert path.highest(math.inf) == pytest.approx(125.0)
    assert path.at(path.duration_s) == (100.0, 0.0)


def test_onward_motion_never_ends_and_braking_does() -> None:
    pace = Pace(1_000, 2_000, 4_000)
    assert plan_path_onward(0.0, 0.0, -1, pace).at(10.5) == pytest.approx((-250 - 10_000, -1_000))
    assert plan_path_onward(0.0, 400.0, -1, pace).highest(99) == pytest.approx(20.0)
    assert plan_path_to_halt(0.0, 1_000.0, 4_000).at(1) == pytest.approx((125.0, 0.0))
    assert make_rest(7.0).at(3.0) == (7.0, 0.0)


@given(POSITIONS, SPEEDS, POSITIONS, PACES)
def test_a_path_is_continuous_within_its_pace_and_ends_at_the_target(
    position: float, speed: float, target: float, pace: Pace
) -> None:
    path = plan_path_to(position, speed, target, pace)
    top = max(pace.speed, abs(speed)) + 1e-6
    for phase in path.phases:
        assert (phase.position, phase.speed) == pytest.approx((position, speed), abs=1e-6)
        assert -pace.decel - 1e-9 <= phase.accel * (phase.direction() or 1) <= pace.accel + 1e-9
        position, speed = phase.at(phase.duration_s)
        assert abs(speed) <= top
    assert position == pytest.approx(target, abs=1e-5)
    assert speed == pytest.approx(0.0, abs=1e-5)


@given(POSITIONS, SPEEDS, POSITIONS, PACES, st.floats(0, 1))
def test_what_remains_of_a_path_is_the_same_motion(
    position: float, speed: float, target: float, pace: Pace, part: float
) -> None:
    path = plan_path_to(position, speed, target, pace)
    cut_s, later_s = 0.5 * part * path.duration_s, part * path.duration_s
    assert path.after(cut_s).at(later_s - cut_s) == pytest.approx(path.at(later_s), abs=1e-4)


@given(POSITIONS, SPEEDS, POSITIONS, PACES, POSITIONS, st.sampled_from([1, -1]))
def test_a_level_is_reached_in_the_direction_asked_for(
    position: float, speed: float, target: float, pace: Pace, level: float, direction: int
) -> None:
    path = plan_path_to(position, speed, target, pace)
    reached_s = path.reaches_s(level, direction)
    if reached_s is not None:
        assert direction * (path.at(reached_s)[0] - level) >= -1e-4
    elif direction * (target - position) > 0:
        assert direction * (level - target) >= -1e-4, "a path through the level was not noticed"


def test_a_path_that_stands_reaches_nothing() -> None:
    assert Path((), 5.0).reaches_s(5.0, 1) is None
