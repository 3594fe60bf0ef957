"""What a camera is set to: the wish, writing it, reading it back, and where its temperature is found."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self, cast

from pydantic import Field, model_validator

from drivers.settings import CameraSettings, Identity
from drivers.wires.aravis import GigeDevice
from drivers.wires.aravis_library import DEVICE_ERRORS, GENICAM_ERRORS, AravisError
from foundation.addresses import IpAddress
from foundation.documents import Document
from foundation.errors import DeviceError, Refused, Unreachable
from foundation.readings import Cause

PixelFormat = Literal["Mono8", "Mono10", "Mono12", "Mono16"]
BYTES_PER_PIXEL: dict[PixelFormat, int] = {"Mono8": 1, "Mono10": 2, "Mono12": 2, "Mono16": 2}

# Bootstrap registers every GigE Vision camera has (GigE Vision 1.2, section 28).
VENDOR, MODEL, VERSION, SERIAL = (0x0048, 32), (0x0068, 32), (0x0088, 32), (0x00D8, 16)
HEARTBEAT_TIMEOUT_MS = 0x0938

# Wider than any sensor's quantisation (line time, 0.1..0.36 dB steps), narrower than a clamped value.
EXPOSURE_TOLERANCE, EXPOSURE_TOLERANCE_S = 0.01, 50e-6
GAIN_TOLERANCE_DB = 0.5
FRAME_RATE_TOLERANCE = 0.02

LEAST_RECEIVE_BUFFER_BYTES = 1 << 20
RECEIVE_BUFFER_LIMIT = Path("/proc/sys/net/core/rmem_max")

# Codes of arv-device-error-quark.
SILENT = {2, 4, 5, 6}  # not connected, transfer error, timeout, device not found
# Genicam data not found, no stream channel, busy: what a camera says, or Aravis for it, while it restarts. Every GigE
# Vision camera has its data and a stream channel; Aravis (arvgvdevice.c) takes a count it could not read for 0.
NOT_READY = {8, 9, 18}
NO_CONTROL = {10, 17}  # not controller, access denied
NO_CONTROL_HINT = "another client controls the camera, or one that died holds it until the heartbeat times out"


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


# GenICam SFNC 2, then Basler's older name.
USUAL_TEMPERATURES = tuple(
    TemperatureFeature(feature=name, selector=None, entry=None) for name in ("DeviceTemperature", "TemperatureAbs")
)


class GigeCameraSettings(CameraSettings):
    """A GigE Vision camera; all of it is written at each open.

    address: IP. packet_size: bytes of an IP packet; none lets Aravis find it. packet_delay_ns: pause between two
    packets, for a host or switch that loses some. heartbeat_s: the camera frees itself after so long without us
    (Aravis asks once a second). temperature: none looks for the usual features. resend: lost packets are asked for
    again. buffers: frames that the host keeps in reserve.
    """

    protocol: Literal["gige"] = "gige"
    address: IpAddress
    pixel_format: PixelFormat = "Mono8"
    packet_size: int | None = Field(default=None, ge=220, le=16112)
    packet_delay_ns: int = Field(default=0, ge=0, le=1_000_000_000)
    heartbeat_s: float = Field(default=3.0, ge=1.5, le=60)
    temperature: TemperatureFeature | None = None
    resend: bool = True
    buffers: int = Field(default=6, ge=1, le=100)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.temperature is not None and not self.has_temperature:
            raise ValueError("has_temperature is false, yet temperature says where it is; leave one of them out")
        return self

    @property
    def period_s(self) -> float:
        """Time between two frames of a free run."""
        return 1 / self.frame_rate_hz


@dataclass(frozen=True, slots=True)
class EffectiveSettings:
    """What the camera made of the settings; exposure and gain as it quantised them.

    receive_buffer_bytes: of the host's socket; below payload_bytes a camera that sends in bursts loses packets.
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


def lacks_control(error: AravisError) -> bool:
    """Whether it failed because we do not, or no longer, control the camera."""
    return error.domain == DEVICE_ERRORS and error.code in NO_CONTROL


def is_silence(error: AravisError) -> bool:
    """Whether the camera did not answer, in time or at all, or answered while it was not ready yet."""
    return error.domain == DEVICE_ERRORS and error.code in SILENT | NOT_READY


def device_error(name: str, error: AravisError) -> DeviceError:
    """The stand's error for what Aravis reported."""
    if error.domain == DEVICE_ERRORS:
        if is_silence(error):
            return Unreachable(name, str(error))
        if lacks_control(error):
            return Refused(name, f"{error} ({NO_CONTROL_HINT})")
        return Refused(name, f"{error} (Aravis device error {error.code})")
    if error.domain == GENICAM_ERRORS:
        return Refused(name, f"{error} (GenICam error {error.code})")
    return Unreachable(name, f"{error} ({error.domain} {error.code})")  # the host's network said no


