"""How simulated stages move, home and stop at their limits, on a clock in hand."""

import struct

import pytest

from tests.sim.ximc_bench import (
    ALARM,
    EEPROM,
    FAILED,
    HOME,
    HOMED,
    LEFT,
    LOFT,
    MOVE,
    MOVR,
    POWER_OFF,
    RIGT,
    RUNNING,
    SSTP,
    SWAPPED,
    T0,
    Bench,
)
from thermostand.drivers.framing.ximc import encode

RIGHT_EDGE, LEFT_EDGE = 1, 2


# Motion


def test_after_power_on_it_stands_at_count_zero_unhomed_without_current(linear: Bench) -> None:
    status = linear.status()
    assert (status.steps, status.command, status.power, status.flags) == (0, 0, POWER_OFF, EEPROM)
    assert linear.plant.linear_mm_at(T0) == 5.0


def test_a_move_is_a_trapezoid_in_simulated_time(linear: Bench) -> None:
    linear.move(1_000)
    expected = {0.25: (62.5, 500, 1), 0.75: (500, 1_000, 3), 1.25: (968.75, 500, 1)}
    passed_s = 0.0
    for instant_s, (steps, speed, move_state) in expected.items():
        linear.wait(instant_s - passed_s)
        passed_s = instant_s
        status = linear.status()
        assert status.command == MOVE | RUNNING
        assert (status.steps, status.speed, status.move_state) == (steps, speed, move_state)
    linear.wait(1.375 - passed_s)
    status = linear.status()
    assert (status.command, status.steps, status.speed, status.move_state) == (MOVE, 1_000, 0, 0)


def test_the_motion_does_not_depend_on_how_often_it_is_asked_for() -> None:
    often, once = Bench("linear"), Bench("linear")
    for bench in (often, once):
        bench.ask("home")
    for _ in range(500):
        often.wait(0.0137)
        often.status()
    once.wait(500 * 0.0137)
    assert often.status() == once.status()
    assert often.clock.now_ns() == once.clock.now_ns()


@pytest.mark.parametrize(("full", "micro"), [(0, 100), (0, -100), (12, 255), (-12, -1), (3, -128)])
def test_microsteps_are_kept_whatever_their_sign(linear: Bench, full: int, micro: int) -> None:
    linear.move(full, micro)
    assert linear.settle().steps == full + micro / 256


def test_too_many_microsteps_are_corrected(linear: Bench) -> None:
    assert linear.engine.feed(encode("move", struct.pack("<ih6x", 10, 300))) == b"errv"
    assert linear.settle().steps == 10 + 255 / 256


def test_movr_counts_from_the_target_not_from_the_position(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.5)
    linear.move(100, 128, "movr")
    status = linear.settle()
    assert (status.steps, status.command) == (1_100.5, MOVR)
    linear.move(-100, -128, "movr")
    assert linear.settle().steps == 1_000


def test_movr_after_a_stop_counts_from_where_it_stopped(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.5)
    linear.ask("sstp")
    stopped = linear.settle()
    assert (stopped.command, stopped.steps) == (SSTP, 375)
    linear.move(100, letters="movr")
    assert linear.settle().steps == 475


def test_zero_in_motion_keeps_the_physical_destination(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.65)
    assert linear.status().steps == 400
    linear.ask("zero")
    assert linear.status().steps == 0
    status = linear.settle()
    assert (status.steps, status.command) == (600, MOVE)
    linear.move(10, letters="movr")
    assert linear.settle().steps == 610
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx((2_000 + 1_010) * 0.0025)


def test_zero_at_rest_makes_the_stored_target_zero(linear: Bench) -> None:
    linear.move(1_000)
    linear.settle()
    linear.ask("zero")
    linear.move(10, letters="movr")
    assert linear.settle().steps == 10


def test_spos_sets_count_and_encoder_unless_asked_to_leave_them(linear: Bench) -> None:
    linear.ask("spos", struct.pack("<ihqB5x", 100, 64, 7, 0))
    assert struct.unpack("<ihq6x", linear.ask("gpos", size=26)) == (100, 64, 7)
    linear.ask("spos", struct.pack("<ihqB5x", 1, 1, 1, 3))
    assert struct.unpack("<ihq6x", linear.ask("gpos", size=26)) == (100, 64, 7)


def test_left_and_right_run_until_something_stops_them(linear: Bench) -> None:
    linear.ask("rigt")
    linear.wait(10.25)
    assert (linear.status().command, linear.status().steps) == (RIGT | RUNNING, 10_000)
    linear.ask("left")
    linear.wait(60)
    status = linear.status()
    assert (status.command, status.steps, status.edges) == (LEFT | FAILED, -2_500, LEFT_EDGE)


def test_loft_goes_away_by_the_antiplay_and_comes_back(linear: Bench) -> None:
    linear.ask("loft")
    linear.wait(575 / 1_000 + 0.375)
    assert (linear.status().steps, linear.status().move_state & 4) == (pytest.approx(575, abs=0.01), 4)
    status = linear.settle()
    assert (status.command, status.steps) == (LOFT, pytest.approx(0, abs=1 / 256))


