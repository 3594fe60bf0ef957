"""Mistakes that people make, each with what is reported of it: what is wrong, where, what to type."""

from collections.abc import Callable
from pathlib import Path

import pytest

from thermostand.compensation.drift.model_file import load_model
from thermostand.foundation.documents import load_document, parse_document
from thermostand.foundation.errors import ConfigError, SessionError, StandError
from thermostand.recording.reading.session import Session
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.memory.journal import Journal
from thermostand.stand.running.order import load_order

STAND = find_packaged("", "laboratory").read_text(encoding="utf-8")
RECIPE = find_packaged("recipes", "trial").read_text(encoding="utf-8")


def read_error(call: Callable[[], object], error: type[StandError] = ConfigError) -> str:
    with pytest.raises(error) as refused:
        call()
    return str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("max_air_degC: 65.0", "max_air_degC: yes", "guard.max_air_degC: give a number in degC, without the unit"),
        ("unit: 3", "unit: on", "thermometer_module.unit: give a whole number (got 'on', line 33)"),
        ("offset_K: 0.0, polynomial: [], certificate: \"\"}     # and", "offset_K: 0,5}     # and",
         "thermometers.granite_inside.5: is no name of a key; decimals stand behind a point, as in 0.5 and not 0,5"),
        ("profile: 8MT160-300", "profile: 8MT160",
         "axes.linear.profile: must be '8MT160-300' or '8MR151'; did you mean 8MT160-300? (got '8MT160', line 46)"),
        ("air:             {channel: 3,", "air:             {channel: 3, calibrated: 11.03.2026,",
         "thermometers.air.calibrated: give a date as 2026-03-31 (got '11.03.2026', line 41)"),
    ],
)  # fmt: skip
def test_a_value_of_another_kind(old: str, new: str, sentence: str):
    assert STAND.count(old) == 1, old
    message = read_error(lambda: parse_document(STAND.replace(old, new), StandConfig, "mine.yaml"))
    assert message.startswith(f"mine.yaml: {sentence}")
    assert message.count("mine.yaml") == 1  # one mistake, one sentence


def test_files_that_were_exchanged(tmp_path: Path):
    exchanged = read_error(lambda: parse_document(RECIPE, StandConfig, "mine.yaml"))
    assert exchanged.startswith("mine.yaml: is a recipe")
    assert exchanged.endswith("`stand run RECIPE --config STAND`")
    assert read_error(lambda: parse_document(STAND, Recipe, "mine.yaml")).startswith("mine.yaml: is a stand")
    message = read_error(lambda: find_packaged("", str(tmp_path)))
    assert message.startswith(f"{tmp_path}: is a folder")
    assert "installed: laboratory" in message


def test_a_text_that_is_not_in_utf8(tmp_path: Path):
    file = tmp_path / "mine.yaml"
    file.write_bytes(STAND.replace('operator: ""', 'operator: "Müller"').encode("latin-1"))
    message = read_error(lambda: load_document(file, StandConfig))
    assert message.startswith(f"{file}: cannot be read (line 5 ")


@pytest.mark.parametrize("registers", ["waveshare-relay", "omron-e5cc"])
def test_a_register_map_of_another_unit_for_thermometers(tmp_path: Path, registers: str):
    file = tmp_path / "mine.yaml"
    file.write_text(STAND.replace("registers: icpdas-m7015", f"registers: {registers}"))
    message = read_error(lambda: load_order("trial", str(file)))
    assert message.startswith(f"{file}: thermometer_module: register map ")
    assert message.endswith("of no thermometer module")


def test_what_is_no_session_and_no_model(tmp_path: Path):
    assert read_error(lambda: Session.open(tmp_path / "x"), SessionError) == f"{tmp_path / 'x'}: no such folder"
    file = tmp_path / "file"
    file.write_text("x")
    assert read_error(lambda: Session.open(file), SessionError).startswith(f"{file}: is a file")
    assert read_error(lambda: Journal.open(tmp_path / "x"), SessionError) == f"{tmp_path / 'x'}: no such folder"
    assert read_error(lambda: load_model(tmp_path / "m.json"), SessionError) == f"{tmp_path / 'm.json'}: no such file"
