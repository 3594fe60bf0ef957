"""Climate chambers of five makes over their wires: lines that fail, restarts, doors, and another unit than before."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.drivers.chamber_bench import ALLOWED_DEGC, MAKES, ON_WIRES, WIRES, bench_of, running_at_30_degC
from thermostand.drivers.devices.chambers.chamber_ascii2 import number, parse
from thermostand.drivers.devices.chambers.chamber_cts import unwrap_frame, wrap_frame
from thermostand.foundation.errors import DeviceError, DeviceFault, Refused, Unreachable
from thermostand.foundation.readings import Quality


@pytest.mark.parametrize(("make", "wire"), ON_WIRES)
async def test_a_late_reply_is_never_taken_for_the_next_one(make: str, wire: str, tmp_path: Path):
    async with bench_of(make, wire, tmp_path) as bench:
        await bench.driver.open()
        await bench.driver.read()  # the first request over a connection is repeated, as over a serial line
        for value_degC in (30.0, 35.0, 40.0):
            bench.faults.hold()
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
    async with bench_of(make, wire, tmp_path, timeout_s=0.1) as bench:
        await bench.driver.open()
        faults, seeded = bench.faults, random.Random(5)
        faults.drop = faults.cut = 0.01
        read = 0
        for number_ in range(120):
            if seeded.random() < 0.04:
                faults.hold()
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


@pytest.mark.parametrize(
    ("make", "wire", "fault"),
    [
        *((make, "tcp", fault) for make in MAKES for fault in ("hangs_up", "swallows_first")),
        *(
            (make, wire, "flow_control") for make, wire in ON_WIRES if (make, wire) != ("cts", "tcp")
        ),  # a byte of its own
    ],
)
async def test_a_line_with_manners_of_its_own_carries_everything(make: str, wire: str, fault: str, tmp_path: Path):
    async with bench_of(make, wire, tmp_path, timeout_s=0.3) as bench:
        setattr(bench.faults, fault, True)
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        await bench.driver.run()
        for value_degC in (21.0, 22.5):
            bench.fake.stuck_degC = value_degC
            found = await bench.read()
            assert (found["pv"].value, found["sp"].value, found["fault"].value) == (value_degC, 30.0, 0)
        assert not set(bench.driver.identity.model) & {"\x11", "\x13"}
        await bench.driver.stop()
        assert (bench.fake.setpoint_degC, bench.fake.running) == (30.0, False)


async def test_a_flipped_bit_that_looks_like_flow_control_takes_no_digit_away(tmp_path: Path):
    """0x13 is a 3 but for one bit: 33.00 without it would be 3.00."""
    async with bench_of("julabo", "serial", tmp_path, timeout_s=0.3) as bench:
        await bench.driver.open()
        await bench.driver.read()
        bench.fake.stuck_degC = 33.0
        for damaged in (b"\x133.00", b"3\x13.00"):
            flips = iter([damaged + b"\r\n"])
            bench.faults.apply = lambda _, reply, flips=flips: [next(flips, reply) if reply == b"33.00\r\n" else reply]
            assert (await bench.read())["pv"].value == 33.0


@pytest.mark.parametrize("make", MAKES)
async def test_one_that_restarted_stopped_is_reported_and_not_started_by_itself(make: str, tmp_path: Path):
    async with running_at_30_degC(make, tmp_path) as bench:
        bench.fake.restart()
        for _ in range(3):
            assert (await bench.read())["running"].value == 0
        assert not bench.fake.running


@pytest.mark.parametrize("make", MAKES)
async def test_one_that_restarted_running_at_its_old_set_point_is_reported_and_left(make: str, tmp_path: Path):
    async with running_at_30_degC(make, tmp_path) as bench:
        bench.fake.restart(running_at_degC=55.0)
        for _ in range(2):
            found = await bench.read()
        assert (found["running"].value, found["sp"].value) == (1, 55)
        assert found["fault"].reason.endswith("from 30 to 55 degC")
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
        with pytest.raises(Refused, match="at the panel"):
            await bench.driver.run()
        assert not bench.fake.running


async def test_a_unit_of_another_identity_is_not_used_also_after_a_loss(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path, identity="T,T,S9") as bench:
        with pytest.raises(DeviceFault, match=r"'T,T,S2,160.0', not 'T,T,S9'"):
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
    assert wrap_frame(1, text) == bytes.fromhex(frame)
    assert unwrap_frame(1, bytes.fromhex(frame)) == text


def test_an_ascii_2_reply_is_read_whole_in_pieces_and_not_misaligned():
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