def read_identity(device: GigeDevice) -> Identity:
    """Vendor, model, serial number and version."""
    return Identity(*(device.read_text(*register) for register in (VENDOR, MODEL, SERIAL, VERSION)))


def apply_settings(name: str, device: GigeDevice, settings: GigeCameraSettings) -> EffectiveSettings:
    """Write everything, read it back and compare; Refused when the camera did otherwise.

    Acquisition must be off: cameras lock region, pixel format and packet size while they stream.
    """
    heartbeat_s = _set_heartbeat(device, settings.heartbeat_s)
    width, height = _set_region(name, device, settings)
    device.set_continuous()
    for automatic in ("ExposureAuto", "GainAuto"):
        if device.available(automatic):
            device.set_string(automatic, "Off")
    exposure_s = set_exposure(name, device, settings.exposure_s)
    gain_dB = _set_gain(name, device, settings.gain_dB)
    frame_rate_hz = _set_trigger(name, device, settings)
    packet_size, packet_delay_ns = _set_packets(name, device, settings)
    payload_bytes = device.payload_bytes()  # last: it follows from region, format and chunks
    return EffectiveSettings(
        width_px=width,
        height_px=height,
        pixel_format=settings.pixel_format,
        exposure_s=exposure_s,
        gain_dB=gain_dB,
        frame_rate_hz=frame_rate_hz,
        packet_size=packet_size,
        packet_delay_ns=packet_delay_ns,
        heartbeat_s=heartbeat_s,
        payload_bytes=payload_bytes,
        receive_buffer_bytes=_receive_buffer_bytes(payload_bytes),
    )


def set_exposure(name: str, device: GigeDevice, exposure_s: float) -> float:
    """Write the exposure; returns what the camera took. Refused when that is further off than quantisation explains."""
    feature = "ExposureTime" if device.available("ExposureTime") else "ExposureTimeAbs"
    device.set_float(feature, exposure_s * 1e6)
    effective_s = device.get_float(feature) / 1e6
    if abs(effective_s - exposure_s) > max(EXPOSURE_TOLERANCE * exposure_s, EXPOSURE_TOLERANCE_S):
        raise Refused(name, f"exposure {exposure_s:g} s was asked for, the camera took {effective_s:g} s")
    return effective_s


def _set_heartbeat(device: GigeDevice, heartbeat_s: float) -> float:
    """Through the bootstrap register: not every camera names it as a feature."""
    device.write_register(HEARTBEAT_TIMEOUT_MS, round(heartbeat_s * 1000))
    return device.read_register(HEARTBEAT_TIMEOUT_MS) / 1000


def _set_region(name: str, device: GigeDevice, settings: GigeCameraSettings) -> tuple[int, int]:
    """Pixel format and region, to the letter."""
    device.set_pixel_format(settings.pixel_format)
    if device.pixel_format() != settings.pixel_format:
        raise Refused(name, f"{settings.pixel_format} was asked for, the camera gives {device.pixel_format()}")
    sensor_width, sensor_height = device.sensor_size()
    wanted = (0, 0, settings.width_px or sensor_width, settings.height_px or sensor_height)
    device.set_region(*wanted)
    if device.region() != wanted:
        raise Refused(name, f"region (x, y, width, height) {wanted} was asked for, the camera took {device.region()}")
    return wanted[2], wanted[3]


def _set_gain(name: str, device: GigeDevice, gain_dB: float) -> float:
    """Gain in dB; a camera that counts it in steps of its own only does 0 dB, its lowest step."""
    for feature in ("Gain", "GainAbs"):
        if device.available(feature):
            device.set_float(feature, gain_dB)
            effective_dB = device.get_float(feature)
            if abs(effective_dB - gain_dB) > GAIN_TOLERANCE_DB:
                raise Refused(name, f"gain {gain_dB:g} dB was asked for, the camera took {effective_dB:g} dB")
            return effective_dB
    if gain_dB:
        raise Refused(name, f"gain {gain_dB:g} dB was asked for, the camera has no gain in dB")
    if device.available("GainRaw"):
        device.set_integer("GainRaw", device.integer_bounds("GainRaw")[0])
    return 0.0


