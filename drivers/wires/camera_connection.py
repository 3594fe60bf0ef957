"""One opened camera and its stream, blocking; after any loss a new one is made.

Acquisition recipe: UDP socket with a receive buffer for a frame, lost packets asked for again until the frame is nearly
a period old, buffers given back right after the copy. Lives in one thread (the camera's lane).
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from dataclasses import dataclass

from thermostand.drivers.framing.aravis_library import AravisError
from thermostand.drivers.settings import Identity, check_same_device
from thermostand.drivers.wires.aravis import (
    BUFFER_STATUS,
    BUFFER_SUCCESS,
    G_TYPE_DOUBLE,
    G_TYPE_INT,
    G_TYPE_UINT,
    BufferInfo,
    GigeDevice,
    GigeStream,
    Pixels,
)
from thermostand.drivers.wires.camera_configuration import (
    TICK_FREQUENCY_HIGH,
    TICK_FREQUENCY_LOW,
    apply_settings,
    fire_software_trigger,
    read_identity,
    set_exposure,
)
from thermostand.drivers.wires.camera_errors import NO_CONTROL_HINT, is_silence
from thermostand.drivers.wires.camera_settings import AravisCameraSettings, GigeCameraSettings, TemperatureFeature
from thermostand.drivers.wires.frame_count import FrameCount
from thermostand.drivers.wires.genicam_feature_names import TEMPERATURE_ENTRIES, TEMPERATURES
from thermostand.foundation.addresses import get_display_address
from thermostand.foundation.clock import NS_PER_S, Clock, VirtualClock, block_until, to_ns
from thermostand.foundation.errors import Refused
from thermostand.foundation.readings import Cause

# Where a camera shows its own temperature, and reading it.

VERSION = 0x0000  # the bootstrap register that each camera has (GigE Vision 1.2, section 28)


@dataclass(frozen=True, slots=True)
class NoTemperature:
    """Why a camera's temperature is read nowhere. cause: "wire" when the camera did not answer for it."""

    reason: str
    cause: Cause = "device"


def find_temperature(device: GigeDevice, wanted: TemperatureFeature | None) -> TemperatureFeature | NoTemperature:
    """The place to read the temperature from, its selector set.

    AravisError when the camera does not answer for anything: then nothing is known about it.
    """
    try:
        places = [wanted] if wanted else _list_usual_features(device)
    except AravisError as error:
        return _make_no_temperature(device, "where its temperature is", error)
    for place in places:
        try:
            if place.feature is not None and not device.available(place.feature):
                continue
            if place.selector is not None and place.entry is not None:
                device.set_string(place.selector, place.entry)  # once: selector and value are two transactions
        except AravisError as error:
            return _make_no_temperature(device, _describe_place(place), error, _describe_offered(device, place))
        return place
    names = [wanted.feature or ""] if wanted else [feature for feature, _ in TEMPERATURES]
    return NoTemperature(f"the camera has no {' and no '.join(names)}")


def _make_no_temperature(device: GigeDevice, what: str, error: AravisError, offered: str = "") -> NoTemperature:
    """The error again when it is not for these features alone that the camera does not answer."""
    text = f"{what} cannot be read ({error}){offered}"
    if not is_silence(error):
        return NoTemperature(text)
    try:
        device.read_register(VERSION)
    except AravisError:
        raise error from None
    return NoTemperature(text, "wire")


def _list_usual_features(device: GigeDevice) -> list[TemperatureFeature]:
    """The makes' features, each with the entry nearest to the sensor that this camera's selector offers."""
    places: list[TemperatureFeature] = []
    for feature, selector in TEMPERATURES:
        offered = device.entries(selector) if selector and device.available(selector) else ()
        entry = next((entry for entry in TEMPERATURE_ENTRIES if entry in offered), None)
        places.append(TemperatureFeature(feature=feature, selector=selector if entry else None, entry=entry))
    return places


def describe_place(device: GigeDevice, place: TemperatureFeature) -> str:
    """Return where that is, and what the camera offers for its selector, in words."""
    return f"{_describe_place(place)}{_describe_offered(device, place)}"


def _describe_place(place: TemperatureFeature) -> str:
    if place.feature is None:
        return f"register {place.register_address or 0:#x}"
    return place.feature if place.selector is None else f"{place.feature} of {place.selector} {place.entry!r}"


