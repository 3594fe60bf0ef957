"""Writing a camera's settings in its own words, reading them back, and refusing what it did otherwise."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from thermostand.drivers.framing.aravis_library import AravisError
from thermostand.drivers.settings import Identity
from thermostand.drivers.wires import genicam_feature_names as words
from thermostand.drivers.wires.aravis import FLOAT_KINDS, GigeDevice
from thermostand.drivers.wires.camera_errors import is_silence
from thermostand.drivers.wires.camera_line import compute_packet_delay_ns
from thermostand.drivers.wires.camera_settings import AravisCameraSettings, EffectiveSettings, GigeCameraSettings
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import Refused

# Bootstrap registers every GigE Vision camera has (GigE Vision 1.2, section 28), whatever its features are called.
VENDOR, MODEL, VERSION, SERIAL = (0x0048, 32), (0x0068, 32), (0x0088, 32), (0x00D8, 16)
HEARTBEAT_TIMEOUT_MS = 0x0938
TICK_FREQUENCY_HIGH, TICK_FREQUENCY_LOW = 0x093C, 0x0940
PACKET_DELAY_TICKS = 0x0D08

# Wider than any sensor's quantisation (line time, 0.1..0.36 dB steps), narrower than a clamped value.
EXPOSURE_TOLERANCE, EXPOSURE_TOLERANCE_S = 0.01, 50e-6
# Cameras take gains in steps of their own. Round number; nothing was measured.
GAIN_TOLERANCE_DB = 0.5
# Round number; nothing was measured.
FRAME_RATE_TOLERANCE = 0.02

LEAST_HEARTBEAT_S = 1.2  # Aravis asks each second
LEAST_RECEIVE_BUFFER_BYTES = 1 << 20  # round number; nothing was measured
RECEIVE_BUFFER_LIMIT = Path("/proc/sys/net/core/rmem_max")


def read_identity(device: GigeDevice) -> Identity:
    """Vendor, model, serial number and version."""
    if device.is_gige:
        stated = [device.read_text(*register) for register in (VENDOR, MODEL, SERIAL, VERSION)]
    else:
        stated = [device.get_string(each) if (each := _find_feature(device, names)) else "" for names in words.IDENTITY]
    vendor, model, serial_number, version = stated
    return Identity(vendor, model, serial_number, version)


def apply_settings(name: str, device: GigeDevice, settings: AravisCameraSettings) -> EffectiveSettings:
    """Write everything, read it back and compare; Refused when the camera did otherwise, or lacks a feature.

    Acquisition must be off: cameras lock region, pixel format and packet size while they stream.
    """
    for feature in words.NECESSARY:
        if not device.kind(feature):
            raise Refused(name, f"the camera has no {feature}, without which there are no frames")
    heartbeat_s = (
        _set_heartbeat(name, device, settings.heartbeat_s) if isinstance(settings, GigeCameraSettings) else 0.0
    )
    _switch_trigger_off(device)  # first: some features are there without a trigger only
    width, height = _set_region(name, device, settings)
    _set_modes(device)
    exposure, step_s = find_exposure(name, device, settings)
    exposure_s = set_exposure(name, device, settings, settings.exposure_s)
    gain, gain_dB = _set_gain(name, device, settings.gain_dB)
    source, rate, frame_rate_hz = _set_trigger(name, device, settings)
    packet_size, delay_ns = _set_packets(name, device, settings) if isinstance(settings, GigeCameraSettings) else (0, 0)
    payload_bytes = round(device.get_number("PayloadSize"))  # last: it follows from region, format and chunks
    raw_step = f" x {step_s:g} s" if exposure == words.EXPOSURE_RAW else ""
    return EffectiveSettings(
        width_px=width,
        height_px=height,
        pixel_format=settings.pixel_format,
        exposure_s=exposure_s,
        gain_dB=gain_dB,
        frame_rate_hz=frame_rate_hz,
        packet_size=packet_size,
        packet_delay_ns=delay_ns,
        heartbeat_s=heartbeat_s,
        payload_bytes=payload_bytes,
        receive_buffer_bytes=_compute_receive_buffer_bytes(payload_bytes) if packet_size else 0,
        features={"exposure": exposure + raw_step, "gain": gain, "trigger": source, "frame_rate": rate},
    )


def find_exposure(name: str, device: GigeDevice, settings: AravisCameraSettings) -> tuple[str, float]:
    """The exposure's feature and the seconds of its unit; Refused when there is none, or nobody knows its unit."""
    feature = _find_feature(device, words.EXPOSURE)
    if not feature:
        raise Refused(name, f"the camera has no {' and no '.join(words.EXPOSURE)}: its exposure cannot be set")
    if feature != words.EXPOSURE_RAW:
        return feature, words.TIME_UNITS_S["us"]
    if settings.exposure_step_s is not None:
        return feature, settings.exposure_step_s
    unit_s = words.TIME_UNITS_S.get(device.unit(feature))
    if unit_s is None and (step := _find_feature(device, words.EXPOSURE_STEP_US)):
        unit_s = device.get_number(step) * words.TIME_UNITS_S["us"]
    if not unit_s:
        text = "the camera has no ExposureTime and no ExposureTimeAbs, and its ExposureTimeRaw states no unit"
        raise Refused(name, f"{text}; give exposure_step_s, the seconds of one step, from its manual")
    return feature, unit_s


