"""The fake RTD module against the plant's temperatures, and read by pymodbus through a gateway."""

from __future__ import annotations

import math
import struct

import pytest

from tests.sim.unit_bench import START_NS, UnitBench, gateway_master
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import RtuEngine, crc16
from thermostand.drivers.sim.units.thermometers import FakeThermometers
from thermostand.foundation.clock import FollowedClock, to_ns

CHANNELS = {"granite_inside": 0, "granite_outside": 1, "artifact": 2, "air": 3, "laboratory": 5}
UNCONNECTED = 4
LSB_K = 100 / 32767


class Bench(UnitBench):
    """A module in the plant."""

    def __init__(self, initial_degC: float = 30.0, seed: int = 7) -> None:
        self._seed = seed
        super().__init__(self._made, initial_degC)

    def _made(self, plant: Plant, clock: FollowedClock) -> FakeThermometers:
        self.module = FakeThermometers(plant, clock, 3, CHANNELS, self._seed)
        return self.module

    def words(self) -> tuple[int, ...]:
        return struct.unpack(">BB6h", self.reply("04 0000 0006"))[2:]

    def air_K(self, duration_s: float, count: int) -> list[float]:
        """What the air sensor reads wrong, `count` times, duration_s apart."""
        errors: list[float] = []
        for _ in range(count):
            self.wait(duration_s)
            errors.append(self.words()[CHANNELS["air"]] * LSB_K - self.plant.air_degC)
        return errors

    def faults(self) -> int:
        return self.reply("02 0080 0006")[2]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_every_sensor_reads_its_place_within_noise_and_resolution(bench: Bench) -> None:
    bench.module.open_channels = set()
    words = bench.words()
    for name, channel in CHANNELS.items():
        truth_degC = float(getattr(bench.plant, f"{name}_degC"))
        assert words[channel] * LSB_K == pytest.approx(truth_degC, abs=5 * 0.003 + LSB_K)
    assert words[CHANNELS["artifact"]] * LSB_K == pytest.approx(24.0, abs=0.02)


def test_a_channel_without_a_sensor_is_open(bench: Bench) -> None:
    assert bench.words()[UNCONNECTED] == 0x7FFF
    assert bench.faults() == 1 << UNCONNECTED


def test_below_zero_the_words_are_negative() -> None:
    assert Bench(initial_degC=-10.0).words()[3] * LSB_K == pytest.approx(-10.0, abs=0.02)


@pytest.mark.parametrize(
    ("code", "full_scale_degC"), [(0x20, 100), (0x21, 100), (0x22, 200), (0x23, 600), (0x2E, 200), (0x80, 600)]
)
def test_the_type_code_sets_the_scale_of_its_channel(bench: Bench, code: int, full_scale_degC: float) -> None:
    request = f"06 0103 {code:04X}"
    bench.done(request)
    assert bench.ask("03 0103 0001") == f"03 02 00 {code:02X}"
    words = bench.words()
    assert words[3] * full_scale_degC / 32767 == pytest.approx(30.0, abs=0.03)
    assert words[0] * LSB_K == pytest.approx(30.0, abs=0.02)


def test_over_and_under_range_have_their_own_words_and_bits(bench: Bench) -> None:
    bench.ask("06 0100 0021")
    bench.module.offset_K = {0: -31.0, 1: 80.0}
    words = bench.words()
    assert (words[0], words[1]) == (-0x8000, 0x7FFF)
    assert bench.faults() == 0b1_0011


def test_an_open_and_a_shorted_channel_leave_the_others_alone(bench: Bench) -> None:
    before = bench.words()
    bench.module.open_channels = {0}
    bench.module.shorted_channels = {2}
    after = bench.words()
    assert (after[0], after[2]) == (0x7FFF, -0x8000)
    assert [after[channel] for channel in (1, 3, 5)] == [before[channel] for channel in (1, 3, 5)]
    assert bench.faults() == 0b1_0101


def test_a_late_fault_bit_comes_one_poll_after_the_value(bench: Bench) -> None:
    bench.module.late_fault_bit = True
    bench.faults()
    bench.module.open_channels = {0}
    assert bench.words()[0] == 0x7FFF
    assert bench.faults() == 1 << UNCONNECTED
    assert bench.faults() == 1 << UNCONNECTED | 1


def test_noise_is_3_mK_and_without_bias(bench: Bench) -> None:
    errors_K = bench.air_K(0.5, 1000)
    mean_K = sum(errors_K) / 1000
    assert mean_K == pytest.approx(0.0, abs=4 * 0.003 / math.sqrt(1000))
    spread_K = math.sqrt(sum((each - mean_K) ** 2 for each in errors_K) / 999)
    assert spread_K == pytest.approx(math.hypot(0.003, LSB_K / math.sqrt(12)), rel=0.1)


