"""The fake Jrk G2: what it answers to control transfers, and where the flap is."""

import struct

import pytest

from tests.still_plant import StillPlant
from thermostand.drivers.sim.motion.flap import (
    ERROR_AWAITING_COMMAND,
    ERROR_FEEDBACK_DISCONNECT,
    ERROR_NO_POWER,
    ERROR_SOFT_OVER_CURRENT,
    FakeFlap,
)
from thermostand.drivers.sim.usb import Stall
from thermostand.foundation.clock import FollowedClock, to_ns

T0 = 1_700_000_000_000_000_000


class Bench:
    """A flap with a clock in hand."""

    def __init__(self) -> None:
        self.plant = StillPlant(T0)
        self.clock = FollowedClock(T0)
        self.flap = FakeFlap(self.plant, self.clock, "00123")

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + to_ns(duration_s))

    def target(self, position: int) -> None:
        assert self.flap.control_transfer(0x40, 0x84, position, 0, b"") == b""

    def stop(self) -> None:
        self.flap.control_transfer(0x40, 0x87, 0, 0, b"")

    def word(self, offset: int, kind: str = "H", clear: int = 0) -> int:
        block = self.flap.control_transfer(0xC0, 0xE5, clear, 0, 0x35)
        assert len(block) == 0x35
        return struct.unpack_from(f"<{kind}", block, offset)[0]

    @property
    def scaled(self) -> int:
        return self.word(0x06)

    @property
    def duty(self) -> int:
        return self.word(0x0C, "h")

    @property
    def halting(self) -> int:
        return self.word(0x12)

    @property
    def current_mA(self) -> int:
        return self.word(0x19)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_after_power_up_it_stands_closed_and_awaits_a_command(bench: Bench) -> None:
    assert (bench.scaled, bench.duty, bench.current_mA) == (500, 0, 0)
    assert (bench.halting, bench.word(0x14)) == (ERROR_AWAITING_COMMAND, ERROR_AWAITING_COMMAND)
    assert (bench.word(0x17), bench.word(0x1F, "B"), bench.word(0x20, "I")) == (12_040, 0, 0)
    assert bench.plant.advanced_ns == T0
    bench.wait(2.5)
    assert bench.word(0x20, "I") == 2_500


def test_a_target_moves_the_flap_at_3000_units_a_second(bench: Bench) -> None:
    bench.target(3_500)
    bench.wait(0.5)
    assert (bench.word(0x02), bench.scaled, bench.duty, bench.current_mA) == (3_500, 2_000, 600, 150)
    assert bench.halting == 0
    bench.wait(0.5)
    assert (bench.scaled, bench.duty, bench.current_mA) == (3_500, 0, 0)


def test_the_plant_sees_the_openness_at_any_time_not_long_past(bench: Bench) -> None:
    bench.target(3_500)
    bench.wait(0.25)
    bench.stop()
    bench.wait(1.0)
    bench.target(500)
    openness = [bench.plant.flap_open_at(T0 + to_ns(time_s)) for time_s in (0.0, 0.1, 0.25, 0.9, 1.25, 1.35, 9.0)]
    assert openness == pytest.approx([0.0, 0.1, 0.25, 0.25, 0.25, 0.15, 0.0])


def test_stop_leaves_the_flap_where_it_is(bench: Bench) -> None:
    bench.target(3_500)
    bench.wait(0.5)
    bench.stop()
    bench.wait(5)
    assert (bench.scaled, bench.duty, bench.halting) == (2_000, 0, ERROR_AWAITING_COMMAND)


def test_a_jam_shows_full_duty_and_stall_current_but_no_error_flag(bench: Bench) -> None:
    bench.target(3_500)
    bench.wait(1)
    bench.flap.jam_position = 2_000
    bench.target(300)
    bench.wait(0.4)
    assert (bench.scaled, bench.duty, bench.current_mA) == (2_300, -600, 150)
    bench.wait(5)
    assert (bench.word(0x02), bench.scaled, bench.duty, bench.current_mA) == (300, 2_000, -600, 800)
    assert bench.halting == 0
    bench.target(3_500)
    bench.wait(0.1)
    assert bench.scaled == 2_300
    bench.target(500)
    bench.flap.jam_position = None
    bench.wait(5)
    assert bench.scaled == 500


def test_a_jam_where_the_flap_stands_holds_it_both_ways(bench: Bench) -> None:
    bench.flap.jam_position = 500
    for target, duty in ((3_500, 600), (0, -600)):
        bench.target(target)
        bench.wait(1)
        assert (bench.scaled, bench.duty) == (500, duty)