def set_exposure(name: str, device: GigeDevice, settings: AravisCameraSettings, exposure_s: float) -> float:
    """Write the exposure; returns what the camera took. Refused when that is further off than quantisation explains."""
    feature, unit_s = find_exposure(name, device, settings)
    device.set_number(feature, exposure_s / unit_s)
    effective_s = device.get_number(feature) * unit_s
    step_s = 0.0 if device.kind(feature) in FLOAT_KINDS else unit_s
    if abs(effective_s - exposure_s) > max(EXPOSURE_TOLERANCE * exposure_s, EXPOSURE_TOLERANCE_S, step_s):
        raise Refused(name, f"exposure {exposure_s:g} s was asked for, the camera took {effective_s:g} s")
    return effective_s


def fire_software_trigger(device: GigeDevice) -> None:
    """Start one frame now."""
    device.execute("TriggerSoftware")


def _find_feature(device: GigeDevice, names: Iterable[str]) -> str:
    """The first that the camera offers, "" when it has none of them."""
    return next((name for name in names if device.available(name)), "")


def _list_offered(device: GigeDevice, feature: str) -> tuple[str, ...]:
    """Return what an enumeration offers; nothing when the camera has no such."""
    return device.entries(feature) if device.kind(feature) == "Enumeration" else ()


def _set_heartbeat(name: str, device: GigeDevice, heartbeat_s: float) -> float:
    """Set the heartbeat through the bootstrap register: not every camera names it as a feature. Refused when it would
    free itself between two of Aravis' requests."""
    device.write_register(HEARTBEAT_TIMEOUT_MS, round(heartbeat_s * 1000))
    taken_s = device.read_register(HEARTBEAT_TIMEOUT_MS) / 1000
    if taken_s < LEAST_HEARTBEAT_S:
        text = f"a heartbeat of {heartbeat_s:g} s was asked for, the camera took {taken_s:g} s"
        raise Refused(name, f"{text}, and is asked once a second: it would be lost again and again")
    return taken_s


def _switch_trigger_off(device: GigeDevice) -> None:
    """Switch every trigger off; a selector that refuses an entry is left as it is."""
    if not device.available("TriggerMode"):
        return
    for entry in _list_offered(device, "TriggerSelector") or ("",):
        try:
            if entry:
                device.set_string("TriggerSelector", entry)
            device.set_string("TriggerMode", "Off")
        except AravisError as error:
            if is_silence(error):
                raise


def _set_modes(device: GigeDevice) -> None:
    """Frames until a stop command, nothing automatic, the exposure timed."""
    pairs = [("AcquisitionMode", "Continuous"), words.TIMED, *((feature, "Off") for feature in words.AUTOMATICS)]
    for feature, entry in pairs:
        _choose(device, feature, entry)


def _choose(device: GigeDevice, feature: str, entry: str) -> None:
    """This entry, where the camera offers it now."""
    if device.available(feature) and entry in _list_offered(device, feature) and device.get_string(feature) != entry:
        device.set_string(feature, entry)


