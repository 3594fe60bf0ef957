"""Our own regulator over the wires: it holds, it tunes itself, and whatever fails ends the heat."""

import asyncio
import signal
import socket
import struct
from pathlib import Path

import pytest
import yaml

from tests.system.regulator_steps import autotune_in, steps_of
from tests.system.virtual_stand import LIMIT_S, REAL_TIME, VirtualStand, bare_config, heating_process, virtual_stand
from thermostand.drivers.devices.regulators.pid import Law
from thermostand.drivers.devices.regulators.software_regulator import SoftwareRegulator
from thermostand.foundation.errors import DeviceFault, Occupied, Refused
from thermostand.stand.service.manual_control import ManualControl

RELAYS, HEAT = 2, 3  # unit, its relay


def regulator_of(stand: VirtualStand) -> SoftwareRegulator:
    regulator = stand.assembly.devices.regulator
    assert isinstance(regulator, SoftwareRegulator)
    return regulator


async def heats(stand: VirtualStand) -> bool:
    """Whether there is a pulse within a cycle."""
    shares = list[float]()
    for _ in range(20):
        await stand.wait(0.5)
        shares.append(await stand.true("heater_on_fraction"))
    return max(shares) > 0


async def test_it_finds_its_law_about_a_set_point_and_goes_on_without_a_bump(tmp_path: Path):
    config = bare_config("software-regulator", tmp_path, {"regulator": {"law": Law().model_dump(mode="json")}})
    async with virtual_stand(config) as stand:
        regulator, by_hand = regulator_of(stand), ManualControl(stand.assembly, lambda: None)
        tuning = asyncio.create_task(by_hand.work("regulator", "autotune", {"setpoint_degC": 40}))
        await stand.wait(1200)
        refused = 0
        while not tuning.done():
            try:
                await regulator.set_temperature(40)
            except Occupied:
                refused += 1
            await stand.wait(60)
        assert refused > 5
        await tuning
        await stand.wait(900)
        assert stand.trips() == []
    (reported,) = [event for event in stand.events if event.kind == "autotuned"]
    law = Law.model_validate(reported.data["law"])
    assert law.gain_percent_per_K == pytest.approx(10.4, rel=0.2)
    assert law.integral_s == pytest.approx(95, rel=0.2)
    assert Law(**yaml.safe_load(reported.text.partition("file: ")[2])["law"]) == law
    after = [abs(degC - 40) for time_s, degC in stand.series["regulator.pv"] if time_s > stand.time_s - 900]
    assert max(after) < 1.0


async def test_it_is_not_tuned_where_nothing_is_held(tmp_path: Path):
    config = bare_config("software-regulator", tmp_path, {"regulator": {"autotune": {"limit_s": 600}}})
    async with virtual_stand(config) as stand:
        await stand.hold(60, 10)
        with pytest.raises(DeviceFault, match=r"within 0\.5 K for 600 s"):
            await regulator_of(stand).autotune()
        await stand.assembly.stand.chamber.stop()
        with pytest.raises(DeviceFault, match="control was stopped"):
            await regulator_of(stand).autotune()


async def test_without_permission_no_pulse_is_given_and_stopped_it_is_off(tmp_path: Path):
    async with virtual_stand(bare_config("software-regulator", tmp_path)) as stand:
        regulator, permits = regulator_of(stand), stand.assembly.stand.chamber.permits
        with pytest.raises(Refused, match="no set-point"):
            await regulator.run()
        with pytest.raises(Refused, match=r"outside -10\.\.60 degC"):
            await regulator.set_temperature(61)
        await stand.hold(40, 60)
        assert await heats(stand)
        permits.revoke()
        await stand.wait(5)
        assert not await heats(stand)
        readings = {reading.channel: reading.value for reading in await regulator.read()}
        assert (readings["regulator.running"], readings["regulator.mv_heat"]) == (1, 0)
        permits.grant()
        await stand.wait(5)
        assert await heats(stand)
        await stand.assembly.stand.chamber.stop()
        assert not await heats(stand)


