"""What a stand lacks, and what it therefore cannot do: shown with its plan and recorded with its runs."""

from __future__ import annotations

from collections.abc import Iterator

from thermostand.drivers.devices.kinds import Absence, load_built_in_kinds
from thermostand.stand.config.stand_config import StandConfig


def list_missing_devices(config: StandConfig) -> tuple[Absence, ...]:
    """Each thing that a stand may have and this one has not."""
    return tuple(_iterate_missing(config))


def _iterate_missing(config: StandConfig) -> Iterator[Absence]:
    remote = {each.kind for each in config.equipment if each.settings is not None}
    for kind in load_built_in_kinds():
        if kind.missing is not None and kind not in remote:
            yield kind.missing
    if config.relays is not None and "compressor" not in config.relays.channels:
        yield Absence("compressor", "it cools by losing heat only, so not below the laboratory's temperature")
    if config.cameras and all(not camera.has_temperature for camera in config.cameras.values()):
        yield Absence("camera measures its own temperature", "drift is fitted to the air and its history")
    if "granite_inside" not in config.sensors:
        yield Absence(
            "thermometer in the granite inside", "its drift is not split from the camera's, and it guards nothing"
        )
    if not config.independent_air_sensors:
        yield Absence(
            "independent air sensor", "a regulator's probe and an air thermometer that are wrong alike are not found"
        )
    if "laboratory" not in config.sensors:
        yield Absence("thermometer in the laboratory", "a run ends at ending.ambient_degC")
