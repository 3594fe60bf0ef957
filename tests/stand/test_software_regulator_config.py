"""A regulator of kind software in a stand's file: what does not fit is refused by a sentence that names its place."""

from collections.abc import Callable
from typing import Any

import pytest
import yaml

from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig, find_packaged

Change = Callable[[dict[str, Any]], object]


def module(**keys: object) -> Change:
    """In the place of the heat's relay."""

    def change(data: dict[str, Any]) -> None:
        data["relays"]["channels"].pop("heat")
        data["heat_module"] = {"registers": "icpdas-m7024", "unit": 4, "watchdog_s": 12, **keys}

    return change


def module_with_the_relay(data: dict[str, Any]) -> None:
    module()(data)
    data["relays"]["channels"]["heat"] = 3


REFUSED: list[tuple[str, Change, str]] = [
    (
        "software-regulator",
        lambda d: d["regulator"].update(kind="softwre"),
        "regulator: must have kind: software, or no",
    ),
    ("software-regulator", lambda d: d["regulator"].update(sampl_s=3), r"regulator\.sampl_s: .*did you mean sample_s"),
    (
        "software-regulator",
        lambda d: d["regulator"]["law"].update(integral_s=-3),
        r"regulator\.law\.integral_s: must be",
    ),
    ("software-regulator", lambda d: d.update(regulator=3), "regulator: give keys and values"),
    ("simulated", lambda d: d["regulator"].pop("unit"), r"s\.yaml: regulator\.unit: is missing"),
    ("software-regulator", lambda d: d["relays"]["channels"].pop("heat"), r"relays\.channels lacks heat"),
    ("simulated", lambda d: d["relays"]["channels"].update(heat=3), r"relays\.channels has heat, .* and this is none"),
    ("software-regulator", lambda d: d["regulator"].update(thermometer="duct"), "there is no thermometer duct"),
    ("software-regulator", lambda d: d["regulator"].update(sample_s=1), "sample_s is shorter than thermometer_module"),
    ("software-regulator", lambda d: d["regulator"]["pulses"].update(cycle_s=60), "longer than guard.heater_hold_s"),
    ("software-regulator", lambda d: d["regulator"]["law"].update(lowest_percent=-8), "never starts the compressor"),
    ("software-regulator", module_with_the_relay, "take one of them to heat with"),
    ("software-regulator", module(watchdog_s=6), r"heat_module\.watchdog_s must be at least twice regulator\.sample_s"),
    ("software-regulator", module(watchdog_s=25), "longer than guard.heater_hold_s"),
    ("software-regulator", module(unit=3), "need different units on one bus"),
    ("software-regulator", module(safe_mA=6), "it would heat when this computer has died"),
    (
        "simulated",
        lambda d: d.update(heat_module={"registers": "icpdas-m7024", "unit": 4}),
        "heat_module is the output of a regulator of kind: software, and this is none",
    ),
]


@pytest.mark.parametrize(("stand", "change", "text"), REFUSED)
def test_what_does_not_fit_is_refused(stand: str, change: Change, text: str):
    data = yaml.safe_load(find_packaged("", stand).read_text())
    change(data)
    with pytest.raises(ConfigError, match=text):
        parse_document(yaml.safe_dump(data), StandConfig, "s.yaml")
