"""The fake E5CC, frame by frame, in the simulated chamber, and driven by pymodbus over a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from pymodbus.client import ModbusSerialClient

from tests.sim.unit_bench import START_NS, UnitBench, serial_master
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import RtuEngine
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.foundation.clock import FollowedClock, to_ns

RUN, STOP, WRITING_ON, RAM_MODE, BACKUP_MODE = 0x0100, 0x0101, 0x0001, 0x0401, 0x0400


class Bench(UnitBench):
    """A regulator in the chamber, its heater enabled."""

    def __init__(self, initial_degC: float = 24.0) -> None:
        super().__init__(self._made, initial_degC)
        self.plant.heater_enabled = True

    def _made(self, plant: Plant, clock: FollowedClock) -> FakeRegulator:
        self.regulator = FakeRegulator(plant, clock, 1)
        return self.regulator

    def command(self, value: int) -> None:
        self.done(f"06 0000 {value:04X}")

    def read(self, address: int) -> int:
        reply = self.reply(f"03 {address:04X} 0001")
        assert reply[:2] == b"\x03\x02"
        return int.from_bytes(reply[2:], "big", signed=True)

    def write(self, address: int, value: int) -> str | None:
        return self.ask(f"06 {address:04X} {value & 0xFFFF:04X}")

    def wait(self, duration_s: float) -> None:
        super().wait(duration_s)
        self.read(0x2000)

    def run_at(self, setpoint_degC: float) -> None:
        self.command(WRITING_ON)
        self.command(RAM_MODE)
        self.write(0x2103, round(setpoint_degC * 10))
        self.command(RUN)

    def high_bit(self, bit: int) -> bool:
        return bool(self.read(0x2407) >> bit & 1)

    def low_bit(self, bit: int) -> bool:
        return bool(self.read(0x2001) >> bit & 1)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_it_powers_up_stopped_in_backup_mode_with_writing_disabled(bench: Bench) -> None:
    assert bench.read(0x2407) == 1 << 8
    assert bench.read(0x2406) == bench.read(0x2001) == 0
    assert (bench.read(0x2004), bench.read(0x2005)) == (0, 0)
    assert bench.read(0x2410) == 1


def test_it_shows_the_probe_in_tenths_below_zero_too(bench: Bench) -> None:
    assert bench.read(0x2000) == 240
    assert Bench(initial_degC=-7.3).read(0x2000) == -73


def test_while_writing_is_disabled_everything_but_enabling_it_is_refused(bench: Bench) -> None:
    for request in ("06 2103 00FA", "10 2103 0001 02 00FA", f"06 0000 {RUN:04X}", f"06 0000 {RAM_MODE:04X}"):
        assert bench.ask(request) == f"{int(request[:2], 16) | 0x80:02X} 04"
    assert bench.read(0x2103) == 0
    assert bench.high_bit(8)
    bench.command(WRITING_ON)
    assert bench.high_bit(9)
    assert bench.write(0x2103, 250) == "06 21 03 00 FA"
    bench.command(0x0000)
    assert bench.write(0x2103, 260) == "86 04"


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
        ("04 2000 0001", "84 01"),
        ("03 3000 0001", "83 02"),
        ("06 2000 0001", "86 02"),
        ("10 2104 0004 08 0000 0000 0000 0000", "90 02"),
        ("03 2000 0069", "83 03"),
        ("03 2000 0000", "83 03"),
        ("10 2103 0001 04 00FA 00FA", "90 03"),
        ("06 2103 1389", "86 03"),  # 500.1 degC
        ("06 0000 0102", "86 03"),
        ("06 0000 7700", "86 03"),
        ("08 0001 1234", "88 03"),
        ("06 2C00 0002", "86 04"),  # input type: setup area 1
        ("08 0000 1234", "08 00 00 12 34"),
        ("06 FFFF 0001", "06 FF FF 00 01"),
    ],
)
def test_refusals_and_echoes_follow_the_manual(bench: Bench, request_hex: str, reply_hex: str) -> None:
    bench.command(WRITING_ON)
    assert bench.ask(request_hex) == reply_hex


def test_104_words_are_read_at_once_and_holes_read_as_zero(bench: Bench) -> None:
    reply = bench.reply("03 2000 0068")
    assert len(reply) == 2 + 2 * 104
    assert reply[2:4] == (240).to_bytes(2, "big")
    assert not any(reply[2 + 2 * 6 :])


def test_several_registers_are_written_all_or_none(bench: Bench) -> None:
    bench.command(WRITING_ON)
    assert bench.ask("10 2A00 0003 06 0028 00C8 000F") == "10 2A 00 00 03"
    assert [bench.read(address) for address in (0x2A00, 0x2A01, 0x2A02)] == [40, 200, 15]
    assert bench.ask("10 2A00 0003 06 0050 0064 7FFF") == "90 03"
    assert [bench.read(address) for address in (0x2A00, 0x2A01, 0x2A02)] == [40, 200, 15]


def test_sp0_is_the_set_point(bench: Bench) -> None:
    bench.command(WRITING_ON)
    bench.write(0x2900, -55)
    assert bench.read(0x2103) == bench.read(0x2002) == -55


def test_the_control_period_is_written_only_while_stopped(bench: Bench) -> None:
    bench.command(WRITING_ON)
    assert bench.write(0x2708, -2) == "06 27 08 FF FE"
    bench.command(RUN)
    assert bench.write(0x2708, 2) == "86 04"
    assert bench.read(0x2708) == -2


def test_backup_mode_wears_the_eeprom_and_ram_mode_does_not(bench: Bench) -> None:
    bench.command(WRITING_ON)
    bench.write(0x2103, 250)
    bench.ask("10 2A00 0002 04 0028 00C8")
    assert bench.regulator.eeprom_writes == 3
    bench.command(RAM_MODE)
    assert bench.high_bit(4)
    assert not bench.high_bit(5)
    for tenths in range(250, 300):
        bench.write(0x2103, tenths)
    assert bench.regulator.eeprom_writes == 3
    assert bench.high_bit(5)
    bench.command(0x0500)
    assert bench.regulator.eeprom_writes == 4
    assert not bench.high_bit(5)


def test_a_power_cycle_loses_ram_values_ram_mode_and_writing_and_stops(bench: Bench) -> None:
    bench.command(WRITING_ON)
    bench.write(0x2103, 250)
    bench.command(RAM_MODE)
    bench.write(0x2103, 300)
    bench.command(RUN)
    bench.wait(10)
    assert bench.read(0x2004) > 0
    bench.regulator.power_cycle()
    assert bench.read(0x2103) == 250
    assert bench.read(0x2407) == 1 << 8
    assert bench.read(0x2004) == 0


def test_a_software_reset_is_not_answered_and_acts_like_a_power_cycle(bench: Bench) -> None:
    bench.run_at(30.0)
    assert bench.ask("06 0000 0600") is None
    assert bench.read(0x2407) == 1 << 8
    assert bench.read(0x2103) == 0


def test_parameter_initialization_throws_it_off_modbus(bench: Bench) -> None:
    bench.command(WRITING_ON)
    bench.command(0x0B00)
    assert bench.ask("03 2000 0001") is None
    bench.regulator.compoway = False
    assert bench.read(0x2000) == 240


def test_a_step_of_4_K_settles_within_tenths_and_overshoots_less_than_1_K() -> None:
    bench = Bench(initial_degC=24.0)
    bench.run_at(30.0)
    bench.wait(3600)
    bench.write(0x2103, 340)
    temperatures: list[float] = []
    bench.plant.on_step.append(lambda *_: temperatures.append(bench.plant.chamber_degC))
    bench.wait(3600)
    assert max(temperatures) < 34.2
    assert all(abs(each - 34.0) < 0.1 for each in temperatures[2 * 900 :])
    settled = temperatures[2 * 2400 :]
    assert max(settled) - min(settled) < 0.05
    assert 0 < bench.read(0x2004) < 300
    assert bench.read(0x2005) == 0


def test_the_heater_conducts_as_long_as_the_output_says(bench: Bench) -> None:
    """A manual output of 30 % in periods of 2 s, over the plant's own steps."""
    bench.command(WRITING_ON)
    bench.command(RUN)
    bench.regulator.press_manual(30.0)
    fractions: list[float] = []
    bench.plant.on_step.append(lambda *_: fractions.append(bench.plant.heater_on_fraction))
    bench.wait(20)
    assert sum(fractions) / len(fractions) == pytest.approx(0.3)
    assert sorted(set(fractions)) == pytest.approx([0.0, 0.2, 1.0])
    lit = 0
    for _ in range(40):
        lit += bench.low_bit(8)
        bench.wait(0.1)
    assert lit == 12


