"""A GigE Vision camera on an address of its own: GVCP and GVSP in front, plant and renderer behind.

Heat, exposure and triggers are on the simulated clock; the heartbeat and the pace of the packets are real time, as they
are for the peer. One lock, the plant's, guards the camera's state; rendering and sending happen outside of it.
"""

from __future__ import annotations

import math
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.gige import gvcp, gvsp
from thermostand.drivers.sim.gige.camera_registers import ControlChannel, Peer, Registers
from thermostand.drivers.sim.gige.genicam import TICKS_PER_S, MAX_RATE_Hz, make_features
from thermostand.drivers.sim.gige.genicam_file import GenicamFile
from thermostand.drivers.sim.gige.genicam_registers import GenicamRegisters
from thermostand.drivers.sim.gige.gvcp import GvcpStatus, Nack, Resend
from thermostand.drivers.sim.gige.gvsp import bin_pixels, encode_image
from thermostand.drivers.sim.gige.gvsp_sender import CameraFaults, StreamCounts, StreamSender
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.foundation.clock import NS_PER_S, PIECE_S, Now, boot_time_ns, to_ns

# When the camera exposes: software trigger and free run as a function of the clock; no thread, no socket.


_IDLE_ns = NS_PER_S
_SINGLE_FRAME = 1
_SOFTWARE = 0


@dataclass(frozen=True)
class Exposure:
    """One exposure, [start, start + exposure]; `index` counts from 0 at AcquisitionStart, missed frames included."""

    acquisition: int
    index: int
    start_ns: int
    exposure_ns: int
    gain_dB: float

    @property
    def middle_ns(self) -> int:
        """The instant that the image shows."""
        return self.start_ns + self.exposure_ns // 2


class Schedule:
    """The exposures of one camera; settings are read from its registers as they are needed.

    With `real_time` a triggered exposure is due when it has ended. Without, it is due at once: virtual time stands
    still while the client waits for its frame. A free-running exposure is always due when it has ended.
    """

    def __init__(self, registers: Registers, real_time: bool) -> None:
        self._registers = registers
        self._real_time = real_time
        self._acquisition = 0
        self._anchor_ns = 0
        self._anchor_index = self._next_index = 0
        self._triggered: deque[Exposure] = deque()
        self.streaming = False

    def start(self, now_ns: int) -> None:
        """AcquisitionStart."""
        if self.streaming:
            return
        self._acquisition += 1
        self._anchor_ns = now_ns
        self._anchor_index = self._next_index = 0
        self._set_streaming(True)

    def stop(self) -> None:
        """AcquisitionStop; exposures under way are lost."""
        self._acquisition += 1
        self._triggered.clear()
        self._set_streaming(False)

    def reschedule(self, now_ns: int) -> None:
        """The rate or the trigger was changed: the free run continues from here."""
        self._anchor_ns, self._anchor_index = now_ns, self._next_index

    def trigger(self, now_ns: int) -> None:
        """TriggerSoftware; without effect unless the camera waits for it."""
        if self.streaming and self._triggering() and self._registers.integer("TriggerSource") == _SOFTWARE:
            self._triggered.append(self._expose(self._next_index, now_ns))

    def is_current(self, shot: Exposure) -> bool:
        """The acquisition that the exposure belongs to has not been stopped."""
        return shot.acquisition == self._acquisition

    @property
    def is_free_running(self) -> bool:
        """It exposes as time goes on, without being triggered."""
        return self.streaming and not self._triggering()

    def due(self, now_ns: int) -> tuple[Exposure | None, int]:
        """The exposure to read out now, if any, and when to look again (ns)."""
        shot, again_ns = self._due(now_ns)
        if shot is not None and self._registers.integer("AcquisitionMode") == _SINGLE_FRAME:
            self._set_streaming(False)
        return shot, again_ns

    def _due(self, now_ns: int) -> tuple[Exposure | None, int]:
        if not self.streaming:
            return None, now_ns + _IDLE_ns
        return self._due_triggered(now_ns) if self._triggering() else self._due_free_running(now_ns)

    def _due_triggered(self, now_ns: int) -> tuple[Exposure | None, int]:
        if not self._triggered:
            return None, now_ns + _IDLE_ns
        end_ns = self._triggered[0].start_ns + self._triggered[0].exposure_ns
        if self._real_time and end_ns > now_ns:
            return None, end_ns
        return self._triggered.popleft(), now_ns

    def _due_free_running(self, now_ns: int) -> tuple[Exposure | None, int]:
        """The latest frame whose exposure has ended; those missed in between only cost their ids."""
        period_ns, exposure_ns = self._period_ns(), self._exposure_ns()
        latest = self._anchor_index + (now_ns - exposure_ns - self._anchor_ns) // period_ns
        index = max(latest, self._next_index)
        start_ns = self._anchor_ns + (index - self._anchor_index) * period_ns
        if latest < index:
            return None, start_ns + exposure_ns
        return self._expose(index, start_ns), now_ns

    def _expose(self, index: int, start_ns: int) -> Exposure:
        self._next_index = index + 1
        return Exposure(self._acquisition, index, start_ns, self._exposure_ns(), self._registers.real("Gain"))

    def _triggering(self) -> bool:
        return self._registers.integer("TriggerMode") == 1

    def _exposure_ns(self) -> int:
        return round(self._registers.real("ExposureTime") * 1000)

    def _period_ns(self) -> int:
        """The period of the free run: as asked for, but never shorter than the exposure."""
        enabled = self._registers.integer("AcquisitionFrameRateEnable")
        rate_Hz = self._registers.real("AcquisitionFrameRate") if enabled else MAX_RATE_Hz
        return max(round(NS_PER_S / rate_Hz), self._exposure_ns())

    def _set_streaming(self, streaming: bool) -> None:
        self.streaming = streaming
        self._registers.put("TLParamsLocked", int(streaming))