def _describe_offered(device: GigeDevice, place: TemperatureFeature) -> str:
    """Return what the camera offers for the selector, as the end of a sentence; "" when there is none, or it does not
    say."""
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
            value_degC = device.get_number(place.feature or "")
    except AravisError as error:
        return math.nan, str(error), "wire" if is_silence(error) else "device"
    if value_degC == 0.0:  # what a faulty firmware shows; a sensor next to its own electronics is warmer
        return math.nan, "the camera shows exactly 0 degC", "device"
    if not place.min_degC <= value_degC <= place.max_degC:
        return math.nan, f"{value_degC:g} degC is outside {place.min_degC:g}..{place.max_degC:g}", "device"
    return value_degC, "", ""


# Aravis' stream: ask again for a missing packet after 1 ms, then every 40 ms, for as much of a frame as was lost.
INITIAL_PACKET_TIMEOUT_US = 1_000
PACKET_TIMEOUT_US = 40_000
PACKET_REQUEST_RATIO = 1.0  # of a frame's packets: all of them may be asked for again
FRAME_RETENTION_PERIODS = 0.9  # below 1, so that Aravis gives a frame up before we stop waiting for it
SOCKET_BUFFER_FIXED = 0

# Bootstrap registers (GigE Vision 1.2, section 28): who controls it; timestamp control and latched value.
CONTROL_PRIVILEGE, IN_CONTROL = 0x0A00, 0b11  # exclusive, or not
TIMESTAMP_CONTROL, TIMESTAMP_LATCH = 0x0944, 2
TIMESTAMP_HIGH, TIMESTAMP_LOW = 0x0948, 0x094C
# A latch whose question and answer took longer than 5 ms is repeated, and the best of three is kept.
LATCH_TRIES = 3
LATCH_GOOD_NS = 5_000_000  # a round trip; the error of the offset is half of it
# Twice as long, a time stamp may be off by 6 ms, still within STAMP_SLACK_NS.
LATCH_AGAIN_S = 60.0  # two quartzes 50 ppm apart: 3 ms

TEMPERATURE_AGAIN_S = 60.0  # between two looks that take the seconds of a time-out

# A time stamp may precede what it belongs to by the error of the latch, and never lies in the future.
STAMP_SLACK_NS = 20_000_000
FUTURE_NS = NS_PER_S

# A 5 MP frame takes 45 ms at 1 Gbit/s; the rest is for resends and a busy host. Round number; nothing was measured.
TRANSFER_TIMEOUT_S = 2.0  # real seconds beyond the exposure: read-out, 5 MB on the wire, resends, a busy host
# Held up by a busy host in the middle of a frame, a simulator lost it after 450 ms, and two runs of one seed differed.
# A run that never gets its frame pays a minute for this.
VIRTUAL_TIMEOUT_S = 20.0  # in virtual time a host that is busy must not make another session: a frame may stop half way
CONTROL_RETRY_S = 1.0  # round number; nothing was measured


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A complete frame as received. `start_ns`: begin of the exposure on the stand's clock."""

    image: Pixels
    start_ns: int
    exposure_s: float
    block_id: int
    camera_ticks: int
    dropped: int
    camera_degC: float