def test_a_reading_does_not_depend_on_how_often_the_module_is_read() -> None:
    watched, left_alone, other_seed = Bench(), Bench(), Bench(seed=8)
    watched.air_K(0.3, 100)
    for bench in (left_alone, other_seed):
        bench.clock.follow(START_NS + to_ns(30.0))
    assert watched.words() == watched.words() == left_alone.words()
    assert other_seed.words() != left_alone.words()


def test_one_noisy_channel_leaves_the_others_quiet(bench: Bench) -> None:
    bench.module.noisy_channel = 3
    assert max(map(abs, bench.air_K(0.5, 50))) > 0.5
    assert bench.words()[5] * LSB_K == pytest.approx(24.0, abs=0.02)


def test_offset_and_drift_are_of_one_channel_and_in_simulated_hours(bench: Bench) -> None:
    bench.module.offset_K = {3: 0.5}
    assert bench.air_K(0.5, 1)[0] == pytest.approx(0.5, abs=0.02)
    bench.module.offset_K = {}
    bench.module.drift_K_per_h = {3: 0.1}
    assert bench.air_K(7200, 1)[0] == pytest.approx(0.2, abs=0.02)
    assert bench.words()[5] * LSB_K == pytest.approx(bench.plant.laboratory_degC, abs=0.02)


def test_the_engineering_format_loses_resolution(bench: Bench) -> None:
    assert bench.ask("05 010C FF00") == "05 01 0C FF 00"
    assert bench.ask("01 010C 0001") == "01 01 01"
    assert bench.words()[3] == pytest.approx(3000, abs=2)
    bench.ask("06 0103 0023")
    assert bench.words()[3] == 300
    bench.ask("05 010C 0000")
    assert bench.words()[0] * LSB_K == pytest.approx(30.0, abs=0.02)


def test_the_offset_register_counts_tenths(bench: Bench) -> None:
    before = bench.words()[3]
    bench.ask("06 01C3 FFFB")
    assert (bench.words()[3] - before) * LSB_K == pytest.approx(-0.5, abs=LSB_K)
    assert bench.ask("03 01C0 0006") == "03 0C 00 00 00 00 00 00 FF FB 00 00 00 00"


def test_it_gives_its_name_and_can_be_another_module(bench: Bench) -> None:
    request = bytes.fromhex("03 46 00")
    reply = RtuEngine([bench.module]).feed(request + crc16(request))
    assert reply[:-2] == bytes.fromhex("03 46 00 00 70 15 00")
    bench.module.name = bytes.fromhex("00 70 05 00")
    assert bench.ask("46 00") == "46 00 00 70 05 00"
    assert bench.ask("46 77") == "C6 01"


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
        ("10 0100 0001 02 0020", "90 01"),
        ("04 0000 0007", "84 02"),
        ("04 0006 0001", "84 02"),
        ("02 0086 0001", "82 02"),
        ("02 0000 0001", "82 02"),
        ("03 0104 0003", "83 02"),
        ("06 0000 0001", "86 02"),
        ("06 0100 0099", "86 03"),
        ("05 010C 5500", "85 03"),
        ("05 0000 FF00", "85 02"),
    ],
)
def test_what_the_module_does_not_have_is_refused(bench: Bench, request_hex: str, reply_hex: str) -> None:
    assert bench.ask(request_hex) == reply_hex


def test_a_silent_module_does_not_answer(bench: Bench) -> None:
    bench.module.silent = True
    assert bench.ask("04 0000 0006") is None


def test_an_unknown_sensor_or_channel_number_is_a_mistake_of_the_caller(bench: Bench) -> None:
    for channels in ({"air": -1}, {"air": 6}):
        with pytest.raises(ValueError, match="thermometer channels"):
            FakeThermometers(bench.plant, bench.clock, 3, channels, 1)


def test_pymodbus_reads_values_bits_and_type_codes_through_a_gateway(bench: Bench) -> None:
    with gateway_master([bench.module]) as client:
        registers = client.read_input_registers(0, count=6, device_id=3).registers
        assert registers[3] * LSB_K == pytest.approx(30.0, abs=0.02)
        assert client.read_discrete_inputs(0x80, count=6, device_id=3).bits[:6] == [False] * 4 + [True, False]
        assert not client.write_register(0x103, 0x2E, device_id=3).isError()
        types = client.read_holding_registers(0x100, count=6, device_id=3).registers
        assert types == [0x20] * 3 + [0x2E] + [0x20] * 2
