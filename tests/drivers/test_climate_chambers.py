"""Climate chambers of five makes over their wires: what they are asked, and what is done at their panels."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.drivers.chamber_bench import MAKES, ON_WIRES, bench_of, running_at_30_degC
from thermostand.drivers.devices.chambers.chamber_simserv import parse_reply
from thermostand.foundation.clock import VirtualClock, WallClock
from thermostand.foundation.errors import DeviceError, DeviceFault, GarbledReply, Refused


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
        with pytest.raises(Refused, match=r"not in control: .* 30 degC"):
            await bench.driver.set_temperature(30.0)
        with pytest.raises(DeviceFault, match=r"not in control: "):
            await bench.driver.run()
        assert (await bench.read())["pv"].value == pytest.approx(24.0, abs=2)  # it is watched all the same


async def test_a_panel_that_protects_is_reported_with_what_to_do_and_watched_all_the_same(tmp_path: Path):
    async with bench_of("espec", "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.protected = True
        with pytest.raises(Refused, match=r"PROTECT ON"):
            await bench.driver.set_temperature(30.0)
        assert (await bench.read())["fault"].value == 0


@pytest.mark.parametrize("make", MAKES)
async def test_what_was_changed_at_the_panel_is_reported_with_both_values_and_left(make: str, tmp_path: Path):
    async with running_at_30_degC(make, tmp_path) as bench:
        bench.fake.press_setpoint(50.0)
        found = await bench.read()
        assert found["fault"].reason.endswith("from 30 to 50 degC")
        assert bench.fake.setpoint_degC == 50.0
        bench.fake.press_setpoint(30.0)
        bench.fake.press_stop()
        found = await bench.read()
        assert (found["running"].value, found["fault"].value) == (0, 0)
        assert not bench.fake.running


@pytest.mark.parametrize(
    ("make", "code", "sentence"),
    [
        ("espec", "5", "alarm 5"),
        ("cts", "33", "error 33"),
        ("simserv", "5", "alarm 5"),
        ("julabo", "01 LOW LEVEL ALARM", "-01 LOW LEVEL ALARM"),
    ],
)
async def test_a_latched_alarm_is_reported_and_nothing_is_started_until_it_is_reset(
    make: str, code: str, sentence: str, tmp_path: Path
):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.alarm = code
        assert (await bench.read())["fault"].reason == sentence
        with pytest.raises(DeviceFault, match=f"{sentence}; look at the chamber"):
            await bench.driver.run()
        assert not bench.fake.running
        bench.fake.alarm = ""
        await bench.driver.run()


@pytest.mark.parametrize("make", ["cts", "ascii2", "simserv", "julabo"])
async def test_a_set_point_that_is_clamped_is_refused_by_what_it_reads(make: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.limits_degC, bench.fake.clamps = (0.0, 35.0), True
        with pytest.raises(Refused, match=r"set to 50 degC, it reads 35 degC"):
            await bench.driver.set_temperature(50.0)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [("espec", "DATA OUT OF RANGE"), ("simserv", "does not take these parameters"), ("julabo", "VALUE TOO LARGE")],
)
async def test_a_set_point_that_the_unit_refuses_is_reported_in_its_words(make: str, sentence: str, tmp_path: Path):
    async with bench_of(make, "tcp", tmp_path) as bench:
        await bench.driver.open()
        bench.fake.limits_degC = (0.0, 35.0)
        with pytest.raises(Refused, match=sentence):
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
        assert "changed at the unit" in (await bench.read())["fault"].reason


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
            with pytest.raises(DeviceFault, match=r"operated by hand: .*\(RS232, USB\)"):
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


IN_FORCE = [  # of which make, with which settings, what acts in the place of the set-point, and what is reported of it
    ("julabo", {}, {"bank": 1}, "working temperature T2 acts (in_mode_01 is 1), and T1 is set"),
    ("julabo", {}, {"bank": 2}, "working temperature T3 acts"),
    ("julabo", {}, {"external": True}, "external control is on (in_mode_04 is 1)"),
    ("julabo", {}, {"degF": True}, "in degF (in_sp_06 is 1)"),
    ("julabo", {}, {"remote": False}, "operated by hand: choose remote control (RS232, USB) at its panel"),
    ("espec", {}, {"program_degC": 50.0}, "a program of its own runs; end it at the panel"),
    ("simserv", {}, {"program_degC": 50.0}, "a program of its own runs; end it at the panel"),
    ("simserv", {}, {"gradient_K_per_min": 0.5}, "a gradient of 0.5 K/min upwards is set (11066)"),
    ("cts", {}, {"program_degC": 50.0}, "a program of its own runs; end it at the panel (number 2)"),
    ("cts", {"ramp_reply": 23}, {"ramps": True}, "a ramp of its own runs (R1)"),
]


@pytest.mark.parametrize(("make", "settings", "state", "sentence"), IN_FORCE)
async def test_a_set_point_that_is_not_the_one_that_acts_is_a_fault_and_is_not_heated_for(
    make: str, settings: dict[str, object], state: dict[str, object], sentence: str, tmp_path: Path
):
    async with bench_of(make, "tcp", tmp_path, **settings) as bench:
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        found = await bench.driver.in_force()
        assert (found.objections, bool(found.known_by)) == ((), True)
        for name, value in state.items():
            setattr(bench.fake, name, value)
        written = bench.fake.setpoint_writes
        (objection,) = (await bench.driver.in_force()).objections
        assert sentence in objection
        for call in (bench.driver.set_temperature(40.0), bench.driver.run()):
            with pytest.raises(DeviceFault, match=f"not in force: .*{re.escape(sentence)}"):
                await call
        assert (bench.fake.setpoint_writes, bench.fake.running) == (written, False)
        found = await bench.read()
        assert (found["fault"].value, sentence in found["fault"].reason) == (1, True)


@pytest.mark.parametrize("make", ["julabo", "espec", "simserv", "cts", "ascii2"])
async def test_what_is_changed_at_the_panel_while_it_controls_is_seen_at_the_next_poll(make: str, tmp_path: Path):
    """Of ASCII-2 the nominal value alone tells it."""
    async with running_at_30_degC(make, tmp_path) as bench:
        assert (await bench.read())["fault"].value == 0
        setattr(bench.fake, *(("bank", 1) if make == "julabo" else ("program_degC", 50.0)))
        bench.wait(3600.0)
        assert bench.plant.chamber_degC > 40  # it has gone elsewhere, with its set-point as it was written
        assert (await bench.read())["fault"].value == 1
        await bench.driver.stop()


@pytest.mark.parametrize("answers", [False, True])
async def test_a_circulator_with_one_working_temperature_says_so_once_and_is_used(answers: bool, tmp_path: Path):
    async with bench_of("julabo", "tcp", tmp_path, timeout_s=0.2) as bench:
        bench.fake.unknown, bench.fake.answers_unknown = ("in_mode_01", "in_sp_06"), answers
        await bench.driver.open()
        await bench.driver.set_temperature(30.0)
        await bench.driver.run()
        assert (await bench.read())["fault"].value == 0
        found = await bench.driver.in_force()
        assert "in_mode_04" in found.known_by
        assert "in_mode_01" not in found.known_by
        assert "which working temperature acts" in found.not_reported
        bench.fake.external = True
        assert (await bench.read())["fault"].value == 1


async def test_a_gradient_that_is_wanted_and_one_that_a_unit_does_not_know_are_no_fault(tmp_path: Path):
    for settings, K_per_min in (({"allows_gradient": True}, 0.5), ({}, None)):
        async with bench_of("simserv", "tcp", tmp_path, **settings) as bench:
            bench.fake.gradient_K_per_min = K_per_min
            await bench.driver.open()
            await bench.driver.set_temperature(30.0)
            assert (await bench.driver.in_force()).objections == ()


async def test_a_temperature_that_looks_like_a_code_is_a_temperature(tmp_path: Path):
    assert parse_reply(b"1\xb6-5\r\n") == ("1", ["-5"])
    assert parse_reply(b"-5\r\n") == ("-5", [])
    assert [parse_reply(b"1\xb624.98\r\n"[:length]) for length in range(8)] == [None] * 8
    for wrong in (b"24.98\r\n", b"-5\xb61\r\n", b"\r\n"):
        with pytest.raises(ValueError, match="expected"):
            parse_reply(wrong)
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


async def test_the_pause_between_two_requests_costs_no_real_time_in_virtual_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    paused: list[float] = []
    monkeypatch.setattr("thermostand.drivers.wires.line_client.time.sleep", paused.append)
    for clock, is_paused in ((WallClock(), True), (VirtualClock(0), False)):
        async with bench_of("espec", "tcp", tmp_path, clock, gap_s=5.0) as bench:
            await bench.driver.open()
            await bench.read()
        assert bool(paused) is is_paused
        paused.clear()