def _set_trigger(name: str, device: GigeDevice, settings: GigeCameraSettings) -> float:
    """Software trigger or free run; returns the rate in force, the configured one with a trigger."""
    if settings.trigger == "software":
        device.set_trigger("Software")
        state = device.get_string("TriggerMode"), device.get_string("TriggerSource")
        if state != ("On", "Software"):
            raise Refused(name, f"a software trigger was asked for, the camera has mode {state[0]}, source {state[1]}")
        return settings.frame_rate_hz
    device.clear_triggers()
    if device.available("AcquisitionFrameRateEnable"):  # without it the rate is only a number
        device.set_boolean("AcquisitionFrameRateEnable", True)
    device.set_frame_rate(settings.frame_rate_hz)
    rate_hz = device.frame_rate_hz()
    if not math.isclose(rate_hz, settings.frame_rate_hz, rel_tol=FRAME_RATE_TOLERANCE):
        raise Refused(name, f"{settings.frame_rate_hz:g} frames/s were asked for, the camera gives {rate_hz:g}")
    return rate_hz


def _set_packets(name: str, device: GigeDevice, settings: GigeCameraSettings) -> tuple[int, int]:
    """Packet size and the pause between packets."""
    if settings.packet_size is None:
        device.find_packet_size()
    else:
        device.set_packet_size(settings.packet_size)
        if device.packet_size() != settings.packet_size:
            text = f"packets of {settings.packet_size} bytes were asked for, the camera takes {device.packet_size()}"
            raise Refused(name, text)
    if settings.packet_delay_ns or device.packet_delay_ns():
        device.set_packet_delay(settings.packet_delay_ns)
    return device.packet_size(), device.packet_delay_ns()


def _receive_buffer_bytes(payload_bytes: int) -> int:
    """What to ask of the kernel, which grants no more than net.core.rmem_max (raise it with sysctl).

    Twice a frame, because the kernel also counts what it adds to each packet (2.3 kB for 1.4 kB of image); Aravis' own
    choice is one frame, and small images lose packets.
    """
    wanted_bytes = max(2 * payload_bytes, LEAST_RECEIVE_BUFFER_BYTES)
    try:
        return min(wanted_bytes, int(RECEIVE_BUFFER_LIMIT.read_text(encoding="ascii")))
    except (OSError, ValueError):  # not Linux
        return wanted_bytes


def find_temperature(device: GigeDevice, wanted: TemperatureFeature | None) -> tuple[TemperatureFeature | None, str]:
    """The place to read the temperature from, its selector set; or None and why there is none.

    AravisError when the camera does not answer: then nothing is known about it.
    """
    for place in (wanted,) if wanted else USUAL_TEMPERATURES:
        try:
            if place.feature is not None and not device.available(place.feature):
                continue
            if place.selector is not None and place.entry is not None:
                device.set_string(place.selector, place.entry)  # once: selector and value are two transactions
        except AravisError as error:
            if is_silence(error):
                raise
            return None, f"{_named(place)} cannot be read ({error}){_offered(device, place)}"
        return place, ""
    names = [place.feature or "" for place in ((wanted,) if wanted else USUAL_TEMPERATURES)]
    return None, f"the camera has no {' and no '.join(names)}"


def temperature_place(device: GigeDevice, place: TemperatureFeature) -> str:
    """Where that is, and what the camera offers for its selector, in words."""
    return f"{_named(place)}{_offered(device, place)}"


def _named(place: TemperatureFeature) -> str:
    if place.feature is None:
        return f"register {place.register_address or 0:#x}"
    return place.feature if place.selector is None else f"{place.feature} of {place.selector} {place.entry!r}"


def _offered(device: GigeDevice, place: TemperatureFeature) -> str:
    """What the camera offers for the selector, as the end of a sentence; "" when there is none, or it does not say."""
    try:
        entries = device.entries(place.selector) if place.selector is not None else ()
    except AravisError:
        return ""
    return f"; for {place.selector} the camera offers {', '.join(entries)}" if entries else ""


def read_temperature(device: GigeDevice, place: TemperatureFeature) -> tuple[float, str, Cause]:
    """Temperature in degC and ""; or NaN, the reason and its cause. Never raises: a run continues without it."""
    try:
        if place.register_address is not None:
            value_degC = (device.read_register(place.register_address) & place.mask) * place.scale + place.offset
        else:
            value_degC = device.get_float(place.feature or "")
    except AravisError as error:
        return math.nan, str(error), "wire" if is_silence(error) else "device"
    if value_degC == 0.0:  # what a faulty firmware shows; a sensor beside its own electronics is warmer
        return math.nan, "the camera shows exactly 0 degC", "device"
    if not place.min_degC <= value_degC <= place.max_degC:
        return math.nan, f"{value_degC:g} degC is outside {place.min_degC:g}..{place.max_degC:g}", "device"
    return value_degC, "", ""