async def test_without_a_good_temperature_no_heat_is_given_and_the_integral_waits(tmp_path: Path):
    async with virtual_stand(bare_config("software-regulator", tmp_path, {"guard": {"stale_after_s": 30}})) as stand:
        await stand.hold(45, 1800)
        _, held_percent = stand.series["regulator.mv_heat"][-1]
        await stand.break_("thermometers.no_fault_bits", True)
        await stand.wait(6)
        readings = {reading.channel: reading for reading in await regulator_of(stand).read()}
        assert readings["regulator.fault"].reason.startswith("thermometers.air is stale")
        assert readings["regulator.mv_heat"].value == 0
        assert not await heats(stand)
        await stand.break_("thermometers.no_fault_bits", False)
        await stand.wait(10)
        assert stand.trips() == []
        _, percent = stand.series["regulator.mv_heat"][-1]
        assert percent == pytest.approx(held_percent, abs=5)


async def test_a_thermometer_that_breaks_ends_the_heat(tmp_path: Path):
    async with virtual_stand(bare_config("software-regulator", tmp_path)) as stand:
        await stand.hold(45, 60)
        await stand.break_("thermometer.open", "air")
        await stand.wait(6)
        assert not await heats(stand)
        await stand.wait(10)
        assert stand.trips()
        assert await stand.true("heater_enabled") == 0


@pytest.mark.parametrize(
    ("fault", "value", "set_point_degC"),
    [("relays.welded", "heat", 26.0), ("thermometer.pulled_out", "air", 50.0)],
    ids=["welded SSR", "probe out of the chamber"],
)
async def test_heat_that_it_does_not_see_is_found_by_the_guard(
    tmp_path: Path, fault: str, value: object, set_point_degC: float
):
    config = bare_config("software-regulator", tmp_path)
    async with virtual_stand(config) as stand:
        await stand.hold(50, 1800)
        await stand.break_(fault, value)
        if set_point_degC != 50:
            await stand.assembly.stand.chamber.set_temperature(set_point_degC)
        hottest_degC = 0.0
        for _ in range(60):
            await stand.wait(30)
            hottest_degC = max(hottest_degC, await stand.true("bulk_air_degC"))
        assert stand.trips()
        assert await stand.true("heater_enabled") == 0
        assert hottest_degC < config.guard.max_air_degC + 3


async def test_a_heat_relay_that_somebody_else_holds_is_switched_off_and_reported(tmp_path: Path):
    async with virtual_stand(bare_config("software-regulator", tmp_path)) as stand:
        await stand.hold(26, 1800)

        def hold_it() -> None:
            _, host, port = stand.assembly.config.bus.address.split(":")
            with stand.clock.hold(), socket.create_connection((host, int(port)), 5.0) as line:
                line.sendall(struct.pack(">HHHBBHH", 1, 0, 6, RELAYS, 5, HEAT, 0xFF00))
                assert line.recv(64)

        faults = list[str]()
        for _ in range(12):
            await asyncio.to_thread(hold_it)
            await stand.wait(5)
            faults += [r.reason for r in await regulator_of(stand).read() if r.channel == "regulator.fault"]
        assert any("relays.heat: was on" in reason for reason in faults)
        await stand.wait(30)
        await stand.assembly.stand.chamber.stop()
        await asyncio.to_thread(hold_it)
        await stand.wait(10)
        assert await stand.true("heater_on_fraction") == 0
        assert [event.data["relay"] for event in stand.events if event.kind == "switched_off"][-1:] == ["heat"]


async def test_a_process_that_is_stopped_gives_no_heat_after_its_last_pulse(tmp_path: Path):
    """SIGSTOP, in real time: the pulse ends by the board's timer, long before the enable relay's hold of 30 s."""
    pulses = {"cycle_s": 2, "min_on_s": 0.1, "min_off_s": 0.1}
    bare_config(
        "software-regulator", tmp_path, {**REAL_TIME, "regulator": {**REAL_TIME["regulator"], "pulses": pulses}}
    )
    async with heating_process(tmp_path / "software-regulator.yaml") as (process, plant):
        process.send_signal(signal.SIGSTOP)
        await asyncio.sleep(5.0)  # a cycle of 2 s, an overlap of 2 s
        assert await plant("heater_W") == 0
        assert await plant("heater_enabled") == 1  # it is the pulse that has ended
        process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGINT)
        assert await asyncio.to_thread(process.wait, LIMIT_S) == 130
        assert await plant("heater_enabled") == 0


@pytest.mark.nightly
def test_autotuned_it_holds_a_tenth_and_overshoots_less_than_half_a_kelvin_in_the_standard_and_drawn_chambers():
    for seed in (None, 4, 7, 9):
        for step in steps_of("software-regulator", seed, autotune_in(seed)):
            assert step.overshoot_K < 0.5
            assert step.worst_K < 0.1