def test_what_it_does_does_not_depend_on_how_often_it_is_read() -> None:
    watched, left_alone = Bench(), Bench()
    for bench in (watched, left_alone):
        bench.run_at(35.0)
    for _ in range(700):
        watched.wait(0.7)
    left_alone.wait(490)
    assert watched.plant.chamber_degC == left_alone.plant.chamber_degC
    assert watched.regulator.outputs == left_alone.regulator.outputs


def test_above_the_set_point_it_asks_for_cooling_in_its_own_register(bench: Bench) -> None:
    bench.run_at(10.0)
    bench.wait(60)
    assert bench.read(0x2005) == 1000
    assert bench.read(0x2004) == 0
    assert bench.plant.heater_on_fraction == 0.0


def test_the_output_limits_are_obeyed(bench: Bench) -> None:
    bench.command(WRITING_ON)
    bench.write(0x2A05, 450)
    bench.write(0x2A06, -200)
    bench.run_at(60.0)
    bench.wait(30)
    assert bench.read(0x2004) == 450
    bench.write(0x2103, 0)
    bench.wait(600)
    assert bench.read(0x2005) == 200


def test_stop_takes_the_output_away_at_once(bench: Bench) -> None:
    bench.run_at(60.0)
    bench.wait(10)
    assert bench.read(0x2004) == 1000
    bench.command(STOP)
    assert bench.read(0x2004) == 0
    assert bench.high_bit(8)
    bench.wait(1)
    assert bench.plant.heater_on_fraction == 0.0