def _set_region(name: str, device: GigeDevice, settings: AravisCameraSettings) -> tuple[int, int]:
    """Pixel format, binning and region, to the letter."""
    formats = _list_offered(device, "PixelFormat")
    if settings.pixel_format not in formats:
        raise Refused(name, f"the camera has no PixelFormat {settings.pixel_format}, only {', '.join(formats)}")
    device.set_string("PixelFormat", settings.pixel_format)
    if device.get_string("PixelFormat") != settings.pixel_format:
        given = device.get_string("PixelFormat")
        raise Refused(name, f"{settings.pixel_format} was asked for, the camera gives {given}")
    for feature in words.BINNING:
        _set_whole(name, device, feature, settings.binning, usual=1)
    for feature in ("OffsetX", "OffsetY"):  # first: a larger size may not fit with the offset in force
        _set_whole(name, device, feature, 0, usual=0)
    width = settings.width_px or _find_largest(device, words.WIDTH_MAX, "Width") - settings.offset_x_px
    height = settings.height_px or _find_largest(device, words.HEIGHT_MAX, "Height") - settings.offset_y_px
    _set_whole(name, device, "Width", width)
    _set_whole(name, device, "Height", height)
    _set_whole(name, device, "OffsetX", settings.offset_x_px, usual=0)
    _set_whole(name, device, "OffsetY", settings.offset_y_px, usual=0)
    return width, height


def _set_whole(name: str, device: GigeDevice, feature: str, value: int, usual: int | None = None) -> None:
    """Write a number to the letter; a camera without the feature does the usual one only."""
    if usual is not None and not device.available(feature):
        if value == usual:
            return
        raise Refused(name, f"the camera has no {feature}, and {value} was asked for")
    if round(device.get_number(feature)) != value:
        device.set_number(feature, value)
    if (taken := round(device.get_number(feature))) != value:
        raise Refused(name, f"{feature} {value} was asked for, the camera took {taken}")


def _find_largest(device: GigeDevice, features: Iterable[str], size: str) -> int:
    """The sensor's size in px, as large as `size` may become."""
    feature = _find_feature(device, features)
    return round(device.get_number(feature) if feature else device.bounds(size)[1])


def _set_gain(name: str, device: GigeDevice, gain_dB: float) -> tuple[str, float]:
    """The gain's feature and the gain in dB; a camera that counts it in steps of its own only does 0 dB, its lowest
    step."""
    feature = next((each for each in words.GAIN_DB if device.kind(each) in FLOAT_KINDS and device.available(each)), "")
    if feature:
        device.set_number(feature, gain_dB)
        effective_dB = device.get_number(feature)
        if abs(effective_dB - gain_dB) > GAIN_TOLERANCE_DB:
            raise Refused(name, f"gain {gain_dB:g} dB was asked for, the camera took {effective_dB:g} dB")
        return feature, effective_dB
    if gain_dB:
        raise Refused(name, f"gain {gain_dB:g} dB was asked for, the camera has no gain in dB")
    if raw := _find_feature(device, words.GAIN_RAW):
        device.set_number(raw, device.bounds(raw)[0])
    return raw, 0.0


def _set_trigger(name: str, device: GigeDevice, settings: AravisCameraSettings) -> tuple[str, str, float]:
    """Software trigger or free run: what starts a frame, the feature of the rate, and the rate in force, which is the
    configured one with a trigger."""
    if settings.trigger == "software":
        return _set_software_trigger(name, device), "", settings.frame_rate_hz
    if enable := _find_feature(device, words.FRAME_RATE_ON):  # without it the rate is only a number, or not there
        device.set_boolean(enable, True)
        _choose(device, words.FRAME_RATE_AUTO, "Off")  # offered from now on only: Point Grey
    _select_frame_trigger(name, device)
    paced = _start_frames_by(name, device, words.FIXED_RATE_SOURCES)
    feature = _find_feature(device, words.FRAME_RATE)
    if not feature:
        hint = "; take trigger: software" if device.kind("TriggerMode") and device.kind("TriggerSoftware") else ""
        raise Refused(name, f"the camera has no {' and no '.join(words.FRAME_RATE)}: it keeps no rate of ours{hint}")
    device.set_number(feature, _clamp(device, feature, settings.frame_rate_hz))
    rate_hz = device.get_number(feature)
    if not math.isclose(rate_hz, settings.frame_rate_hz, rel_tol=FRAME_RATE_TOLERANCE):
        raise Refused(name, f"{settings.frame_rate_hz:g} frames/s were asked for, the camera gives {rate_hz:g}")
    return paced, feature, rate_hz


def _clamp(device: GigeDevice, feature: str, value: float) -> float:
    """The value, or the nearest that the camera allows; it need not be able to say what it allows."""
    try:
        lowest, highest = device.bounds(feature)
    except AravisError as error:
        if is_silence(error):
            raise
        return value
    return min(max(value, lowest), highest)


