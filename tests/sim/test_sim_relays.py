"""The fake relay board, frame by frame, and read by pymodbus over a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sim.unit_bench import START_NS, UnitBench, serial_master
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import RtuEngine
from thermostand.drivers.sim.units.relays import FakeRelays
from thermostand.foundation.clock import FollowedClock, to_ns

HEATER, COMPRESSOR, CAMERA = 0, 2, 5
CHANNELS = {"heater_enable": HEATER, "compressor": COMPRESSOR, "camera_power": CAMERA}
ARM_15_S = f"05 02{HEATER:02X} 0096"


class Bench(UnitBench):
    """A board in the plant."""

    def __init__(self) -> None:
        super().__init__(self._made)

    def _made(self, plant: Plant, clock: FollowedClock) -> FakeRelays:
        self.board = FakeRelays(plant, clock, 1, CHANNELS)
        return self.board

    def coils(self) -> int:
        return self.reply("01 0000 0008")[2]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_all_relays_are_open_at_power_up(bench: Bench) -> None:
    assert bench.coils() == 0
    assert not bench.plant.heater_enabled
    assert not bench.plant.compressor_on
    assert not bench.plant.camera_powered


def test_the_inputs_are_read_by_function_2(bench: Bench) -> None:
    bench.board.closed_inputs = {0, 2, 7}
    assert bench.ask("02 0000 0008") == "02 01 85"
    assert bench.ask("02 0002 0001") == "02 01 01"
    assert bench.ask("02 0001 0008") == "82 02"


def test_the_frame_of_the_manual_closes_relay_0_and_enables_the_heater(bench: Bench) -> None:
    frame = bytes.fromhex("01 05 00 00 FF 00 8C 3A")
    assert RtuEngine([bench.board]).feed(frame) == frame
    assert bench.coils() == 1 << HEATER
    assert bench.plant.heater_enabled


@pytest.mark.parametrize(
    ("relay", "attribute"), [(HEATER, "heater_enabled"), (COMPRESSOR, "compressor_on"), (CAMERA, "camera_powered")]
)
def test_each_relay_switches_its_contact_on_and_off(bench: Bench, relay: int, attribute: str) -> None:
    bench.done(f"05 00{relay:02X} FF00")
    assert bench.coils() == 1 << relay
    assert getattr(bench.plant, attribute)
    bench.done(f"05 00{relay:02X} 0000")
    assert bench.coils() == 0
    assert not getattr(bench.plant, attribute)


def test_toggle_all_and_several_coils(bench: Bench) -> None:
    bench.done("05 0001 5500")
    assert bench.coils() == 0b10
    bench.done("05 00FF 5500")
    assert bench.coils() == 0b1111_1101
    bench.done("05 00FF FF00")
    assert bench.coils() == 0xFF
    bench.done("05 00FF 0000")
    assert bench.coils() == 0
    assert bench.ask("0F 0002 0004 01 0D") == "0F 00 02 00 04"
    assert bench.coils() == 0b11_0100
    assert bench.ask("01 0002 0003") == "01 01 05"


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
        ("02 0000 0008", "82 01"),
        ("01 0000 0009", "81 02"),
        ("05 0008 FF00", "85 02"),
        ("05 0208 0007", "85 02"),
        ("05 0300 0007", "85 02"),
        ("05 0000 1234", "85 03"),
        ("05 0200 0000", "85 03"),
        ("05 0200 8000", "85 03"),
        ("0F 0006 0003 01 07", "8F 02"),
        ("03 0000 0001", "83 02"),
        ("06 8000 0001", "86 02"),
        ("06 4000 0100", "86 03"),
    ],
)
def test_what_the_board_does_not_have_is_refused_and_nothing_moves(
    bench: Bench, request_hex: str, reply_hex: str
) -> None:
    assert bench.ask(request_hex) == reply_hex
    assert bench.coils() == 0


def test_a_timed_on_of_value_7_lasts_700_ms(bench: Bench) -> None:
    bench.done(f"05 02{COMPRESSOR:02X} 0007")
    bench.wait(0.699)
    assert bench.coils() == 1 << COMPRESSOR
    bench.wait(0.001)
    assert bench.coils() == 0


def test_a_timed_off_opens_and_closes_again(bench: Bench) -> None:
    bench.done(f"05 04{CAMERA:02X} 0014")
    assert bench.coils() == 0
    bench.wait(2.0)
    assert bench.coils() == 1 << CAMERA


def test_the_dead_man_holds_while_rearmed_and_drops_15_s_after_the_last_time(bench: Bench) -> None:
    for _ in range(6):
        bench.done(ARM_15_S)
        bench.wait(5.0)
        assert bench.coils() == 1 << HEATER
    bench.wait(9.9)
    assert bench.board.closed("heater_enable")
    bench.wait(0.1)
    assert not bench.board.closed("heater_enable")


def test_the_dead_man_drops_in_the_plant_though_nobody_asks_the_board(bench: Bench) -> None:
    bench.done(ARM_15_S)
    bench.plant.advance(START_NS + to_ns(15.0))
    assert bench.plant.heater_enabled  # the step that began before the end is over, the next has not begun
    bench.plant.advance(START_NS + to_ns(15.5))
    assert not bench.plant.heater_enabled


def test_a_plain_on_ends_a_running_time(bench: Bench) -> None:
    bench.done(ARM_15_S)
    bench.done("05 0000 FF00")
    bench.wait(100)
    assert bench.coils() == 1 << HEATER


def test_reading_the_coils_does_not_change_what_the_plant_sees() -> None:
    watched, left_alone = Bench(), Bench()
    for bench in (watched, left_alone):
        bench.plant.heater_on_fraction = 1.0
        bench.done("05 0200 0067")  # 10.3 s, inside a step of the plant
    for _ in range(120):
        watched.wait(0.1)
        watched.coils()
    left_alone.wait(12.0)
    left_alone.coils()
    assert watched.plant.state() == left_alone.plant.state()


def test_the_faults_of_a_board_show(bench: Bench) -> None:
    bench.board.lost_writes = True
    bench.done("05 0000 FF00")
    assert bench.coils() == 0
    bench.board.lost_writes = False
    bench.board.welded = {"heater_enable"}
    bench.done("05 0000 0000")
    assert bench.coils() == 0
    assert bench.plant.heater_enabled
    bench.board.welded = set()
    bench.board.rearms = False
    bench.done(ARM_15_S)
    bench.wait(10)
    bench.done(ARM_15_S)
    bench.wait(5)
    assert bench.coils() == 0
    bench.done(ARM_15_S)
    assert bench.coils() == 1
    bench.board.power_cycle()
    assert bench.coils() == 0
    bench.board.silent = True
    assert bench.ask("01 0000 0008") is None


def test_version_and_address_registers(bench: Bench) -> None:
    assert bench.ask("03 8000 0001") == "03 02 00 C8"
    assert bench.ask("03 4000 0001") == "03 02 00 01"
    bench.done("06 4000 0009")
    frame = RtuEngine([bench.board]).feed(bytes.fromhex("09 01 00 00 00 08 3C 84"))
    assert frame[:4] == bytes.fromhex("09 01 01 00")


def test_an_unknown_contact_or_relay_number_is_a_mistake_of_the_caller() -> None:
    plant, clock = Plant(PlantSpec(), START_NS), FollowedClock(START_NS)
    for channels in ({"kettle": 0}, {"compressor": 8}):
        with pytest.raises(ValueError, match="relay channels"):
            FakeRelays(plant, clock, 1, channels)


def test_pymodbus_switches_and_reads_back_over_a_pseudo_terminal(bench: Bench, tmp_path: Path) -> None:
    with serial_master(tmp_path / "bus", [bench.board]) as client:
        assert not client.write_coil(CAMERA, True, device_id=1).isError()
        assert not client.write_coils(0, [True, False, True], device_id=1).isError()
        expected = [True, False, True, False, False, True, False, False]
        assert client.read_coils(0, count=8, device_id=1).bits == expected
        assert client.read_holding_registers(0x8000, count=1, device_id=1).registers == [200]
