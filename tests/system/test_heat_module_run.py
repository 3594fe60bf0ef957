"""Our own regulator over an analog output: it holds, it needs the same permission as a relay, and ends without us."""

import asyncio
import signal
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.system.virtual_stand import REAL_TIME, VirtualStand, heating_process, virtual_stand
from thermostand.foundation.errors import DeviceFault
from thermostand.stand.config.stand_config import find_packaged, load_config

MODULE = {"registers": "icpdas-m7024", "unit": 4, "channel": 2, "watchdog_s": 12.0}
CHANNELS = {"heater_enable": 0, "compressor": 1, "camera_power": 2}


def stand_file(folder: Path, **sections: dict[str, Any]) -> Path:
    data = yaml.safe_load(find_packaged("", "software-regulator").read_text())
    data |= {"axes": {}, "cameras": {}, "heat_module": dict(MODULE)}
    data["relays"]["channels"] = dict(CHANNELS)
    for name, entries in sections.items():
        data[name].update(entries)
    path = folder / "stand.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


async def current_mA(stand: VirtualStand) -> float:
    await stand.wait(5.0)
    return stand.series["heat_module.output"][-1][1]


async def test_it_holds_a_set_point_and_gives_nothing_without_permission(tmp_path: Path):
    async with virtual_stand(load_config(stand_file(tmp_path))) as stand:
        permits = stand.assembly.stand.chamber.permits
        assert await current_mA(stand) == 4.0
        await stand.hold(40, 1800)
        assert abs(stand.series["regulator.pv"][-1][1] - 40) < 0.5
        assert await current_mA(stand) > 4.0
        permits.revoke()
        await stand.wait(10)
        assert await current_mA(stand) == 4.0
        assert await stand.true("heater_W") == 0
        permits.grant()
        await stand.wait(10)
        assert await current_mA(stand) > 4.0
        await stand.assembly.stand.chamber.stop()
        assert await current_mA(stand) == 4.0
        await stand.wait(60)
        assert stand.series["heat_module.tripped"][-1][1] == 0
        assert stand.trips() == []


async def test_a_module_that_is_gone_for_longer_than_its_watchdog_holds_the_stand_and_its_trip_is_reported(
    tmp_path: Path,
):
    async with virtual_stand(load_config(stand_file(tmp_path, bus={"timeout_s": 0.1}))) as stand:
        await stand.hold(40, 60)
        await stand.break_("heat_module.silent", True)
        await stand.wait(15)
        assert await stand.true("heater_W") == 0
        await stand.break_("heat_module.silent", False)
        await stand.wait(stand.assembly.config.guard.panel_change_grace_s + 15)
        assert stand.trips() == ["device_fault"]
        assert await stand.true("heater_enabled") == 0


async def test_a_module_whose_watchdog_wants_another_protocol_is_refused_before_anything_is_heated(tmp_path: Path):
    config = load_config(stand_file(tmp_path, simulation={"faults": ["heat_module.refreshed_by=nothing"]}))
    with pytest.raises(DeviceFault, match=r"heat_module.*trips"):
        async with virtual_stand(config):
            pass


async def test_a_process_that_is_killed_leaves_the_module_at_its_safe_value_after_its_watchdogs_time(tmp_path: Path):
    """SIGKILL, in real time: the module ends the heat, long before the enable relay's hold of 30 s."""
    path = stand_file(tmp_path, **{**REAL_TIME, "heat_module": {"watchdog_s": 1.5}})
    async with heating_process(path) as (process, plant):
        process.send_signal(signal.SIGKILL)
        await asyncio.sleep(1.5 + 1.0)  # the plant's steps are of 0.5 s
        assert await plant("heater_W") == 0
        assert await plant("heater_enabled") == 1  # it is the module that has ended it


QUICK: dict[str, dict[str, object]] = {
    "regulator": {"poll_s": 2.0, "sample_s": 2.0},
    "thermometer_module": {"poll_s": 2.0},
    "guard": {"period_s": 1.0},
}


async def seconds_of_heat(stand: VirtualStand) -> float:
    """For how much of the next 12 s the plant is heated, in steps of 0.25 s."""
    heated = 0
    for _ in range(48):
        await stand.wait(0.25)
        heated += await stand.true("heater_W") > 0
    return heated / 4


async def test_an_output_that_is_stuck_costs_the_permission_at_once_and_the_relay_in_series_ends_the_heat(
    tmp_path: Path,
):
    """Within one step of the law and one look of the guard; the module itself gives its current on."""
    async with virtual_stand(load_config(stand_file(tmp_path, **QUICK))) as stand:
        await stand.hold(20, 10.5)  # no heat is wanted
        assert await stand.true("heater_W") == 0
        await stand.break_("heat_module.stuck_mA", 12.0)
        assert 0 < await seconds_of_heat(stand) <= 2.0 + 1.0
        assert stand.trips() == ["heat_uncontrolled"]
        await stand.wait(60)
        assert (await stand.true("heater_enabled"), await stand.true("heater_W")) == (0, 0)
        (unsafe,) = stand.assembly.stand.safety.unconfirmed
        assert "it gives 12.00 mA" in unsafe
        await stand.break_("heat_module.stuck_mA", None)
        await stand.wait(20)
        assert stand.assembly.stand.safety.is_confirmed


async def test_an_output_that_takes_no_new_value_costs_the_permission_at_once(tmp_path: Path):
    async with virtual_stand(load_config(stand_file(tmp_path, **QUICK))) as stand:
        await stand.hold(40, 60)
        assert await stand.true("heater_W") > 100
        await stand.break_("heat_module.lost_writes", True)
        assert 0 < await seconds_of_heat(stand) <= 2.0 + 1.0
        assert stand.trips() == ["heat_uncontrolled"]
        assert await stand.true("heater_enabled") == 0


async def test_one_write_by_another_master_ends_with_zero_and_one_after_the_other_with_the_permission(tmp_path: Path):
    async with virtual_stand(load_config(stand_file(tmp_path, **QUICK))) as stand:
        await stand.hold(20, 10)
        await stand.break_("heat_module.written_mA", 12.0)
        await stand.wait(3)
        assert (await stand.true("heater_W"), stand.trips()) == (0, [])
        await stand.wait(4)
        for _ in range(4):
            await stand.break_("heat_module.written_mA", 12.0)
            await stand.wait(1)
        await stand.wait(1)
        assert stand.trips() == ["heat_uncontrolled"]
        assert (await stand.true("heater_W"), await stand.true("heater_enabled")) == (0, 0)
