"""What the settings of several devices have in common.

A driver's settings are one frozen model in its module: what a stand's file has, what is checked, what the driver takes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from thermostand.foundation.documents import Document
from thermostand.foundation.errors import DeviceFault
from thermostand.foundation.events import DEVICE_IDENTITY
from thermostand.foundation.items import Event

DeviceName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,30}$")]  # the first part of its channels
PollPeriod_s = Annotated[float, Field(gt=0, le=3600)]
Line = Annotated[
    str, Field(pattern=r"^[^\x00-\x1f\x7f-\x9f]*$", max_length=200)
]  # free text without control characters


def check_ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    """The bounds; ValueError unless the first is the lower."""
    if bounds[0] >= bounds[1]:
        raise ValueError(f"{bounds} is not in ascending order")
    return bounds


Range = Annotated[tuple[float, float], AfterValidator(check_ascending)]


class Polled(Document):
    """A device that is read every poll_s."""

    poll_s: PollPeriod_s = 1.0


class OnBus(Polled):
    """A unit on the Modbus bus; `registers` is a file in configs/registers."""

    registers: str
    unit: int = Field(ge=1, le=247)


class EquilibriumSettings(Document):
    """When a camera that was or may have been off is in thermal equilibrium again: its own temperature has moved by
    less than rate_K_per_min for duration_s; without a temperature, 5 x time_constant_s (of its slowest part) are
    over."""

    rate_K_per_min: float = Field(default=0.2, gt=0, le=5)
    duration_s: float = Field(default=600.0, ge=60, le=7200)
    time_constant_s: float = Field(default=1500.0, ge=10, le=36000)


class CameraSettings(Polled):
    """What the stand asks of a camera of any protocol (a file in drivers/devices), and where it is found.

    serial_number: refused when another camera answers; none takes any. width_px, height_px: from the sensor's first
    pixel; none the whole sensor. trigger: one frame per software trigger, or frames at frame_rate_hz all the time
    (constant self-heating). has_temperature: whether it measures its own temperature; false must be stated, a run needs
    no GOOD one then. boot_s: from its supply being switched on until it answers.
    ambient_degC: the lowest and the highest air that its data sheet allows; no set-point goes outside.
    ambient_K_per_min: how fast that air may change; no set-point changes faster.
    self_heating_K: how far above the air near it its own temperature is at rest, lowest and highest, negative for a
    cooled one; outside, its readings are suspect. None: above that air.
    lens: which one is on it, in words; recorded with each session.
    """

    address: str
    serial_number: str | None = Field(default=None, pattern=r"^[ -~]{1,16}$")  # as the bootstrap register holds it
    width_px: int | None = Field(default=None, ge=16, le=65535)
    height_px: int | None = Field(default=None, ge=16, le=65535)
    exposure_s: float = Field(default=0.1, gt=0, le=10)
    gain_dB: float = Field(default=0.0, ge=0, le=60)
    trigger: Literal["software", "free_run"] = "software"
    frame_rate_hz: float = Field(default=2.0, gt=0, le=1000)
    has_temperature: bool = True
    boot_s: float = Field(default=8.0, ge=0, le=600)
    ambient_degC: Range | None = None
    ambient_K_per_min: float | None = Field(default=None, gt=0, le=20)
    self_heating_K: Range | None = None
    lens: Line = ""
    equilibrium: EquilibriumSettings = EquilibriumSettings()


@dataclass(frozen=True, slots=True)
class Identity:
    """The device that has answered; a field that it does not report is "". by_map: vendor and model are those of a
    register map or profile, which the device itself does not tell."""

    vendor: str
    model: str
    serial_number: str
    version: str
    by_map: bool = False

    def __str__(self) -> str:
        details = [f"serial number {self.serial_number}"] if self.serial_number else []
        details += [f"version {self.version}"] if self.version else []
        named = " ".join(part for part in (self.vendor, self.model) if part) or "a device that does not tell its make"
        return ", ".join([f"{named} (by its register map)" if self.by_map else named, *details])

    def is_another_than(self, before: Identity) -> bool:
        """Return whether something that both state differs: one that states nothing cannot be distinguished from others
        of its kind."""
        pairs = (
            (self.vendor, before.vendor),
            (self.model, before.model),
            (self.serial_number, before.serial_number),
            (self.version, before.version),
        )
        return any(now and then and now != then for now, then in pairs)


def check_same_device(device: str, found: Identity, before: Identity | None) -> Identity:
    """Return what has answered; DeviceFault, which names both, when another one answered before: it was exchanged, and
    nothing is known of the new one."""
    if before is not None and found.is_another_than(before):
        raise DeviceFault(
            device, f"was exchanged: {found} answers where {before} answered before; not used until a new start"
        )
    return found


def make_identity_event(device: str, identity: Identity, now_ns: int, camera: CameraSettings | None = None) -> Event:
    """Make the event with the device's name, what it reports of itself, and of a camera the lens that its settings
    state ("" when they do not)."""
    data: dict[str, object] = {"device": device, **asdict(identity)}
    text = str(identity)
    if not identity.serial_number:
        text += "; it reports no serial number"
    if camera is not None:
        data["lens"] = camera.lens
        text += f", lens {camera.lens}" if camera.lens else ", its lens is not stated"
    return DEVICE_IDENTITY.at(now_ns, text, **data)
