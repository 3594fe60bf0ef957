"""The camera protocols: each is one file `camera_<protocol>.py` beside this one, with `Settings` and `Camera`.

`Settings` is a subclass of CameraSettings with `protocol: Literal["<protocol>"] = "<protocol>"`, and `Camera(name,
settings, clock)` is a protocols.Camera.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Union, cast

from pydantic import Discriminator, Tag

import thermostand.drivers.devices.cameras
from thermostand.drivers.devices.protocols import Camera
from thermostand.drivers.settings import CameraSettings
from thermostand.foundation.clock import Clock
from thermostand.foundation.document_faults import TAG

_PREFIX, _USUAL = "camera_", "gige"


class _Driver(Protocol):
    Settings: type[CameraSettings]

    def Camera(self, name: str, settings: Any, clock: Clock) -> Camera: ...


def _found() -> dict[str, _Driver]:
    names = sorted(module.name for module in pkgutil.iter_modules(thermostand.drivers.devices.cameras.__path__))
    return {
        name.removeprefix(_PREFIX): cast(
            "_Driver", importlib.import_module(f"thermostand.drivers.devices.cameras.{name}")
        )
        for name in names
        if name.startswith(_PREFIX)
    }


PROTOCOLS = _found()


def make_camera(name: str, settings: CameraSettings, clock: Clock) -> Camera:
    """The camera of these settings, not opened."""
    driver = next(driver for driver in PROTOCOLS.values() if type(settings) is driver.Settings)
    return driver.Camera(name, settings, clock)


def _protocol_of(value: object) -> object:
    if isinstance(value, dict):
        return f"{TAG}{cast('dict[str, object]', value).get('protocol', _USUAL)}"
    return f"{TAG}{getattr(value, 'protocol', None)}"


if TYPE_CHECKING:
    AnyCameraSettings = CameraSettings
elif len(PROTOCOLS) == 1:
    AnyCameraSettings = PROTOCOLS[_USUAL].Settings
else:
    _tagged = tuple(Annotated[driver.Settings, Tag(f"{TAG}{name}")] for name, driver in PROTOCOLS.items())
    _of_protocol = Discriminator(
        _protocol_of,
        custom_error_type="camera_protocol",
        custom_error_message=f"protocol has to be one of {', '.join(PROTOCOLS)}",
    )
    AnyCameraSettings = Annotated[Union[_tagged], _of_protocol]  # noqa: UP007 - of a tuple