def _set_software_trigger(name: str, device: GigeDevice) -> str:
    hint = "; take trigger: free_run" if any(device.kind(each) for each in words.FRAME_RATE) else ""
    for feature in ("TriggerMode", "TriggerSoftware"):
        if not device.kind(feature):
            raise Refused(name, f"the camera has no {feature}: it has no software trigger{hint}")
    if enable := _find_feature(device, words.FRAME_RATE_ON):
        device.set_boolean(enable, False)
    selector = _select_frame_trigger(name, device)
    source = _start_frames_by(name, device, words.SOFTWARE_SOURCES)
    if not source and device.kind("TriggerSource"):
        offered = ", ".join(_list_offered(device, "TriggerSource")) or "none"
        raise Refused(name, f"the camera has no TriggerSource Software; it offers {offered}{hint}")
    if not source:  # its only source
        device.set_string("TriggerMode", "On")
    if not device.available("TriggerSoftware"):
        raise Refused(name, f"the camera does not offer its TriggerSoftware now{hint}")
    return " ".join(each for each in (selector, source or "TriggerSoftware") if each)


def _select_frame_trigger(name: str, device: GigeDevice) -> str:
    """The trigger that starts a frame, by the selector's entry; "" when there is no choice."""
    offered = _list_offered(device, "TriggerSelector")
    if not offered:
        return ""
    selector = next((each for each in words.FRAME_TRIGGERS if each in offered), "")
    if not selector:
        raise Refused(name, f"the camera has no TriggerSelector FrameStart, only {', '.join(offered)}")
    if device.get_string("TriggerSelector") != selector:
        device.set_string("TriggerSelector", selector)
    return selector


def _start_frames_by(name: str, device: GigeDevice, sources: tuple[str, ...]) -> str:
    """The selected trigger is on, by the first of these sources that is offered; "" when none is: nothing is done."""
    offered = _list_offered(device, "TriggerSource")
    source = next((each for each in sources if each in offered), "")
    if not source:
        return ""
    device.set_string("TriggerMode", "On")
    device.set_string("TriggerSource", source)
    mode, taken = device.get_string("TriggerMode"), device.get_string("TriggerSource")
    if mode != "On" or taken not in sources:  # two names may stand for one
        raise Refused(name, f"a trigger by {source} was asked for, the camera has mode {mode}, source {taken}")
    return taken


def _set_packets(name: str, device: GigeDevice, settings: GigeCameraSettings) -> tuple[int, int]:
    """Packet size and the pause between packets, through the bootstrap registers where features are missing."""
    if settings.packet_size is None:
        device.find_packet_size()
    else:
        device.set_packet_size(settings.packet_size)
        if device.packet_size() != settings.packet_size:
            text = f"packets of {settings.packet_size} bytes were asked for, the camera takes {device.packet_size()}"
            raise Refused(name, text)
    frequency_Hz = device.read_register(TICK_FREQUENCY_HIGH) << 32 | device.read_register(TICK_FREQUENCY_LOW)
    delay_ns = settings.packet_delay_ns
    if delay_ns is None:
        delay_ns = compute_packet_delay_ns(device.packet_size(), settings.line_Mbps, settings.line_shared_by or 1)
    if delay_ns and not frequency_Hz:
        raise Refused(name, f"{delay_ns} ns between packets were asked for, the camera states no tick frequency")
    ticks = -(-delay_ns * frequency_Hz // NS_PER_S)
    if device.read_register(PACKET_DELAY_TICKS) != ticks:
        device.write_register(PACKET_DELAY_TICKS, ticks)
    taken = device.read_register(PACKET_DELAY_TICKS)
    return device.packet_size(), taken * NS_PER_S // frequency_Hz if frequency_Hz else 0


def _compute_receive_buffer_bytes(payload_bytes: int) -> int:
    """Return what to ask of the kernel, which grants no more than net.core.rmem_max (raise it with sysctl).

    Twice a frame, because the kernel also counts what it adds to each packet (2.3 kB for 1.4 kB of image); Aravis' own
    choice is one frame, and small images lose packets.
    """
    wanted_bytes = max(2 * payload_bytes, LEAST_RECEIVE_BUFFER_BYTES)
    try:
        return min(wanted_bytes, int(RECEIVE_BUFFER_LIMIT.read_text(encoding="ascii")))
    except (OSError, ValueError):  # not Linux
        return wanted_bytes
