"""A real stand's file as a rehearsal: the simulated laboratory answers in the place of its devices."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import yaml

from thermostand.drivers.devices.motion.flap import FlapSettings
from thermostand.drivers.settings import CameraSettings, OnBus
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig, load_config, packaged
from thermostand.stand.running.order import Order, with_register_maps

_FOUND_BY = {"address", "width_px", "height_px"}  # of a camera: where it is, and what the simulated sensor may not have
_HEAD = "# A rehearsal of this stand's file: the simulated laboratory in the place of its devices.\n"


def rehearsed(order: Order) -> Order:
    """The order on the simulated laboratory. Kept: limits, thermometers, axes, contacts, what the guard allows, what
    the cameras are asked for, and the recipe. Replaced: addresses, and the units on the bus by those that the
    laboratory has; nobody is notified. An order of a simulated stand stays as it is. ConfigError for an axis that it
    does not have."""
    config = order.config
    if config.simulation is not None:
        return order
    there = load_config(packaged("", "simulated"))
    if strange := sorted(config.axes.keys() - there.axes.keys()):
        known = ", ".join(there.axes)
        raise ConfigError(f"{config.name}: the simulated laboratory has no axis {strange[0]}, only {known}")
    update: dict[str, Any] = {
        "bus": there.bus,
        "regulator": _at(config.regulator_unit, "omron-e5cc") if config.regulator_unit else config.regulator,
        "relays": config.relays and _at(config.relays, "waveshare-relay"),
        "heat_module": config.heat_module and _at(config.heat_module, "icpdas-m7024"),
        "climate_chamber": config.climate_chamber and config.climate_chamber.model_copy(update={"address": _CHAMBER}),
        "thermometer_module": _at(config.thermometer_module, there.thermometer_module.registers),
        "inputs": config.inputs and _at(config.inputs, "waveshare-inputs"),
        "axes": {
            name: axis.model_copy(update={"address": there.axes[name].address}) for name, axis in config.axes.items()
        },
        "probes": {
            name: probe.model_copy(update={"address": f"tcp:127.0.0.1:{_PROBES + number}"})
            for number, (name, probe) in enumerate(config.probes.items())
        },
        "devices": {
            name: device.model_copy(update={"address": f"tcp:127.0.0.1:{_PROBES + len(config.probes) + number}"})
            for number, (name, device) in enumerate(config.devices.items())
        },
        "flap": config.flap and _flap(config.flap, there.flap),
        "cameras": {name: _camera(camera, there.cameras["camera"]) for name, camera in config.cameras.items()},
        "guard": config.guard.model_copy(update={"notify": ()}),
        "compressor": config.compressor.model_copy(update={"state_file": None}),
        "alerts": there.alerts,
        "simulation": there.simulation,
    }
    rehearsal = StandConfig.model_validate(config.model_copy(update=update).model_dump(mode="json", exclude_none=True))
    text = _HEAD + yaml.safe_dump(rehearsal.model_dump(mode="json", exclude_none=True), sort_keys=False)
    return with_register_maps(replace(order, config=rehearsal, config_text=text))


_CHAMBER = "tcp:127.0.0.1:15023"
_PROBES = 15024  # and on


def _at(unit: OnBus, registers: str) -> OnBus:
    return unit.model_copy(update={"registers": registers})


def _flap(own: FlapSettings, there: FlapSettings | None) -> FlapSettings:
    return own.model_copy(
        update={name: getattr(there, name) for name in ("backend", "backend_address")} if there is not None else {}
    )


def _camera(own: CameraSettings, there: CameraSettings) -> CameraSettings:
    """The simulated camera, asked for what this stand asks of its own."""
    names = CameraSettings.model_fields.keys() - _FOUND_BY
    return there.model_copy(update={name: getattr(own, name) for name in names})