@pytest.mark.parametrize(("fault", "bit"), [("sensor_break", 6), ("ad_error", 2)])
def test_a_broken_input_sets_its_bit_and_the_output_at_error(bench: Bench, fault: str, bit: int) -> None:
    bench.run_at(60.0)
    bench.wait(10)
    setattr(bench.regulator, fault, True)
    bench.wait(1)
    assert bench.low_bit(bit)
    assert bench.read(0x2004) == 0
    assert not bench.high_bit(8)
    bench.write(0x2711, 100)
    bench.wait(1)
    assert bench.read(0x2004) == 100
    setattr(bench.regulator, fault, False)
    bench.wait(1)
    assert not bench.low_bit(bit)
    assert bench.read(0x2004) == 1000


def test_a_broken_sensor_reads_as_the_top_of_the_range(bench: Bench) -> None:
    bench.regulator.sensor_break = True
    assert bench.read(0x2000) == 5000


def test_keys_work_without_communications_writing(bench: Bench) -> None:
    bench.run_at(60.0)
    bench.command(0x0000)
    bench.regulator.press_setpoint(31.5)
    assert bench.read(0x2103) == 315
    assert bench.regulator.eeprom_writes == 1
    bench.regulator.press_manual(12.5)
    bench.wait(5)
    assert bench.high_bit(10)
    assert bench.read(0x2004) == 125
    bench.regulator.press_automatic()
    bench.wait(0.5)
    assert not bench.high_bit(10)
    assert bench.read(0x2004) == pytest.approx(125, abs=15)
    bench.regulator.press_stop()
    assert bench.high_bit(8)


def test_manual_by_command_keeps_the_output(bench: Bench) -> None:
    bench.run_at(25.0)
    bench.wait(5)
    output = bench.read(0x2004)
    assert 0 < output < 1000
    bench.command(0x0901)
    bench.wait(300)
    assert bench.read(0x2004) == output
    bench.command(0x0900)
    assert not bench.high_bit(10)


def test_while_it_tunes_itself_writes_are_refused(bench: Bench) -> None:
    bench.command(WRITING_ON)
    assert bench.ask("06 0000 0301") == "86 04"  # stopped
    bench.command(RUN)
    bench.command(0x0301)
    assert bench.high_bit(7)
    assert bench.write(0x2103, 250) == "86 04"
    bench.command(0x0300)
    assert bench.write(0x2103, 250) == "06 21 03 00 FA"


def test_another_decimal_point_scales_everything_in_degrees(bench: Bench) -> None:
    bench.command(WRITING_ON)
    bench.write(0x2103, 250)
    bench.regulator.display_decimals = 0
    assert (bench.read(0x2410), bench.read(0x2000), bench.read(0x2103)) == (0, 24, 25)


def test_faults_of_the_probe_and_of_the_set_point_show_on_the_wire(bench: Bench) -> None:
    bench.run_at(30.0)
    bench.regulator.pv_offset_K = 1.5
    assert bench.read(0x2000) == 255
    bench.regulator.stuck_pv_degC = 21.0
    bench.wait(600)
    assert bench.read(0x2000) == 210
    bench.regulator.setpoint_clamp_degC = (5.0, 40.0)
    assert bench.write(0x2103, 600) == "06 21 03 02 58"
    assert bench.read(0x2103) == 400
    bench.regulator.silent = True
    assert bench.ask("03 2000 0001") is None


@pytest.fixture
def client(bench: Bench, tmp_path: Path) -> Iterator[ModbusSerialClient]:
    with serial_master(tmp_path / "bus", [bench.regulator]) as client:
        yield client


def test_pymodbus_starts_it_up_and_heats_the_chamber(bench: Bench, client: ModbusSerialClient) -> None:
    assert client.read_holding_registers(0x2410, count=1, device_id=1).registers == [1]
    refused = client.write_register(0x2103, 300, device_id=1)
    assert (refused.isError(), refused.exception_code) == (True, 4)
    for value in (WRITING_ON, RAM_MODE):
        assert not client.write_register(0, value, device_id=1).isError()
    assert client.read_holding_registers(0x2407, count=1, device_id=1).registers == [1 << 9 | 1 << 8 | 1 << 4]
    assert not client.write_registers(0x2103, [300], device_id=1).isError()
    assert not client.write_register(0, RUN, device_id=1).isError()
    bench.clock.follow(START_NS + to_ns(1800))
    pv, _, internal_sp, _, mv_heat, mv_cool = client.read_holding_registers(0x2000, count=6, device_id=1).registers
    assert pv == pytest.approx(300, abs=2)
    assert (internal_sp, mv_cool) == (300, 0)
    assert mv_heat > 0
    assert client.diag_query_data(b"\x12\x34", device_id=1).message == b"\x12\x34"


def test_the_stop_frame_of_the_manual_gets_the_reply_of_the_manual(bench: Bench) -> None:
    bench.run_at(30.0)
    frame = bytes.fromhex("01 06 00 00 01 01 49 9A")
    assert RtuEngine([bench.regulator]).feed(frame) == frame
    assert bench.high_bit(8)
