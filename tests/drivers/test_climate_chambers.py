"""Climate chambers of five makes over their wires: what they are asked, and each fault that the fact sheets name."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from drivers.devices.chambers.chamber_ascii2 import number, parse
from drivers.devices.chambers.chamber_cts import framed, unframed
from drivers.devices.chambers.chamber_settings import ChamberUnitSettings, ClimateChamberSettings
from drivers.devices.chambers.chamber_simserv import reply_of
from drivers.devices.chambers.climate_chamber import ClimateChamber
from drivers.sim.faults import LinkFaults
from drivers.sim.physics.plant import Plant, PlantSpec
from drivers.sim.units.climate_chambers import FakeClimateChamber, FakeCts, FakeEspec, FakeWeiss
from drivers.sim.units.julabo_circulator import FakeJulabo
from drivers.sim.units.simserv_chamber import FakeSimserv
from drivers.sim.wire import PtyWire, TcpWire
from foundation.clock import FollowedClock, WallClock, seconds_ns
from foundation.errors import DeviceError, DeviceFault, GarbledReply, Refused, Unreachable
from foundation.readings import Quality, Reading

START_NS = 1_700_000_000_000_000_000
ALLOWED_DEGC = (-10.0, 60.0)
MAKES = ("espec", "cts", "ascii2", "simserv", "julabo")
WIRES = ("tcp", "serial")
ON_WIRES = [(make, wire) for make in MAKES for wire in WIRES if (make, wire) != ("simserv", "serial")]
SETTINGS: TypeAdapter[ChamberUnitSettings] = TypeAdapter(ClimateChamberSettings)


class Bench:
    """A chamber of one make on its wire, the plant behind it, and its driver."""

    def __init__(self, make: str, wire: str, folder: Path, **settings: object) -> None:
        self.plant = Plant(PlantSpec(laboratory_swing_K=0.0), START_NS)
        self.clock = FollowedClock(START_NS)
        self.faults = LinkFaults(seed=5)
        self.fake = self._fake(make, wire)
        self.fake.limits_degC = ALLOWED_DEGC
        self.line: PtyWire | TcpWire = (
            PtyWire(folder / make, self.fake.engine(), self.faults)
            if wire == "serial"
            else TcpWire("127.0.0.1", 0, self.fake.engine, self.faults)
        )
        known: dict[str, object] = {"protocol": make, "address": self.line.address, "timeout_s": 0.3, "gap_s": 0.0}
        if make not in ("espec", "simserv"):
            known["limits_at_panel_degC"] = list(ALLOWED_DEGC)
        if make in ("cts", "julabo"):
            known["parity"] = "N"  # a pseudo-terminal knows none
        if make == "simserv":
            known["off_channels"] = [2]
        self.driver = ClimateChamber(
            "regulator", SETTINGS.validate_python({**known, **settings}), ALLOWED_DEGC, WallClock()
        )

    def _fake(self, make: str, wire: str) -> FakeClimateChamber:
        if make == "espec":
            return FakeEspec(self.plant, self.clock)
        if make == "cts":
            return FakeCts(self.plant, self.clock, is_serial=wire == "serial")
        if make == "simserv":
            return FakeSimserv(self.plant, self.clock)
        if make == "julabo":
            return FakeJulabo(self.plant, self.clock)
        return FakeWeiss(self.plant, self.clock)

    def wait(self, duration_s: float) -> None:
        self.clock.follow(self.clock.now_ns() + seconds_ns(duration_s))
        with self.fake.now():
            pass

    async def read(self) -> dict[str, Reading]:
        return {reading.channel.removeprefix("regulator."): reading for reading in await self.driver.read()}


@asynccontextmanager
async def bench_of(make: str, wire: str, folder: Path, **settings: object) -> AsyncGenerator[Any]:
    bench = Bench(make, wire, folder, **settings)
    try:
        yield bench
    finally:
        await bench.driver.close()
        bench.line.close()


@pytest.mark.parametrize(("make", "wire"), ON_WIRES)
async def test_it_goes_to_its_set_point_and_stops(make: str, wire: str, tmp_path: Path):
    async with bench_of(make, wire, tmp_path) as bench:
        await bench.driver.open()
        await bench.driver.stop()
        for target_degC in (45.0, -5.0):
            await bench.driver.set_temperature(target_degC)
            await bench.driver.run()
            for _ in range(200):
                bench.wait(60.0)
            found = await bench.read()
            assert found["pv"].value == pytest.approx(target_degC, abs=3.0)
            assert found["sp"].value == target_degC
            assert (found["running"].value, found["fault"].reason) == (1, "")
        await bench.driver.make_safe()
        assert (await bench.read())["running"].value == 0
        bench.wait(60.0)
        assert (bench.plant.heater_on_fraction, bench.plant.compressor_on) == (0, False)


@pytest.mark.parametrize("make", MAKES)
async def test_a_set_point_is_written_when_it_changes_and_never_outside_what_is_allowed(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        for _ in range(5):
            await bench.driver.set_temperature(30.0)
        assert bench.fake.setpoint_writes == 1
        with pytest.raises(Refused, match=r"70 degC is outside -10\.\.60 degC; nothing was sent"):
            await bench.driver.set_temperature(70.0)
        assert bench.fake.setpoint_writes == 1


# The rows of faults, each for the makes that can have it.


@pytest.mark.parametrize("make", MAKES)
async def test_a_write_without_effect_is_reported_and_not_repeated(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.ignores_writes = True
        with pytest.raises(Refused, match="not in control: the set-point 30 degC had no effect"):
            await bench.driver.set_temperature(30.0)
        with pytest.raises(DeviceFault, match=r"not in control: it did not start; is remote control"):
            await bench.driver.run()
        assert (await bench.read())["pv"].value == pytest.approx(24.0, abs=2)  # it is watched all the same


async def test_a_panel_that_protects_is_reported_with_what_to_do_and_watched_all_the_same(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.protected = True
        with pytest.raises(Refused, match=r"PROTECT ON; the panel's protection is on"):
            await bench.driver.set_temperature(30.0)
        assert (await bench.read())["fault"].value == 0


@pytest.mark.parametrize("make", MAKES)
async def test_what_was_changed_at_the_panel_is_reported_with_both_values_and_left(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        await bench.driver.run()
        bench.fake.press_setpoint(50.0)
        found = await bench.read()
        assert found["fault"].reason == "set point changed at the unit, from 30 to 50 degC"
        assert bench.fake.setpoint_degC == 50.0
        bench.fake.press_setpoint(30.0)
        bench.fake.press_stop()
        found = await bench.read()
        assert (found["running"].value, found["fault"].value) == (0, 0)
        assert not bench.fake.running


@pytest.mark.parametrize(
    ("make", "code", "said"),
    [
        ("espec", "5", "alarm 5"),
        ("cts", "33", "error 33"),
        ("simserv", "5", "alarm 5"),
        ("julabo", "01 LOW LEVEL ALARM", "-01 LOW LEVEL ALARM"),
    ],
)
async def test_a_latched_alarm_is_reported_and_nothing_is_started_until_it_is_reset(
    make: str, code: str, said: str, tmp_path: Path
):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.alarm = code
        assert (await bench.read())["fault"].reason == said
        with pytest.raises(DeviceFault, match=f"{said}; look at the chamber"):
            await bench.driver.run()
        assert not bench.fake.running
        bench.fake.alarm = ""
        await bench.driver.run()


@pytest.mark.parametrize("make", ["cts", "ascii2", "simserv", "julabo"])
async def test_a_set_point_that_is_clamped_is_refused_by_what_it_reads(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.limits_degC, bench.fake.clamps = (0.0, 35.0), True
        with pytest.raises(Refused, match=r"set to 50 degC, it reads 35 degC: clamped by the unit"):
            await bench.driver.set_temperature(50.0)


@pytest.mark.parametrize(
    ("make", "said"),
    [("espec", "DATA OUT OF RANGE"), ("simserv", "does not take these parameters"), ("julabo", "VALUE TOO LARGE")],
)
async def test_a_set_point_that_the_unit_refuses_is_reported_in_its_words(make: str, said: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.limits_degC = (0.0, 35.0)
        with pytest.raises(Refused, match=said):
            await bench.driver.set_temperature(50.0)


async def test_a_set_point_that_moves_in_a_ramp_is_no_change_at_the_panel(tmp_path: Path):
    async with bench_of("ascii2", "tcp", tmp_path, shows_ramp=True) as bench:
        await bench.driver.open()
        bench.fake.ramp_K_per_min = 1.0
        await bench.driver.set_temperature(40.0)
        await bench.driver.run()
        for _ in range(10):
            bench.wait(60.0)
            found = await bench.read()
            assert (found["sp"].value, found["fault"].reason) == (40.0, "")
        bench.wait(1200.0)
        assert (await bench.read())["pv"].value == pytest.approx(
            40.0, abs=3.0
        )  # not where the ramp was when it started
        bench.fake.press_setpoint(10.0)
        bench.wait(2400.0)
        assert "set point changed at the unit" in (await bench.read())["fault"].reason


async def test_a_set_point_that_a_ramp_passes_on_its_way_elsewhere_is_sent_all_the_same(tmp_path: Path):
    async with bench_of("ascii2", "tcp", tmp_path, shows_ramp=True) as bench:
        await bench.driver.open()
        bench.fake.ramp_K_per_min = 1.0
        await bench.driver.set_temperature(50.0)
        bench.wait(7 * 60.0)
        passed_degC = float(f"{bench.fake._nominal_degC():.1f}")
        await bench.driver.set_temperature(passed_degC)
        bench.wait(1800.0)
        assert (await bench.read())["sp"].value == passed_degC
        assert bench.fake.setpoint_degC == passed_degC


async def test_a_circulator_that_is_operated_by_hand_is_not_used_and_the_panel_action_is_named(tmp_path: Path):
    async with bench_of("julabo", "tcp", tmp_path) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        bench.fake.remote = False
        for call in (bench.driver.set_temperature(40.0), bench.driver.run()):
            with pytest.raises(Refused, match=r"operated by hand: choose remote control \(RS232, USB\) at its panel"):
                await call
        assert (bench.fake.setpoint_degC, bench.fake.running) == (30.0, False)
        bench.fake.remote = True
        await bench.driver.run()
        bench.fake.remote = False
        assert "operated by hand" in (await bench.read())["fault"].reason
        with pytest.raises(DeviceError, match="operated by hand"):
            await bench.driver.make_safe()


async def test_a_circulator_says_what_it_did_not_take_and_that_is_no_alarm(tmp_path: Path):
    async with bench_of("julabo", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake._message = "-08 INVALID COMMAND"  # of another program before us
        assert (await bench.read())["fault"].value == 0


async def test_a_chamber_in_a_program_of_its_own_is_not_started(tmp_path: Path):
    async with bench_of("simserv", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.in_program = True
        assert (await bench.read())["fault"].reason == "a program of its own runs"
        with pytest.raises(DeviceFault, match="a program of its own runs; end it at the panel"):
            await bench.driver.run()


async def test_a_temperature_that_looks_like_a_code_is_a_temperature(tmp_path: Path):
    assert reply_of(b"1\xb6-5\r\n") == ("1", ["-5"])
    assert reply_of(b"-5\r\n") == ("-5", [])
    assert [reply_of(b"1\xb624.98\r\n"[:length]) for length in range(8)] == [None] * 8
    for wrong in (b"24.98\r\n", b"-5\xb61\r\n", b"\r\n"):
        with pytest.raises(ValueError, match="expected"):
            reply_of(wrong)
    async with bench_of("simserv", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.stuck_degC = -5.0
        assert (await bench.read())["pv"].value == -5.0


async def test_a_mode_that_is_missing_from_a_reply_is_no_reply(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.mode = " "
        with pytest.raises(GarbledReply, match="unknown mode"):
            await bench.driver.read()


async def test_a_cts_that_is_paused_at_its_panel_says_so_and_is_not_started(tmp_path: Path):
    async with bench_of("cts", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.paused = True
        assert "paused" in (await bench.read())["fault"].reason
        with pytest.raises(DeviceFault, match="paused"):
            await bench.driver.run()


async def test_a_reply_of_another_address_is_discarded(tmp_path: Path):
    async with bench_of("cts", "serial", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.answers_as = 7
        with pytest.raises(GarbledReply, match="unit 7 has answered, not 1"):
            await bench.driver.read()
        bench.fake.answers_as = 1
        assert (await bench.read())["pv"].value == pytest.approx(24.0, abs=2)


@pytest.mark.parametrize(("make", "wire"), ON_WIRES)
async def test_a_late_reply_is_never_taken_for_the_next_one(make: str, wire: str, tmp_path: Path):
    async with bench_of(make, wire, tmp_path) as bench:
        await bench.driver.open()
        for value_degC in (30.0, 35.0, 40.0):
            bench.faults.late_s = 0.33  # after the time-out, within the quarantine
            bench.fake.stuck_degC = value_degC - 1
            with pytest.raises(DeviceError) if wire == "tcp" else _nothing():
                await bench.driver.read()
            bench.fake.stuck_degC = value_degC
            assert (await bench.read())["pv"].value == value_degC


class _nothing:
    def __enter__(self) -> None: ...

    def __exit__(self, *error: object) -> None: ...


@pytest.mark.parametrize(("make", "wire"), ON_WIRES)
async def test_among_hundreds_of_reads_with_faults_no_temperature_is_wrong(make: str, wire: str, tmp_path: Path):
    """ASCII-2 and ESPEC have no checksum: no bit flips, which nothing could find; lost, cut and late replies are."""
    async with bench_of(make, wire, tmp_path, timeout_s=0.05) as bench:
        await bench.driver.open()
        faults = bench.faults
        faults.drop = faults.cut = faults.late = 0.01
        faults.late_by_s = 0.08
        read = 0
        for number_ in range(120):
            bench.fake.stuck_degC = 20.0 + number_ / 10
            try:
                found = await bench.read()
            except DeviceError:
                continue
            read += 1
            assert found["pv"].value == pytest.approx(bench.fake.stuck_degC, abs=0.051)
        assert read > 80


@pytest.mark.parametrize("make", MAKES)
async def test_one_whose_connection_another_program_has_is_unreachable_and_back_when_it_lets_go(
    make: str, tmp_path: Path
):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.silent = True  # open, and silent
        with pytest.raises(Unreachable, match="no reply"):
            await bench.driver.read()
        bench.fake.silent = False
        assert (await bench.read())["fault"].value == 0
        bench.line.unplug()  # refused
        with pytest.raises(Unreachable):
            await bench.driver.read()
        bench.line.plug()
        assert (await bench.read())["fault"].value == 0


@pytest.mark.parametrize("make", MAKES)
async def test_one_that_restarted_stopped_is_reported_and_not_started_by_itself(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        await bench.driver.run()
        bench.fake.restart()
        for _ in range(3):
            assert (await bench.read())["running"].value == 0
        assert not bench.fake.running


@pytest.mark.parametrize("make", MAKES)
async def test_one_that_restarted_running_at_its_old_set_point_is_reported_and_left(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        await bench.driver.run()
        bench.fake.restart(running_at_degC=55.0)
        for _ in range(2):
            found = await bench.read()
        assert (found["running"].value, found["sp"].value) == (1, 55)
        assert found["fault"].reason == "set point changed at the unit, from 30 to 55 degC"
        assert bench.fake.setpoint_degC == 55


@pytest.mark.parametrize("wire", WIRES)
async def test_an_open_door_flags_what_is_measured_and_is_a_fault_while_it_controls(wire: str, tmp_path: Path):
    async with bench_of("cts", wire, tmp_path, door_reply=9) as bench:
        await bench.driver.open()
        await bench.driver.run()
        assert (await bench.read())["fault"].reason == ""
        bench.fake.door_open = True
        found = await bench.read()
        assert (found["pv"].quality, found["pv"].reason) == (Quality.GOOD, "the door is open")
        assert found["fault"].reason == "the door is open"
        bench.fake.door_open = False
        assert (await bench.read())["pv"].reason == ""


@pytest.mark.parametrize("make", ["espec", "ascii2", "simserv"])
async def test_humidity_that_is_on_from_before_is_switched_off_at_each_start_and_watched(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        bench.fake.humidity_on = True
        await bench.driver.open()
        await bench.driver.run()
        assert not bench.fake.humidity_on
        bench.fake.humidity_on = True
        assert (await bench.read())["fault"].reason == "humidity is on"


async def test_humidity_that_only_the_panel_can_switch_off_keeps_it_from_starting(tmp_path: Path):
    async with bench_of("cts", "tcp", tmp_path) as bench:
        bench.fake.humidity_on = True
        await bench.driver.open()
        with pytest.raises(Refused, match="can only be switched off at the panel"):
            await bench.driver.run()
        assert not bench.fake.running


async def test_a_unit_of_another_identity_is_not_used_also_after_a_loss(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path, identity="T,T,S9") as bench:
        with pytest.raises(DeviceFault, match=r"it says that it is 'T,T,S2,160.0', not 'T,T,S9'; not used"):
            await bench.driver.open()
        with pytest.raises(DeviceFault, match="not used"):
            await bench.driver.set_temperature(30.0)
        assert bench.fake.setpoint_writes == 0


async def test_another_chamber_that_answers_after_a_loss_gets_no_command(tmp_path: Path):
    async with bench_of("simserv", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.line.unplug()
        with pytest.raises(Unreachable):
            await bench.driver.read()
        bench.fake.serial_number = "58226999990010"
        bench.line.plug()
        for call in (bench.driver.set_temperature(40.0), bench.driver.run(), bench.driver.read()):
            with pytest.raises(DeviceFault, match=r"exchanged: .*58226999990010 answers where .*58226123450010"):
                await call
        assert (bench.fake.setpoint_writes, bench.fake.running) == (0, False)


# What keeps it safe when the computer dies.


async def test_a_controller_that_allows_more_than_the_stand_is_refused(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path) as bench:
        bench.fake.limits_degC = (-40.0, 140.0)
        with pytest.raises(
            DeviceFault, match=r"allows set-points of -40\.\.140 degC, the stand -10\.\.60 degC; nothing"
        ):
            await bench.driver.open()


@pytest.mark.parametrize("make", ["cts", "ascii2", "julabo"])
async def test_limits_that_cannot_be_read_have_to_be_stated(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path, limits_at_panel_degC=None) as bench:
        with pytest.raises(DeviceFault, match="say so by limits_at_panel_degC"):
            await bench.driver.open()
    async with bench_of(make, "tcp", tmp_path, limits_at_panel_degC=[-10, 90]) as bench:
        with pytest.raises(DeviceFault, match=r"limits_at_panel_degC allows set-points of -10\.\.90"):
            await bench.driver.open()


@pytest.mark.parametrize("make", MAKES)
async def test_when_the_computer_dies_it_goes_on_within_its_own_limits(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        assert bench.driver.dead_man.startswith("nothing")
        await bench.driver.set_temperature(45.0)
        await bench.driver.run()
        bench.wait(6 * 3600.0)  # no traffic
        assert bench.fake.running
        assert bench.plant.chamber_degC == pytest.approx(45.0, abs=3.0)
        assert bench.plant.chamber_degC < ALLOWED_DEGC[1]


async def test_a_quick_timer_that_is_not_renewed_ends_the_heat(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path, quick_timer=True) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(45.0)
        await bench.driver.run()
        bench.wait(300.0)
        assert bench.fake.running
        bench.wait(400.0)  # no traffic
        assert not bench.fake.running
        assert bench.plant.heater_on_fraction == 0


# Frames, as the manuals print them.


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        ("O", "02 81 CF CE 03"),
        ("F", "02 81 C6 C7 03"),
        ("A0", "02 81 C1 B0 F0 03"),
        ("s1 1", "02 81 F3 B1 A0 B1 D2 03"),
        ("a0 -40.0", "02 81 E1 B0 A0 AD B4 B0 AE B0 C7 03"),
    ],
)
def test_a_cts_frame_is_that_of_the_manual(text: str, frame: str):
    assert framed(1, text) == bytes.fromhex(frame)
    assert unframed(1, bytes.fromhex(frame)) == text


def test_an_ascii_2_reply_is_read_whole_in_pieces_and_not_beside_it():
    line = b"0050.0 0024.6 0080.0 0066.7 0090.0 0090.0 -040.0 0023.8 01100000000000000000000000000000\r"
    found = parse(line)
    assert found is not None
    assert found[0][:2] == [50.0, 24.6]
    assert found[0][6] == -40.0
    assert all(parse(line[:length]) is None for length in range(len(line)))
    for wrong in (b"0\r", line[3:], line.replace(b"24.6", b"2x.6"), b"\r\n"):
        with pytest.raises(ValueError, match="expected"):
            parse(wrong)
    assert (number(25.0), number(-40.0)) == ("0025.0", "-040.0")
