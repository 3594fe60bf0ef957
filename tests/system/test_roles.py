"""Thermometers by their roles: whatever a sensor is called, rules, regulator and recording find it by its place."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.system.virtual_stand import virtual_stand
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.guarding.rules import list_vital_channels

THERMOMETERS: dict[str, dict[str, Any]] = {
    "base_plate": {"channel": 0, "role": "granite_inside", "certificate": "T-17"},
    "pt100_7": {"channel": 3, "role": "air"},
    "by_the_window": {"channel": 4, "role": "laboratory"},
    "ceiling": {"channel": 1, "role": "safety"},
    "cable": {"channel": 2},
}


def described(thermometers: dict[str, dict[str, Any]]) -> dict[str, Any]:
    data = yaml.safe_load(find_packaged("", "software-regulator").read_text())
    return data | {"axes": {}, "cameras": {}, "thermometers": thermometers}


def config_of(**changes: dict[str, Any] | None) -> StandConfig:
    thermometers = {name: each for name, each in {**THERMOMETERS, **changes}.items() if each is not None}
    return parse_document(yaml.safe_dump(described(thermometers)), StandConfig, "s.yaml")


async def test_a_sensor_of_any_name_is_read_and_guarded_by_its_role(tmp_path: Path):
    (tmp_path / "stand.yaml").write_text(yaml.safe_dump(described(THERMOMETERS)))
    async with virtual_stand(load_config(tmp_path / "stand.yaml")) as stand:
        await stand.hold(40, 600)
        read = {channel for channel in stand.series if channel.startswith("thermometers.")}
        assert {channel for channel in read if not channel.endswith("_raw")} == {
            f"thermometers.{name}" for name in ("air", "granite_inside", "laboratory", "ceiling", "cable")
        }
        assert stand.series["thermometers.air"][-1][1] > 30
        assert stand.trips() == []
        await stand.break_("thermometer.offset_K", {"ceiling": 50})
        await stand.wait(15)
        assert "over_temperature" in stand.trips()
        assert await stand.true("heater_enabled") == 0


async def test_a_safety_thermometer_that_reads_low_is_a_warning_for_it_guards_nothing(tmp_path: Path):
    (tmp_path / "stand.yaml").write_text(yaml.safe_dump(described(THERMOMETERS)))
    async with virtual_stand(load_config(tmp_path / "stand.yaml")) as stand:
        await stand.hold(40, 900)
        assert stand.trips() == []
        await stand.break_("thermometer.offset_K", {"ceiling": -40})
        await stand.wait(700)
        (warning,) = [event for event in stand.events if event.kind == "guard.sensors_disagree"]
        assert warning.level == "warning"
        assert "thermometers.ceiling" in warning.text
        assert await stand.true("heater_enabled") == 1


def test_without_a_safety_thermometer_that_is_read_no_heat_is_given():
    assert list_vital_channels(config_of()) == (
        "regulator.pv",
        "thermometers.air",
        "thermometers.granite_inside",
        "thermometers.ceiling",
    )


def test_a_file_without_roles_means_what_it_did():
    config = load_config(find_packaged("", "software-regulator"))
    assert list(config.sensors) == list(config.thermometers)
    assert list_vital_channels(config) == ("regulator.pv", "thermometers.air", "thermometers.granite_inside")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"pt100_7": {"channel": 3}},
            r"lacks air, without which nothing is heated; name one so, or give one `role: air`",
        ),
        ({"cable": {"channel": 2, "role": "air"}}, "two of them have the role air"),
        ({"air": {"channel": 2}}, "two of them have the role air"),
        (
            {"artifact": {"channel": 2, "role": "safety"}},
            r"thermometers\.artifact has the role safety; give it another",
        ),
        ({"cable": {"channel": 2, "role": "ceiling"}}, r"thermometers\.cable\.role: "),
    ],
    ids=["nobody", "two", "one by its name", "belied", "no role"],
)
def test_roles_that_do_not_fit_are_refused(changes: dict[str, dict[str, Any]], text: str):
    with pytest.raises(ConfigError, match=text):
        config_of(**changes)


def test_the_regulators_thermometer_and_the_dew_point_go_by_roles():
    data = described(THERMOMETERS)
    data["dew"] = {"humidity_percent": 60}
    parse_document(yaml.safe_dump(data), StandConfig, "s.yaml")
    data["regulator"]["thermometer"] = "pt100_7"
    with pytest.raises(ConfigError, match=r"no thermometer pt100_7, by its role granite_inside, laboratory"):
        parse_document(yaml.safe_dump(data), StandConfig, "s.yaml")
    del data["thermometers"]["by_the_window"]
    data["regulator"]["thermometer"] = "air"
    with pytest.raises(ConfigError, match="role: laboratory"):
        parse_document(yaml.safe_dump(data), StandConfig, "s.yaml")
