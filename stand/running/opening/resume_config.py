"""A session that is resumed brings its experiment, never its stand: it may be somebody else's, and what it names would
be run and opened here.

The programs that are run, the files and folders, the addresses, and all that protects the stand are those of this
stand's own configuration. Of the session's remain recipe, seed and target, and what its frames depend on.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from thermostand.drivers.settings import CameraSettings, OnBus
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config

# Of the camera and the recording: frames before and after the interruption belong together.
_CAMERA = (
    "pixel_format",
    "width_px",
    "height_px",
    "offset_x_px",
    "offset_y_px",
    "binning",
    "exposure_s",
    "gain_dB",
    "trigger",
    "frame_rate_hz",
    "temperature",
    "has_temperature",
)
_RECORDING = ("frame_encoding", "whole_every_s")
_LONGEST_VALUE = 200  # characters of a value that a sentence shows


@dataclass(frozen=True, slots=True)
class Difference:
    """What the session's configuration has at `path`, and what this stand's has, as JSON-able values."""

    path: str
    session: object
    stand: object

    def __str__(self) -> str:
        other = "and not given in" if self.session is None else f"not {_format_value(self.session)} as in"
        return f"{self.path} is {_format_value(self.stand)} as on this stand, {other} the session"

    def data(self) -> dict[str, object]:
        """The differences as data for the recording."""
        return {"path": self.path, "session": self.session, "stand": self.stand}


def load_default_stand() -> StandConfig:
    """When no configuration is named: the installed simulated one, as for a new run."""
    return load_config(find_packaged("", "simulated"))


def make_resume_config(
    recorded: StandConfig, own: StandConfig, session: Path, *, is_virtual: bool
) -> tuple[StandConfig, tuple[Difference, ...]]:
    """The configuration with which a session is resumed here, and how it differs from the recorded one.

    In virtual time the session's own laboratory is simulated, which has no addresses to mistake: only programs, files
    and folders are this stand's. ConfigError when one stand is real and the other simulated.
    """
    if is_virtual:
        config = _adapt_virtual_time(recorded, own)
    else:
        _check_kind(recorded, own, session)
        config = own.model_copy(
            update={
                "target": recorded.target,
                "cameras": _merge_cameras(recorded, own, session),
                "recording": own.recording.model_copy(
                    update={name: getattr(recorded.recording, name) for name in _RECORDING}
                ),
            }
        )
    return config, tuple(_find_differences(recorded.model_dump(mode="json"), config.model_dump(mode="json")))


def _adapt_virtual_time(recorded: StandConfig, own: StandConfig) -> StandConfig:
    simulated = own if own.simulation is not None else load_default_stand()
    maps = {
        name: settings.model_copy(
            update={
                "registers": simulated.units[kind.section].registers
                if kind.section in simulated.units
                else kind.simulated_map
            }
        )
        for name, kind, settings in recorded.equipment
        if isinstance(settings, OnBus)
    }
    state_file = {"state_file": simulated.compressor.state_file}
    return recorded.model_copy(
        update={
            **recorded.replace_settings(maps),
            "alerts": own.alerts,
            "compressor": recorded.compressor.model_copy(update=state_file),
            "recording": recorded.recording.model_copy(update={"directory": own.recording.directory}),
            "flap": recorded.flap
            and recorded.flap.model_copy(update={"backend": simulated.flap and simulated.flap.backend}),
        }
    )


def _merge_cameras(recorded: StandConfig, own: StandConfig, session: Path) -> dict[str, CameraSettings]:
    """Merge the cameras of the session, by its names: where they are found is this stand's, what its frames depend on
    the session's."""
    if missing := recorded.cameras.keys() - own.cameras.keys():
        raise ConfigError(
            f"{session}: was recorded with a camera {min(missing)}, and {own.name!r} has none of that name"
        )
    return {
        name: own.cameras[name].model_copy(
            update={key: getattr(camera, key) for key in _CAMERA if key in type(camera).model_fields}
        )
        for name, camera in recorded.cameras.items()
    }


def _check_kind(recorded: StandConfig, own: StandConfig, session: Path) -> None:
    if (recorded.simulation is None) != (own.simulation is None):
        kinds = {True: "a real stand", False: "a simulated one"}
        raise ConfigError(
            f"{session}: was recorded on {kinds[recorded.simulation is None]}, and {own.name!r} is "
            f"{kinds[own.simulation is None]}; give this stand's configuration with --config"
        )


def _find_differences(before: Mapping[str, Any], now: Mapping[str, Any], above: str = "") -> Iterator[Difference]:
    """Every value that is not the same, by its path; what one of both has not at all, such as a thermometer of that
    name, as a whole."""
    for name in dict.fromkeys((*before, *now)):
        value, own, path = before.get(name), now.get(name), f"{above}{name}"
        if isinstance(value, dict) and isinstance(own, dict):
            yield from _find_differences(cast("dict[str, Any]", value), cast("dict[str, Any]", own), f"{path}.")
        elif value != own:
            yield Difference(path, value, own)


def _format_value(value: object) -> str:
    text = "not given" if value is None else json.dumps(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."