def test_a_speed_above_the_nominal_one_is_limited(linear: Bench) -> None:
    linear.change("mov", "<IBHHIBB9x", f0=9_000)
    linear.move(20_000)
    linear.wait(3)
    assert linear.status().speed == 3_200


def test_speed_zero_never_arrives(linear: Bench) -> None:
    linear.change("mov", "<IBHHIBB9x", f0=0)
    linear.move(100)
    assert (linear.settle().command, linear.status().steps) == (MOVE | RUNNING, 0)


# Homing and limits


def test_homing_ends_at_mechanical_zero_and_leaves_the_count_for_zero_to_clear(linear: Bench) -> None:
    linear.ask("home")
    assert linear.status().command == HOME | RUNNING
    linear.home()
    status = linear.status()
    assert (status.steps, status.flags) == (-2_000, EEPROM | HOMED)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 0
    linear.ask("zero")
    assert linear.status().steps == 0
    assert linear.status().flags & HOMED


def test_homing_takes_as_long_as_its_speeds_say(linear: Bench) -> None:
    linear.ask("home")
    to_switch_s = 2_500 / 500 + 0.125  # accelerating at 2000/s2 costs half of 0.25 s
    linear.wait(to_switch_s)
    assert (linear.status().steps, linear.status().edges) == (pytest.approx(-2_500, abs=0.01), LEFT_EDGE)
    linear.wait(500 / 500 + 0.25 / 2 + 0.125 / 2 - 0.001)
    assert linear.status().command == HOME | RUNNING
    linear.wait(0.002)
    assert linear.status().command == HOME


def test_the_turntable_homes_at_its_only_switch_and_turns_without_end(rotary: Bench) -> None:
    rotary.home()
    assert rotary.status().steps == -2_000
    assert rotary.plant.rotary_deg_at(rotary.clock.now_ns()) == pytest.approx(0, abs=1e-9)
    rotary.ask("zero")
    rotary.move(80_000)
    status = rotary.settle()
    assert (status.command, status.steps, status.edges) == (MOVE, 80_000, 0)
    assert rotary.plant.rotary_deg_at(rotary.clock.now_ns()) == 800
    rotary.move(72_000 + 1_250)
    assert rotary.settle().edges == LEFT_EDGE


def test_homing_can_seek_a_second_switch(linear: Bench) -> None:
    first_right_second_left_by_switches = 0x1 | 0x4 | 0x30 | 0xC0
    linear.change("hom", "<IBIBihH9x", f0=3_000, f2=3_000, f4=-100, f6=first_right_second_left_by_switches)
    linear.ask("home")
    linear.wait(117_500 / 3_000 + 0.75)
    assert linear.status().steps == pytest.approx(117_500, abs=1), "at the right switch"
    linear.wait(60)
    assert linear.status().command == HOME
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx((-500 + 100) * 0.0025)


def test_a_move_into_the_limit_fails_and_can_be_taken_back(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.change("mov", "<IBHHIBB9x", f0=3_000)
    linear.move(125_000)
    status = linear.settle()
    assert (status.command, status.edges, status.flags & HOMED) == (MOVE | FAILED, RIGHT_EDGE, HOMED)
    assert status.steps == 119_500
    linear.move(119_600)
    assert linear.status().command == MOVE | FAILED, "no further in that direction"
    linear.move(119_000)
    status = linear.settle()
    assert (status.command, status.edges, status.steps) == (MOVE, 0, 119_000)


def test_border_values_stop_the_motor_when_they_are_in_force(linear: Bench) -> None:
    linear.change("eds", "<BBihih6x", f0=1 | 2 | 4, f2=-50, f4=300)
    linear.move(1_000)
    assert (linear.settle().command, linear.status().steps) == (MOVE | FAILED, 300)
    linear.move(-1_000)
    assert (linear.settle().command, linear.status().steps) == (MOVE | FAILED, -50)


def test_a_stuck_limit_switch_stops_the_move_where_it_is(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.axis.limit = "right"
    linear.wait(0.001)
    status = linear.status()
    assert (status.command, status.steps, status.edges) == (MOVE | FAILED, 500, RIGHT_EDGE)
    linear.move(0)
    assert (linear.settle().command, linear.status().steps) == (MOVE, 0)
    linear.axis.limit = ""
    linear.move(600)
    assert (linear.settle().steps, linear.status().edges) == (600, 0)


def test_the_wrong_limit_raises_an_alarm_that_only_stop_clears(linear: Bench) -> None:
    linear.axis.wrong_limit = True
    linear.ask("left")
    status = linear.settle()
    assert (status.command, status.edges) == (LEFT | FAILED, RIGHT_EDGE)
    assert status.flags == EEPROM | ALARM | SWAPPED
    linear.move(100)
    assert linear.status().command == LEFT | FAILED, "motion is ignored in alarm"
    linear.ask("stop")
    assert linear.status().flags == EEPROM
    linear.move(100)
    assert linear.status().command == MOVE | RUNNING
