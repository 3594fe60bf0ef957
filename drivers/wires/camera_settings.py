"""What a camera is set to: the wish as a stand's file has it, and what the camera made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Self, cast

from pydantic import Field, model_validator

from thermostand.drivers.settings import CameraSettings
from thermostand.foundation.addresses import IpAddress
from thermostand.foundation.documents import Document

PixelFormat = Literal[
    "Mono8", "Mono10", "Mono12", "Mono16", "Mono10Packed", "Mono12Packed", "Mono10p", "Mono12p"
]  # packed: two pixels in three bytes; p: as many as fit, without gaps
BITS_PER_PIXEL: dict[PixelFormat, int] = {
    "Mono8": 8,
    "Mono10": 16,
    "Mono12": 16,
    "Mono16": 16,
    "Mono10Packed": 12,
    "Mono12Packed": 12,
    "Mono10p": 10,
    "Mono12p": 12,
}


def frame_bytes(pixel_format: PixelFormat, count: int) -> int:
    """Bytes of `count` pixels, the last one begun counted as whole."""
    return -(-count * BITS_PER_PIXEL[pixel_format] // 8)


def significant_bits(pixel_format: PixelFormat) -> int:
    """The significant bits of a sample."""
    return int(pixel_format.removeprefix("Mono").removesuffix("Packed").removesuffix("p"))


class TemperatureFeature(Document):
    """Where the camera shows its temperature: a float feature (after `selector` is set to `entry`; null for a camera
    that has no selector), or a 32-bit register holding (value & mask) * scale + offset in degC. Outside
    min_degC..max_degC a value is not believed."""

    feature: str | None = Field(default="DeviceTemperature", min_length=1)
    selector: str | None = Field(default="DeviceTemperatureSelector", min_length=1)
    entry: str | None = Field(default="Sensor", min_length=1)
    register_address: int | None = Field(default=None, ge=0, le=0xFFFFFFFC, multiple_of=4)
    mask: int = Field(default=0xFFFFFFFF, ge=0, le=0xFFFFFFFF)
    scale: float = 1.0
    offset: float = 0.0
    min_degC: float = -40.0
    max_degC: float = 120.0

    @model_validator(mode="before")
    @classmethod
    def _register_instead_of_feature(cls, data: object) -> object:
        if isinstance(data, dict) and "register_address" in data:
            return {"feature": None, "selector": None, "entry": None, **cast("dict[str, object]", data)}
        return data

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.feature is None) == (self.register_address is None):
            raise ValueError("give exactly one of feature and register_address")
        if (self.selector is None) != (self.entry is None):
            raise ValueError("selector and entry go together")
        if self.min_degC >= self.max_degC:
            raise ValueError(f"min_degC {self.min_degC} is not below max_degC {self.max_degC}")
        return self


class AravisCameraSettings(CameraSettings):
    """A camera that Aravis opens; all of it is written at each open.

    temperature: none looks for the usual features. buffers: frames that the host keeps in reserve. offset_x_px,
    offset_y_px: the first pixel of the region, from which the image's pixels count. binning: so many by so many pixels
    become one, and all sizes count those. exposure_step_s: of one step of ExposureTimeRaw, from its manual, for a
    camera that reports its exposure no other way.
    """

    pixel_format: PixelFormat = "Mono8"
    offset_x_px: int = Field(default=0, ge=0, le=65535)
    offset_y_px: int = Field(default=0, ge=0, le=65535)
    binning: int = Field(default=1, ge=1, le=16)
    exposure_step_s: float | None = Field(default=None, gt=0, le=1)
    temperature: TemperatureFeature | None = None
    buffers: int = Field(default=6, ge=1, le=100)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.temperature is not None and not self.has_temperature:
            raise ValueError("has_temperature is false, yet temperature says where it is; leave one of them out")
        return self

    @property
    def period_s(self) -> float:
        """The time between two frames of a free run."""
        return 1 / self.frame_rate_hz


class Usb3CameraSettings(AravisCameraSettings):
    """A USB3 Vision camera, by the same calls of Aravis; none was seen. address: what Aravis calls it, its vendor and
    serial number or its GUID (`arv-tool-0.8` lists them)."""

    protocol: Literal["usb3"] = "usb3"
    address: Annotated[str, Field(pattern=r"^[ -~]{1,128}$")]


class GigeCameraSettings(AravisCameraSettings):
    """A GigE Vision camera.

    address: IP. packet_size: bytes of an IP packet; none lets Aravis find it. packet_delay_ns: pause between two
    packets; none computes it so that all cameras on the line fit. line_Mbps: rate of the line on which its
    packets reach the host. line_shared_by: so many cameras, itself included; none: all of the stand. heartbeat_s: the
    camera frees itself after so long without us (Aravis asks once a second). resend: lost packets are asked for again.
    """

    protocol: Literal["gige"] = "gige"
    address: IpAddress
    packet_size: int | None = Field(default=None, ge=220, le=16112)
    packet_delay_ns: int | None = Field(default=None, ge=0, le=1_000_000_000)
    line_Mbps: float = Field(default=1000.0, gt=0, le=100_000)
    line_shared_by: int | None = Field(default=None, ge=1, le=64)
    heartbeat_s: float = Field(default=3.0, ge=1.5, le=60)
    resend: bool = True


@dataclass(frozen=True, slots=True)
class EffectiveSettings:
    """What the camera made of the settings; exposure and gain as it quantised them.

    receive_buffer_bytes: of the host's socket; below payload_bytes a camera that sends in bursts loses packets. It,
    packets and heartbeat are 0 for a USB3 camera.
    features: which of the camera's own features do what, {"exposure": "ExposureTimeAbs", ...}; "" where it has none.
    """

    width_px: int
    height_px: int
    pixel_format: PixelFormat
    exposure_s: float
    gain_dB: float
    frame_rate_hz: float
    packet_size: int
    packet_delay_ns: int
    heartbeat_s: float
    payload_bytes: int
    receive_buffer_bytes: int
    features: Mapping[str, str]
