"""The models of a stand's file are what its drivers take: every key is within reach, every default written once."""

import dataclasses
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType
from typing import get_args

import pytest
import yaml
from pydantic import BaseModel

import thermostand.drivers.devices
import thermostand.drivers.wires
import thermostand.stand.chamber
import thermostand.stand.guarding
import thermostand.stand.imaging
from thermostand.drivers.devices.kinds import DeviceKind
from thermostand.drivers.devices.thermometers import ThermometerSettings
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import Document, parse_document
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.stand_config import StandConfig, find_packaged


def modules_of(*packages: ModuleType) -> Iterator[ModuleType]:
    for package in packages:
        look = pkgutil.walk_packages if package is thermostand.drivers.devices else pkgutil.iter_modules
        for found in look(package.__path__, f"{package.__name__}."):
            yield importlib.import_module(found.name)


def models_in(annotation: object) -> Iterator[type[BaseModel]]:
    """Every model within an annotation and, below it, within the fields of those."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        for field in annotation.model_fields.values():
            yield from models_in(field.annotation)
    for part in get_args(annotation):
        yield from models_in(part)


def classes(*packages: ModuleType) -> set[type]:
    return {
        found
        for module in modules_of(*packages)
        for _, found in inspect.getmembers(module, inspect.isclass)
        if found.__module__ == module.__name__
    }


REGISTER_MAP = {
    "InForceCheck",
    "RegisterMap",
    "Transport",
    "RawFault",
    "Split",
    "Pulse",
    "Point",
    "Confirm",
    "Write",
    "RegisterCommand",
    "UnitProof",
    "IdentityPoint",
}


def test_every_settings_model_of_a_driver_is_a_part_of_the_stands_file():
    models = {
        each for each in classes(thermostand.drivers.devices, thermostand.drivers.wires) if issubclass(each, Document)
    }
    # Of those of each make or kind, and those of a kind that stands under `devices`.
    base = {"ChamberUnitSettings", "AravisCameraSettings", "UpsSettings", "UpsSecrets"}
    assert {each.__name__ for each in models} - {
        each.__name__ for each in models_in(StandConfig)
    } == REGISTER_MAP | base


def test_a_driver_that_takes_settings_takes_none_of_their_keys_as_parameters():
    keys = {name for model in models_in(StandConfig) for name in model.model_fields}
    made = [
        inspect.signature(each)
        for each in classes(thermostand.drivers.devices, thermostand.drivers.wires)
        if inspect.isfunction(each.__init__) and each is not DeviceKind  # which says of a kind where they are
    ]
    taking = [each.parameters for each in made if "settings" in each.parameters]
    assert len(taking) >= 6
    assert [name for parameters in taking for name in parameters if name in keys - {"name"}] == ["backend"]  # as loaded


def test_no_dataclass_repeats_settings():
    settings = [set(model.model_fields) for model in models_in(StandConfig)]
    routes = (
        thermostand.drivers.devices,
        thermostand.drivers.wires,
        thermostand.stand,
        thermostand.stand.chamber,
        thermostand.stand.guarding,
        thermostand.stand.imaging,
    )
    repeated = {
        each.__name__
        for each in classes(*routes)
        if dataclasses.is_dataclass(each)
        and len(dataclasses.fields(each)) > 1
        and any({field.name for field in dataclasses.fields(each)} <= keys for keys in settings)
    }
    assert repeated == set()


@pytest.mark.parametrize(
    "changes",
    [
        {"packet_delay_ns": 20_000, "buffers": 9, "resend": False, "pixel_format": "Mono10"},
        {"temperature": {"register_address": 0x1F0, "mask": 0xFF, "scale": 0.5, "offset": -10.0}},
        {"temperature": {"feature": "TemperatureAbs", "selector": None, "entry": None}},
    ],
    ids=["packets", "temperature register", "temperature feature"],
)
def test_what_a_file_says_of_the_camera_is_what_the_driver_has(changes: dict[str, object]):
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["cameras"]["camera"].update(changes)
    config = parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")
    camera = assemble(config, Hub(), WallClock()).devices.cameras["camera"]
    settings = GigeCameraSettings.model_validate(data["cameras"]["camera"])
    assert camera.settings == settings
    assert settings.model_dump(include=set(changes), exclude_unset=True).keys() == changes.keys()


def test_a_thermometer_is_plausible_in_one_range():
    assert ThermometerSettings(channel=0).plausible_degC == (-40.0, 100.0)
