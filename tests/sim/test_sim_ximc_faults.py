"""A simulated stage that has a fault, loses steps or current, or is stopped."""

import pytest

from tests.sim.ximc_bench import (
    ALARM,
    CTP_ERROR,
    EEPROM,
    FAILED,
    HOMED,
    MOVE,
    POWER_NORMAL,
    POWER_OFF,
    POWER_REDUCED,
    RUNNING,
    SSTP,
    STOP,
    T0,
    Bench,
)
from thermostand.foundation.clock import to_ns


def test_an_alarm_stops_the_motor_until_stop_clears_it(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.axis.alarm = True
    assert linear.axis.alarm
    status = linear.settle()
    assert (status.command, status.steps, status.flags) == (MOVE | FAILED, 500, EEPROM | ALARM)
    linear.ask("home")
    assert linear.status().command == MOVE | FAILED
    linear.ask("stop")
    assert (linear.status().command, linear.status().flags) == (STOP, EEPROM)


def test_a_ctp_error_loses_the_scale(linear: Bench) -> None:
    linear.home()
    linear.axis.ctp_error = True
    assert linear.axis.ctp_error
    assert linear.status().flags == EEPROM | CTP_ERROR
    linear.axis.ctp_error = False
    assert linear.status().flags == EEPROM


def test_any_danger_bit_can_be_raised(linear: Bench) -> None:
    linear.axis.danger = 0x200 | 0x20000
    assert linear.status().flags == EEPROM | 0x20200
    linear.ask("stop")
    assert linear.status().flags == EEPROM


def test_steps_lost_at_an_obstacle_show_at_the_next_home_check(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.axis.stall_steps = 600
    linear.move(1_000)
    status = linear.settle()
    assert (status.command, status.steps, status.flags & HOMED) == (MOVE, 1_000, HOMED), "the controller saw nothing"
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 600 * 0.0025
    linear.move(900)
    assert linear.settle().steps == 900
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 500 * 0.0025
    linear.axis.stall_steps = None
    linear.home()
    assert linear.status().steps == 400, "the residual of the home check"
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 0


def test_an_obstacle_before_the_switch_keeps_the_limit_from_being_reached(linear: Bench) -> None:
    linear.axis.stall_steps = 3_000
    linear.move(150_000)
    linear.wait(200)
    assert (linear.status().command, linear.status().edges) == (MOVE, 0)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx(7.5)


def test_steps_can_be_lost_by_order(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.axis.lost_steps = 40
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == pytest.approx(-0.1)
    linear.home()
    assert linear.status().steps == 40


def test_an_endless_command_runs_until_a_soft_stop(linear: Bench) -> None:
    linear.axis.endless = True
    linear.move(100)
    assert linear.settle().command == MOVE | RUNNING
    linear.ask("sstp")
    assert linear.status().command == SSTP


def test_stop_is_immediate_and_loses_the_scale_only_out_of_motion(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.ask("stop")
    assert linear.status().flags & HOMED
    linear.move(1_000)
    linear.wait(0.75)
    linear.ask("stop")
    status = linear.settle()
    assert (status.command, status.steps, status.flags & HOMED) == (STOP, 500, 0)


def test_a_power_cycle_forgets_position_and_scale_but_not_the_place(linear: Bench) -> None:
    linear.home()
    linear.ask("zero")
    linear.move(400)
    linear.settle()
    linear.axis.power_cycle()
    status = linear.status()
    assert (status.steps, status.command, status.power, status.flags) == (0, 0, POWER_OFF, EEPROM)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 1.0


# Current in the windings


def test_the_linear_stage_loses_current_60_s_after_a_stop_and_relaxes_to_a_full_step(linear: Bench) -> None:
    linear.move(100, 64)
    linear.wait(0.1)
    assert linear.status().power == POWER_NORMAL
    linear.wait(2)
    rested = linear.status()
    assert (rested.power, rested.steps) == (POWER_REDUCED, 100.25)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 2_100.25 * 0.0025
    linear.wait(60)
    off = linear.status()
    assert (off.power, off.steps) == (POWER_OFF, 100.25)
    assert linear.plant.linear_mm_at(linear.clock.now_ns()) == 2_100 * 0.0025
    linear.move(100, 64)
    assert linear.settle().steps == 100.25


def test_the_turntable_keeps_reduced_current(rotary: Bench) -> None:
    rotary.move(100)
    rotary.wait(1_000)
    assert rotary.status().power == POWER_REDUCED


def test_the_motor_goes_off_by_command_at_rest_only(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.ask("pwof")
    assert (linear.status().power, linear.status().command) == (POWER_NORMAL, MOVE | RUNNING)
    linear.wait(5)
    linear.ask("pwof")
    assert linear.status().power == POWER_OFF
    linear.move(0)
    assert linear.status().power == POWER_NORMAL


def test_the_motor_can_fail_in_motion(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.axis.motor_off = True
    assert linear.axis.motor_off
    status = linear.settle()
    assert (status.power, status.command, status.steps) == (POWER_OFF, MOVE | FAILED, 500)


def test_the_plant_may_ask_for_a_moment_just_past_or_still_to_come(linear: Bench) -> None:
    linear.move(1_000)
    linear.wait(0.75)
    linear.ask("stop")
    places_mm = [linear.plant.linear_mm_at(T0 + to_ns(time_s)) for time_s in (0.0, 0.25, 0.5, 0.75, 5.0)]
    assert places_mm == pytest.approx([5.0, 5.0 + 62.5 * 0.0025, 5.0 + 250 * 0.0025, 6.25, 6.25])