Render = Callable[[int, float, float, int], NDArray[np.uint8]]

WIDTH_px, HEIGHT_px = 2448, 2048

_TICK_s = 0.1  # how often the heartbeat is looked at
_RESOLUTION_K = 0.25
_PENDING_ms = 600  # longer than a client waits for an answer that was not announced
_SHORT_IDS = 0xFFFF
_TIMING = ("ExposureTime", "AcquisitionFrameRate", "AcquisitionFrameRateEnable", "TriggerMode", "TriggerSource")


class CameraThermometers(Protocol):
    """What a camera's temperatures are read from: the plant, or a camera's own physics."""

    @property
    def sensor_degC(self) -> float:
        """The temperature of the sensor chip."""
        ...

    @property
    def body_degC(self) -> float:
        """The temperature of the housing."""
        ...


class FakeCamera:
    """The camera with serial number `serial` at UDP `address`:3956.

    `render(time_ns, exposure_s, gain_dB, rows)` gives the upper rows of an exposure whose middle is time_ns: uint8,
    shape (rows, width of the sensor); it is called in a thread of the camera, without the plant's lock. With
    `real_time` a frame leaves when its exposure has ended on the clock; without, a triggered frame leaves at once
    (virtual time stands still meanwhile) and a free-running one after `advance`. Timestamps are ns since power-on, at
    the start of the exposure. `boot_s` is simulated time from power-on to the first answer; a camera that has power
    when it is built is ready. `faults` and `counts` are open to all. With `genicam` it shows that file's features
    instead of ours, and is a camera of that make to its client. `thermometers`: of its own, else the plant's.
    With `warms_up` it renders an image before it is asked for any: the first one is slow.
    """

    def __init__(
        self,
        plant: Plant,
        clock: Now,
        render: Render,
        address: str,
        serial: str,
        *,
        size_px: tuple[int, int] = (WIDTH_px, HEIGHT_px),
        real_time: bool = False,
        warms_up: bool = False,
        pace_MBps: float = 40.0,
        boot_s: float = 3.0,
        extended_ids: bool = False,
        faults: CameraFaults | None = None,
        genicam: GenicamFile | None = None,
        thermometers: CameraThermometers | None = None,
    ) -> None:
        self.address = address
        self._plant = plant
        self._thermometers = thermometers or plant
        self._clock = clock
        self._render = render
        self._real_time = real_time
        self._warms_up = warms_up
        self._boot_ns = to_ns(boot_s)
        self._extended_ids = extended_ids
        self.faults = faults or CameraFaults()
        self._control = _bind_socket(address, gvcp.PORT)
        self._control.settimeout(_TICK_s)
        self._stream = _bind_socket(address, 0)
        table = make_features(*size_px, serial, stream_port=self._stream.getsockname()[1])
        self._registers = (
            Registers(table, address, serial) if genicam is None else GenicamRegisters(table, address, serial, genicam)
        )
        self._channel = ControlChannel(self._registers, self)
        self._schedule = Schedule(self._registers, real_time)
        self._sender = StreamSender(self._stream, self.faults, pace_MBps)
        self._backwards_ns = 0
        self._supply = (plant.camera_powered, plant.camera_power_on_ns)
        self._ticks_from_ns = self._ready_ns = clock.now_ns()
        self._wake = threading.Condition(plant.lock)
        self._closed = False
        self._threads = [
            threading.Thread(target=self._serve, name=f"gvcp {address}", daemon=True),
            threading.Thread(target=self._expose, name=f"camera {address}", daemon=True),
        ]
        self._effects = self._effects_by_feature()

    def _effects_by_feature(self) -> dict[str, Callable[[int], None]]:
        """Return what writing a feature does at an instant, ns."""
        return {
            "AcquisitionStart": self._schedule.start,
            "AcquisitionStop": lambda now_ns: self._schedule.stop(),
            "TriggerSoftware": self._trigger,
            "GevSCPSFireTestPacket": self._fire_test_packet,
            "GevTimestampControlLatch": self._latch_timestamp,
            "GevTimestampControlReset": self._reset_timestamp,
            "DeviceReset": self._restart,
            "GevHeartbeatTimeout": self._shorten_heartbeat,
            **dict.fromkeys(("Width", "Height", "PixelFormat"), self._resize),
            **dict.fromkeys(_TIMING, self._schedule.reschedule),
        }

    @property
    def counts(self) -> StreamCounts:
        """Blocks and packets so far."""
        return self._sender.counts

    @property
    def unplayed(self) -> tuple[str, ...]:
        """Features of its GenICam file that no value of their registers makes work."""
        return self._registers.unplayed if isinstance(self._registers, GenicamRegisters) else ()

    @property
    def streaming(self) -> bool:
        """An acquisition is running."""
        return self._schedule.streaming

    def start(self) -> None:
        """Begin to answer."""
        self._sender.start()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop the threads and free the address."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._sender.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()
        self._control.close()
        self._stream.close()
        if isinstance(self._registers, GenicamRegisters):
            self._registers.close()

    def restart(self) -> None:
        """It restarts by itself: control and settings are lost."""
        with self._wake:
            self._restart(self._clock.now_ns())

    def seize(self, on: bool) -> None:
        """Put another client in control of it, until it lets go."""
        with self._wake:
            self._channel.seize(on)

    def advance(self, now_ns: int) -> None:
        """The clock has moved to now_ns: note a change of power, wake the free run. Returns at once."""
        with self._wake:
            self._observe_power(now_ns)
            if self._schedule.is_free_running:  # else no time, which moves often, makes anything due
                self._wake.notify_all()

    # ------------------------------------------------------------------------------------------------------- power

    def _observe_power(self, now_ns: int) -> None:
        """A supply that was off, however shortly, has cost control, settings and the frame under way."""
        supply = (self._plant.camera_powered, self._plant.camera_power_on_ns)
        if supply == self._supply:
            return
        self._supply = supply
        _, power_on_ns = supply
        self._restart(now_ns if power_on_ns is None else power_on_ns)

    def _restart(self, now_ns: int) -> None:
        self._channel.forget()
        self.control_ended()
        self._registers.reset()
        self._ticks_from_ns = now_ns
        self._ready_ns = now_ns + self._boot_ns

    def _alive(self, now_ns: int) -> bool:
        powered, _ = self._supply
        return powered and now_ns >= self._ready_ns

    # ----------------------------------------------------------------------------------------------------- control

    def _serve(self) -> None:
        while not self._closed:
            try:
                datagram, peer = self._control.recvfrom(2048)
            except TimeoutError:
                datagram, peer = b"", ("", 0)
            reply = self._reply(datagram, peer)
            if not reply:
                continue
            if self.faults.pending > 0:
                self.faults.pending -= 1
                self._control.sendto(gvcp.make_pending(datagram, 2 * _PENDING_ms), peer)
                threading.Event().wait(_PENDING_ms / 1000)
            for _ in range(2 if self.faults.acks_twice else 1):
                self._control.sendto(reply, peer)

    def _reply(self, datagram: bytes, peer: Peer) -> bytes:
        """The answer to a datagram; an empty one is a tick of the heartbeat timer."""
        with self._plant.at(self._clock) as now_ns:
            self._observe_power(now_ns)
            heard_s = boot_time_ns() / NS_PER_S  # a camera's timer runs on while the host is suspended
            self._channel.check_heartbeat(heard_s)
            if not datagram or self.faults.silent_gvcp or not self._alive(now_ns):
                return b""
            self._registers.offer_resend(not self.faults.no_resend)
            self._registers.offer_stream(not self.faults.no_stream_channel)
            return self._channel.feed(datagram, peer, heard_s)

    def before_read(self, address: int, count: int) -> None:
        """Measure the temperature when its register is read; what the clock says of itself may be wrong."""
        if self._registers.covers("GevTimestampTickFrequency", address, count):
            self._registers.put("GevTimestampTickFrequency", 0 if self.faults.no_ticks else TICKS_PER_S)
        if not self._registers.covers("DeviceTemperature", address, count):
            return
        fault = self.faults.temperature
        if fault == "access":
            raise Nack(GvcpStatus.ACCESS_DENIED, "the temperature sensor does not answer")
        if fault == "stuck":
            return
        sensor = self._registers.integer("DeviceTemperatureSelector") == 0
        chip_degC = self._thermometers.sensor_degC if sensor else self._thermometers.body_degC
        chip_degC += self.faults.temperature_offset_K
        shown_degC = (
            {"zero": 0.0, "nan": math.nan}[fault] if fault else round(chip_degC / _RESOLUTION_K) * _RESOLUTION_K
        )
        self._registers.put("DeviceTemperature", shown_degC)

    def after_write(self, name: str) -> None:
        """Do what a command says, or what follows from a changed feature."""
        effect = self._effects.get(name)
        if effect is not None:
            effect(self._clock.now_ns())
            self._wake.notify_all()

    def resend(self, resend: Resend) -> None:
        """Queue packets once more."""
        self._sender.resend(resend)

    def control_ended(self) -> None:
        """Stop streaming: there is no receiver."""
        self._schedule.stop()
        self._sender.abandon()

    def _trigger(self, now_ns: int) -> None:
        for _ in range(2 if self.faults.trigger_twice else 1):
            self._schedule.trigger(now_ns)

    def _resize(self, now_ns: int) -> None:
        pixels = self._registers.integer("Width") * self._registers.integer("Height")
        pixel_format = gvsp.PixelFormat(self._registers.integer("PixelFormat"))
        self._registers.put("PayloadSize", pixel_format.size_bytes(pixels) - self.faults.payload_short_bytes)

    def _shorten_heartbeat(self, now_ns: int) -> None:
        asked_ms = self._registers.integer("GevHeartbeatTimeout")
        self._registers.put("GevHeartbeatTimeout", min(asked_ms, self.faults.heartbeat_most_ms))

    def _latch_timestamp(self, now_ns: int) -> None:
        self._registers.put("GevTimestampValue", now_ns - self._ticks_from_ns)

    def _reset_timestamp(self, now_ns: int) -> None:
        self._ticks_from_ns = now_ns

    def _fire_test_packet(self, now_ns: int) -> None:
        """One packet of exactly the packet size, so that the client learns whether it gets through."""
        size_bytes = self._registers.integer("GevSCPSPacketSize") - gvsp.IP_UDP_HEADER_bytes
        destination = self._destination()
        if destination is not None and not self.faults.silent_gvsp:
            self._stream.sendto(bytes(size_bytes), destination)

    def _destination(self) -> Peer | None:
        """Return where the stream goes; None while the client has not opened its port."""
        port = self._registers.integer("GevSCPHostPort")
        address = socket.inet_ntoa(self._registers.integer("GevSCDA").to_bytes(4, "big"))
        return (address, port) if port else None

    # ------------------------------------------------------------------------------------------------------ images

    def _expose(self) -> None:
        if self._warms_up:
            self._render(self._clock.now_ns(), 0.001, 0.0, self._registers.integer("HeightMax"))
        while (shot := self._next_shot()) is not None:
            rows = self._registers.integer("OffsetY") + self._registers.integer("Height")
            rows = min(rows * self._registers.binning[1], self._registers.integer("HeightMax"))
            image = self._render(shot.middle_ns, shot.exposure_ns / NS_PER_S, shot.gain_dB, rows)
            self._send(shot, image)

    def _next_shot(self) -> Exposure | None:
        """Wait for the next exposure to read out; None when the camera is closed."""
        with self._wake:
            while not self._closed:
                now_ns = self._clock.now_ns()
                shot, again_ns = self._schedule.due(now_ns)
                if shot is not None:
                    return shot
                self._wake.wait(min((again_ns - now_ns) / NS_PER_S, PIECE_S) if self._real_time else None)
        return None

    def _send(self, shot: Exposure, image: NDArray[np.uint8]) -> None:
        """Send the image and return when it has left; nothing when the acquisition was stopped meanwhile."""
        with self._plant.lock:
            destination = self._destination()
            if destination is None or not self._schedule.is_current(shot):
                return
            gap_s = self._registers.integer("GevSCPD") / NS_PER_S
            sending = self._sender.begin(self._block(shot, image), destination, gap_s)
        sending.wait()

    def _block(self, shot: Exposure, image: NDArray[np.uint8]) -> gvsp.ImageBlock:
        value = self._registers.integer
        x, y, width, height = value("OffsetX"), value("OffsetY"), value("Width"), value("Height")
        pixels = bin_pixels(image, *self._registers.binning)[y : y + height, x : x + width]
        if pixels.shape != (height, width) and isinstance(self._registers, GenicamRegisters):
            # its file may have a larger sensor: dark beyond ours
            missing = (height - pixels.shape[0], width - pixels.shape[1])
            pixels = np.pad(pixels, [(0, each) for each in missing])
        if pixels.shape != (height, width):
            raise ValueError(f"the renderer gave {image.shape}, too small for {width} x {height} at ({x}, {y})")
        data = encode_image(pixels, gvsp.PixelFormat(value("PixelFormat")))
        leader = gvsp.Leader(self._stamp(shot.start_ns), value("PixelFormat"), width, height, x, y)
        block_id = shot.index + 1 if self._extended_ids else shot.index % _SHORT_IDS + 1
        return gvsp.ImageBlock(block_id, leader, memoryview(data), value("GevSCPSPacketSize"), self._extended_ids)

    def _stamp(self, start_ns: int) -> int:
        """The leader's time stamp; backwards: every exposure a second before the one before it."""
        if self.faults.stamp == "zero":
            return 0
        ticks = start_ns - self._ticks_from_ns
        if self.faults.stamp == "backwards":
            self._backwards_ns += NS_PER_S
            return max(1, ticks - 2 * self._backwards_ns)
        return ticks


def _bind_socket(address: str, port: int) -> socket.socket:
    """A UDP socket; OSError when the port is taken."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address, port))
    except OSError:
        opened.close()
        raise
    return opened
