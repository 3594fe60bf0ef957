"""What the simulator process reads on its standard input: which fakes there are, and where each answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from thermostand.drivers.camera_preset import CameraPreset, Effect
from thermostand.drivers.sim.physics.optics import CameraKind
from thermostand.foundation.documents import Document


class CameraSpec(Document):
    """A camera; optics: none is as `camera_kind`. preset: the camera's own physics instead, with these effects, and its
    number where it is drawn. genicam: the file of another make, which it then shows. still: it
    renders a picture once and shows it from then on, for measurements of time on the machine that simulates."""

    address: str | None
    serial_number: str | None
    optics: CameraKind | None = None
    preset: CameraPreset | None = None
    effects: tuple[Effect, ...] = ()
    drawn: int | None = None
    genicam: Path | None = None
    still: bool = False


class DeviceSpec(Document):
    """A device. fake: its key in drivers.sim.fakes. settings: as the stand's file has them, and what its fake needs to
    know of the rest of that file."""

    fake: str
    settings: dict[str, Any]


class LaboratorySpec(Document):
    """What the simulator process reads on its standard input.

    Port 0, "serial:" without a path and a camera without an address stand for free ones. All cameras see the same.
    """

    virtual: bool
    control: str
    start_ns: int = Field(ge=0)
    seed: int
    camera_kind: CameraKind
    laboratory_degC: float
    chamber_seed: int | None = None
    bus: str
    devices: dict[str, DeviceSpec]
    camera_boot_s: float = Field(default=3.0, ge=0)
    faults: tuple[str, ...] = ()

    @property
    def cameras(self) -> dict[str, CameraSpec]:
        """By name."""
        return {
            name: CameraSpec.model_validate(each.settings)
            for name, each in self.devices.items()
            if each.fake == "cameras"
        }