class Connection:
    """Opens the camera, takes control, writes the settings. AravisError, Refused; DeviceFault when it is not the camera
    that has `answered` before."""

    def __init__(
        self,
        name: str,
        settings: AravisCameraSettings,
        clock: Clock,
        frames: FrameCount,
        counts: Counter[str],
        answered: Identity | None = None,
    ) -> None:
        self.control_lost = threading.Event()
        self._name = name
        self._settings = settings
        self._clock = clock
        self._frames = frames
        self._counts = counts
        self._stream: GigeStream | None = None
        self._stream_counts: dict[str, int] = {}
        self._failed = 0  # attempts since the last good frame
        self._give_one_away = False
        self._free_run = settings.trigger == "free_run"
        self._is_virtual = isinstance(clock, VirtualClock)
        self._timeout_s = VIRTUAL_TIMEOUT_S if self._is_virtual else max(TRANSFER_TIMEOUT_S, 2 * settings.period_s)
        self._offset_ns: int | None = None  # stand clock minus camera clock; None: no useful time stamps
        self._latched_at_ns = 0
        self._stamped_ns = 0  # the last time stamp, on the camera's clock
        self._phase_ns = 0  # a begin of exposure in free run; the others lie whole periods away
        self._device = _open_with_control(name, settings)
        try:
            self._is_asked_for_control = self._is_virtual and self._device.is_gige
            if not self._is_asked_for_control:
                self._device.on_control_lost(self.control_lost.set)
            self.identity = read_identity(self._device)
            serial_number = self.identity.serial_number
            if settings.serial_number not in (None, serial_number):
                raise Refused(name, f"serial number {settings.serial_number} is expected, {serial_number} answers")
            check_same_device(name, self.identity, answered)
            self._stop_quietly()  # a client that died may have left it running, with its settings locked
            self.effective = apply_settings(name, self._device, settings)
            self._period_ns = to_ns(1 / self.effective.frame_rate_hz)
            self._exposure_asked_s = settings.exposure_s
            self._exposure_s = self.effective.exposure_s
            self._temperature = self._find_temperature()
            self._latch()
        except BaseException:
            self._device.close()
            raise

    @property
    def clock_began_ns(self) -> int | None:
        """The instant, on the stand's clock, at which the camera's clock read zero, which is when it started; None when
        it has none."""
        return self._offset_ns

    @property
    def running(self) -> bool:
        """Whether acquisition was started."""
        return self._stream is not None

    def check_control(self) -> None:
        """Ask who controls the camera, in virtual time: Aravis' heartbeat, which asks in real time, would make another
        session on a busy host."""
        if self._is_asked_for_control and not self.control_lost.is_set():
            try:
                is_held = bool(self._device.read_register(CONTROL_PRIVILEGE) & IN_CONTROL)
            except AravisError as error:
                is_held = not is_silence(error)
            if not is_held:
                self.control_lost.set()

    def close(self) -> None:
        """Stop and let go; never raises, takes up to 7.5 s when the camera is dead, 2.5 s when it is known to be."""
        self.stop()
        self._device.close()

    def start(self) -> None:
        """Acquire with a new stream; ends a running one."""
        self.stop()
        stream = self._device.create_stream()
        try:
            self._configure(stream)
            self._frames.restart(1 if self._device.is_gige else 0)
            self._latch()
            self._device.start_acquisition()
        except BaseException:
            stream.close()
            raise
        self._phase_ns = self._clock.now_ns()
        self._stream = stream

    def _configure(self, stream: GigeStream) -> None:
        if isinstance(self._settings, GigeCameraSettings):
            self._configure_packets(stream, self._settings)
        for _ in range(self._settings.buffers):
            stream.add_buffer(self.effective.payload_bytes)

    def _configure_packets(self, stream: GigeStream, settings: GigeCameraSettings) -> None:
        waited_s = self._timeout_s if self._is_virtual else 1 / self.effective.frame_rate_hz
        retention_s = FRAME_RETENTION_PERIODS * waited_s  # given up before we stop waiting for it
        stream.set_property("socket-buffer", SOCKET_BUFFER_FIXED, G_TYPE_INT)
        stream.set_property("socket-buffer-size", self.effective.receive_buffer_bytes, G_TYPE_INT)
        stream.set_property("packet-resend", int(settings.resend), G_TYPE_INT)
        stream.set_property("packet-request-ratio", PACKET_REQUEST_RATIO, G_TYPE_DOUBLE)
        stream.set_property("initial-packet-timeout", INITIAL_PACKET_TIMEOUT_US, G_TYPE_UINT)
        stream.set_property("packet-timeout", PACKET_TIMEOUT_US, G_TYPE_UINT)
        stream.set_property("frame-retention", round(retention_s * 1e6), G_TYPE_UINT)

    def stop(self) -> None:
        """End acquisition and its stream; never raises."""
        if self._stream is not None:
            if not self.control_lost.is_set():  # a silent camera is not asked five times more
                self._stop_quietly()
            self._count_stream(self._stream)
            self._stream.close()
            self._stream = None
            self._stream_counts = {}

    def _stop_quietly(self) -> None:
        try:
            self._device.stop_acquisition()
        except AravisError:
            self._counts["stop_errors"] += 1

    def prepare(self, exposure_s: float) -> None:
        """Set the exposure, throw away what came before, keep the camera's clock tied to ours."""
        self._set_exposure(exposure_s)
        self._discard()
        if self._offset_ns is None or self._clock.now_ns() - self._latched_at_ns > to_ns(LATCH_AGAIN_S):
            self._latch()
        self._give_one_away = self._free_run and self._offset_ns is None  # its exposure may have begun before the call

    def trigger(self, exposure_s: float, due_ns: int = 0) -> Shot | None:
        """One software trigger, not before `due_ns`, and its frame, or None when it did not come complete."""
        self.prepare(exposure_s)
        block_until(self._clock, due_ns)
        trigger_ns = self._clock.now_ns()
        fire_software_trigger(self._device)
        self._counts["triggers"] += 1
        return self._take(trigger_ns, self._exposure_s + self._timeout_s)

    def take_next_free(self, newer_than_ns: int) -> Shot | None:
        """The next complete frame whose exposure began at or after an instant, or None when none came in time."""
        shot = self._take(newer_than_ns, self._timeout_s)
        if shot is not None and self._offset_ns is not None:
            self._phase_ns = shot.start_ns
        return shot

    def next_frame_due_ns(self, time_ns: int) -> int:
        """Return when the first free-run frame that begins at or after `time_ns` has been exposed."""
        periods = -((self._phase_ns - time_ns) // self._period_ns)  # rounded up
        begin_ns = self._phase_ns + periods * self._period_ns
        return begin_ns + to_ns(self._exposure_s)

    def temperature(self) -> tuple[float, str, Cause]:
        """The camera's temperature in degC and "", or NaN, the reason and who says so. A place that was not found is
        looked for again, since a camera may refuse its selector for a while; where that had to be waited for, not
        before a minute has passed."""
        place = self._temperature
        is_slow = isinstance(place, NoTemperature) and place.cause == "wire"
        if not is_slow or self._clock.now_ns() - self._looked_ns >= to_ns(TEMPERATURE_AGAIN_S):
            try:
                place = self._temperature = self._find_temperature() if isinstance(place, NoTemperature) else place
            except AravisError as error:
                return math.nan, str(error), "wire"
        if isinstance(place, NoTemperature):
            return math.nan, place.reason, place.cause
        return read_temperature(self._device, place)

    def temperature_place(self) -> str:
        """Return where the temperature is read, and what else the camera offers, in words; "" when it was not found."""
        place = self._temperature
        return "" if isinstance(place, NoTemperature) else describe_place(self._device, place)

    def _find_temperature(self) -> TemperatureFeature | NoTemperature:
        if not self._settings.has_temperature:
            return NoTemperature("the configuration says that this camera has no temperature")
        try:
            return find_temperature(self._device, self._settings.temperature)
        finally:
            self._looked_ns = self._clock.now_ns()

    def _discard(self) -> None:
        """Give back every finished frame unused."""
        stream = self._require_stream()
        while (buffer := stream.pop(0)) is not None:
            self._counts["stale"] += 1
            self._frames.advance(stream.info(buffer).frame_id)
            stream.push(buffer)

    def _require_stream(self) -> GigeStream:
        if self._stream is None:
            raise ValueError("acquisition is not running")
        return self._stream

    def _set_exposure(self, exposure_s: float) -> None:
        if exposure_s != self._exposure_asked_s:
            self._exposure_asked_s = math.nan  # unknown until the camera has taken it
            self._exposure_s = set_exposure(self._name, self._device, self._settings, exposure_s)
            self._exposure_asked_s = exposure_s

    def _take(self, newer_than_ns: int, timeout_s: float) -> Shot | None:
        """The next frame that is not stale, or None when it is late or not whole."""
        stream = self._require_stream()
        for _ in range(self._settings.buffers + 1):
            buffer = stream.pop(timeout_s)
            if buffer is None:
                self._counts["missed"] += 1
                break
            try:
                info = stream.info(buffer)
                image = self._copy_image(stream, buffer, info)
            finally:
                stream.push(buffer)
            self._frames.advance(info.frame_id)
            if image is None:
                break
            stamped_ns = self._to_stand_ns(info.timestamp_ns)
            if stamped_ns is not None and stamped_ns < newer_than_ns - STAMP_SLACK_NS:
                self._counts["stale"] += 1
                continue
            if stamped_ns is None and self._give_one_away:
                self._give_one_away = False
                self._counts["stale"] += 1
                return None
            return self._make_shot(stream, image, info.timestamp_ns, newer_than_ns, stamped_ns)
        self._failed += 1
        return None

    def _copy_image(self, stream: GigeStream, buffer: int, info: BufferInfo) -> Pixels | None:
        """The pixels in an array of their own, or None when the frame is not whole."""
        shape = self.effective.height_px, self.effective.width_px
        if info.status != BUFFER_SUCCESS:
            self._counts[f"incomplete_{BUFFER_STATUS.get(info.status, 'unknown')}"] += 1
            return None
        image = (
            stream.pixels(buffer, self.effective.pixel_format, shape) if (info.height, info.width) == shape else None
        )
        if image is None:
            self._counts["wrong_size"] += 1
            return None
        image.setflags(write=False)
        return image

    def _make_shot(
        self, stream: GigeStream, image: Pixels, camera_ticks: int, newer_than_ns: int, stamped_ns: int | None
    ) -> Shot:
        """The frame with its time, the losses before it, and the temperature right after it."""
        start_ns, dropped = newer_than_ns, self._failed
        if self._free_run:
            start_ns = self._clock.now_ns() - to_ns(self._exposure_s) if stamped_ns is None else stamped_ns
            if stamped_ns is not None:  # whole periods between the call and the frame were lost
                dropped = max(0, (stamped_ns - newer_than_ns) // self._period_ns)
        self._failed = 0
        self._counts["frames"] += 1
        self._count_stream(stream)
        temperature_degC, *_ = self.temperature()
        return Shot(image, start_ns, self._exposure_s, self._frames.total, camera_ticks, dropped, temperature_degC)

    def _count_stream(self, stream: GigeStream) -> None:
        """Add what Aravis counted since the last time."""
        now = stream.counters()
        for counter, value in now.items():
            self._counts[counter] += value - self._stream_counts.get(counter, 0)
        self._stream_counts = now

    def _to_stand_ns(self, timestamp_ns: int) -> int | None:
        """The camera's time stamp on the stand's clock, None when it is not to be believed: 0, before the last
        one, or in the future. The clocks are compared again before the next frame then."""
        if self._offset_ns is None:
            return None
        earlier_ns, self._stamped_ns = self._stamped_ns, timestamp_ns
        time_ns = timestamp_ns + self._offset_ns
        is_ahead = time_ns > self._clock.now_ns() + to_ns(self._exposure_s) + FUTURE_NS
        if timestamp_ns == 0 or timestamp_ns < earlier_ns or is_ahead:
            self._counts["bad_time_stamps"] += 1
            self._latched_at_ns = 0
            return None
        return time_ns

    def _latch(self) -> None:
        """Measure what the stand's clock is ahead of the camera's; the tightest of a few tries."""
        self._latched_at_ns = self._clock.now_ns()
        if not self._device.is_gige:
            return  # no such registers
        best_ns = None
        try:
            frequency_Hz = self._read_64(TICK_FREQUENCY_HIGH, TICK_FREQUENCY_LOW)
            for _ in range(LATCH_TRIES):
                before_ns = self._clock.now_ns()
                self._device.write_register(TIMESTAMP_CONTROL, TIMESTAMP_LATCH)
                round_trip_ns = self._clock.now_ns() - before_ns
                ticks = self._read_64(TIMESTAMP_HIGH, TIMESTAMP_LOW)
                if not ticks or not frequency_Hz:
                    self._offset_ns = None
                    return
                camera_ns = ticks * NS_PER_S // frequency_Hz
                if camera_ns < self._stamped_ns:  # its clock was set back
                    self._stamped_ns = 0
                if best_ns is None or round_trip_ns < best_ns:
                    best_ns = round_trip_ns
                    self._offset_ns = before_ns + round_trip_ns // 2 - camera_ns
                if round_trip_ns < LATCH_GOOD_NS:
                    return
        except AravisError:
            self._counts["latch_errors"] += 1  # the offset known so far stays

    def _read_64(self, high: int, low: int) -> int:
        return self._device.read_register(high) << 32 | self._device.read_register(low)


def _open_with_control(name: str, settings: AravisCameraSettings) -> GigeDevice:
    """The camera with us in control.

    A client that died keeps the camera until its heartbeat runs out: try for that long and a little more.
    """
    pause = threading.Event()
    wants_gige = isinstance(settings, GigeCameraSettings)
    for _ in range(math.ceil(settings.heartbeat_s + 2) if isinstance(settings, GigeCameraSettings) else 1):
        device = GigeDevice(settings.address)
        if device.is_gige != wants_gige:
            device.close()
            raise Refused(
                name, f"{get_display_address(settings.address)} is {'no' if wants_gige else 'a'} GigE Vision camera"
            )
        if device.is_controller():
            return device
        device.close()
        pause.wait(CONTROL_RETRY_S)
    raise Refused(name, f"no control: {NO_CONTROL_HINT}")