@pytest.mark.parametrize("error", [ERROR_NO_POWER, ERROR_FEEDBACK_DISCONNECT, ERROR_SOFT_OVER_CURRENT])
def test_an_error_stops_the_motor_until_its_cause_is_gone_and_it_is_cleared(bench: Bench, error: int) -> None:
    bench.target(3_500)
    bench.wait(0.5)
    bench.flap.active_errors = error
    bench.wait(1)
    assert (bench.halting, bench.duty, bench.current_mA) == (error, 0, 0)
    assert bench.word(0x12, clear=1) == error
    assert bench.halting == error, "the cause still stands"
    bench.flap.active_errors = 0
    assert bench.halting == error, "it stays latched"
    assert bench.scaled == 2_000
    assert bench.word(0x12, clear=1) == error
    assert bench.halting == 0
    bench.wait(0.1)
    assert bench.scaled == 2_300


def test_no_power_and_a_disconnected_feedback_show_in_the_readings(bench: Bench) -> None:
    bench.flap.active_errors = ERROR_NO_POWER
    assert bench.word(0x17) == 0
    bench.flap.active_errors = ERROR_FEEDBACK_DISCONNECT
    assert (bench.word(0x17), bench.word(0x04), bench.scaled) == (12_040, 4_095, 4_095)


def test_clearing_keeps_awaiting_command_among_the_halting_errors(bench: Bench) -> None:
    bench.word(0x12, clear=0b11)
    assert (bench.halting, bench.word(0x14)) == (ERROR_AWAITING_COMMAND, 0)


def test_a_restart_resets_the_up_time_and_awaits_a_command(bench: Bench) -> None:
    bench.target(3_500)
    bench.wait(0.5)
    bench.flap.restart(reset_cause=1)
    bench.wait(0.1)
    assert (bench.word(0x20, "I"), bench.word(0x1F, "B"), bench.halting) == (100, 1, ERROR_AWAITING_COMMAND)
    assert (bench.scaled, bench.duty) == (2_000, 0)


def test_a_target_does_nothing_in_another_input_mode(bench: Bench) -> None:
    bench.flap.input_mode = 1
    assert bench.flap.control_transfer(0xC0, 0xEA, 0, 3, 1) == b"\x01"
    bench.target(3_500)
    bench.wait(1)
    assert (bench.scaled, bench.halting) == (500, ERROR_AWAITING_COMMAND)


def test_settings_are_read_and_written_in_ram_and_eeprom(bench: Bench) -> None:
    eeprom = bench.flap.control_transfer(0xC0, 0xE3, 0, 0, 0x76)
    assert len(eeprom) == 0x76
    assert eeprom == bench.flap.control_transfer(0xC0, 0xEA, 0, 0, 0x76)
    assert struct.unpack_from("<HH", eeprom, 0x68) == (600, 600)
    bench.flap.control_transfer(0x40, 0xE6, 0, 0x68, struct.pack("<HH", 300, 300))
    bench.flap.control_transfer(0x40, 0x13, 7, 0x21, b"")
    bench.target(3_500)
    bench.wait(1)
    assert (bench.scaled, bench.duty) == (2_000, 300), "half the duty, half the speed"
    assert bench.flap.control_transfer(0xC0, 0xEA, 0, 0x21, 1) == b"\0"
    bench.flap.control_transfer(0x40, 0x10, 0, 0, b"")
    assert bench.flap.control_transfer(0xC0, 0xEA, 0, 0x21, 1) == b"\x07"
    assert bench.flap.control_transfer(0xC0, 0xEA, 0, 0x68, 2) == struct.pack("<H", 600)
    assert bench.halting == ERROR_AWAITING_COMMAND


def test_a_forced_duty_drives_to_the_end_of_travel(bench: Bench) -> None:
    bench.flap.control_transfer(0x40, 0xF4, 0x10000 - 300, 0, b"")
    bench.wait(0.1)
    assert (bench.scaled, bench.duty, bench.word(0x16, "B")) == (350, -300, 2)


@pytest.mark.parametrize(
    ("request_type", "request_number", "value", "index", "length_or_data"),
    [
        (0x40, 0xFF, 0, 0, b""),
        (0x40, 0x84, 4_096, 0, b""),
        (0xC0, 0xE5, 0, 0x35, 1),
        (0xC0, 0xE3, 0, 0x76, 1),
        (0x40, 0xE6, 0, 0x75, b"\0\0"),
        (0xC0, 0x84, 0, 0, 1),
        (0x21, 0x22, 0, 0, b""),
    ],
)
def test_anything_else_stalls(
    bench: Bench, request_type: int, request_number: int, value: int, index: int, length_or_data: int | bytes
) -> None:
    with pytest.raises(Stall):
        bench.flap.control_transfer(request_type, request_number, value, index, length_or_data)
