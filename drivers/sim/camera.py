"""A GigE Vision camera on an address of its own: GVCP and GVSP in front, plant and renderer behind.

Heat, exposure and triggers are on the simulated clock; the heartbeat and the pace of the packets are real time, as they
are for the peer. One lock, the plant's, guards the camera's state; rendering and sending happen outside of it.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.clock import NS_PER_S, seconds_ns
from drivers.sim import gvcp, gvsp
from drivers.sim.camera_registers import Registers
from drivers.sim.genicam import MAX_RATE_Hz, features
from drivers.sim.gvcp import Nack, Resend, Status
from drivers.sim.gvcp_device import ControlChannel
from drivers.sim.gvsp_sender import CameraFaults, StreamCounts, StreamSender

Render = Callable[[int, float, float], NDArray[np.uint8]]

WIDTH_px, HEIGHT_px = 2448, 2048
_TICK_s = 0.1  # how often the heartbeat is looked at
_RESOLUTION_K = 0.25
_SHORT_IDS = 0xFFFF
_TIMING = ("ExposureTime", "AcquisitionFrameRate", "AcquisitionFrameRateEnable", "TriggerMode", "TriggerSource")


class CameraPlant(Protocol):
    """What the camera needs of the plant."""

    @property
    def lock(self) -> threading.RLock: ...  # noqa: D102 - see drivers/sim/plant.py, also below
    @property
    def on_step(self) -> list[Callable[[int, float], None]]: ...  # noqa: D102
    @property
    def camera_powered(self) -> bool: ...  # noqa: D102
    @property
    def sensor_degC(self) -> float: ...  # noqa: D102
    @property
    def body_degC(self) -> float: ...  # noqa: D102
    def advance(self, now_ns: int) -> None: ...  # noqa: D102


class SimulatedClock(Protocol):
    """What the camera needs of a clock."""

    def now_ns(self) -> int:
        """ns since the epoch."""
        ...


@dataclass(frozen=True)
class _Shot:
    """One exposure; `index` counts frames from 0 at the start of the acquisition, missed ones included."""

    acquisition: int
    index: int
    start_ns: int
    exposure_ns: int
    gain_dB: float


class FakeCamera:
    """The camera with serial number `serial` at UDP `address`:3956.

    `render(time_ns, exposure_s, gain_dB)` gives the image of an exposure whose middle is time_ns: uint8, shape
    (height, width) of the sensor. With `real_time` a frame leaves when its exposure has ended on the clock; without, a
    triggered frame leaves at once (virtual time stands still meanwhile) and a free-running one after `advance`.
    Timestamps are ns since power-on, at the start of the exposure. `boot_s` is simulated time. `faults` and `counts`
    are open to all.
    """

    def __init__(
        self,
        plant: CameraPlant,
        clock: SimulatedClock,
        render: Render,
        address: str,
        serial: str,
        *,
        size_px: tuple[int, int] = (WIDTH_px, HEIGHT_px),
        real_time: bool = False,
        pace_MBps: float = 40.0,
        boot_s: float = 3.0,
        extended_ids: bool = False,
        faults: CameraFaults | None = None,
    ) -> None:
        self._plant = plant
        self._clock = clock
        self._render = render
        self._real_time = real_time
        self._boot_ns = seconds_ns(boot_s)
        self._extended_ids = extended_ids
        self.faults = faults or CameraFaults()
        self._registers = Registers(features(*size_px, serial), address, serial)
        self._channel = ControlChannel(self._registers, self)
        self._control = _bound(address, gvcp.PORT)
        self._control.settimeout(_TICK_s)
        self._stream = _bound(address, 0)
        self._sender = StreamSender(self._stream, self.faults, pace_MBps)
        self._powered = plant.camera_powered
        self._powered_ns = self._ready_ns = clock.now_ns()
        self._acquisition = 0
        self._streaming = False
        self._anchor_ns = 0
        self._anchor_index = self._next_index = 0
        self._triggered: deque[_Shot] = deque()
        self._wake = threading.Condition(plant.lock)
        self._closed = False
        self._threads = [
            threading.Thread(target=self._serve, name=f"gvcp {address}", daemon=True),
            threading.Thread(target=self._expose, name=f"camera {address}", daemon=True),
        ]
        self._effects: dict[str, Callable[[], None]] = {
            "AcquisitionStart": self._start_acquisition,
            "AcquisitionStop": self._stop_acquisition,
            "TriggerSoftware": self._trigger,
            "GevSCPSFireTestPacket": self._fire_test_packet,
            "GevTimestampControlLatch": self._latch_timestamp,
            "GevTimestampControlReset": self._reset_timestamp,
            "DeviceReset": self._restart,
            **dict.fromkeys(("Width", "Height", "PixelFormat"), self._resize),
            **dict.fromkeys(_TIMING, self._reschedule),
        }
        plant.on_step.append(self._on_step)

    @property
    def counts(self) -> StreamCounts:
        """Packets sent, lost and repeated so far."""
        return self._sender.counts

    @property
    def streaming(self) -> bool:
        """An acquisition is running."""
        return self._streaming

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
            self._plant.on_step.remove(self._on_step)
        self._sender.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()
        self._control.close()
        self._stream.close()

    def advance(self, now_ns: int) -> None:
        """The clock has moved: note a change of power, wake the free run. Returns at once."""
        with self._wake:
            self._observe_power(now_ns)
            self._wake.notify_all()

    # ------------------------------------------------------------------------------------------------------- power

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        self._observe_power(time_ns)

    def _observe_power(self, now_ns: int) -> None:
        if self._plant.camera_powered == self._powered:
            return
        self._powered = self._plant.camera_powered
        self._lose_everything()
        self._powered_ns, self._ready_ns = now_ns, now_ns + self._boot_ns

    def _restart(self) -> None:
        self._lose_everything()
        self._powered_ns = self._clock.now_ns()
        self._ready_ns = self._powered_ns + self._boot_ns

    def _lose_everything(self) -> None:
        self._channel.forget()
        self.control_ended()
        self._registers.reset()

    def _alive(self, now_ns: int) -> bool:
        return self._powered and now_ns >= self._ready_ns

    # ----------------------------------------------------------------------------------------------------- control

    def _serve(self) -> None:
        while not self._closed:
            try:
                datagram, peer = self._control.recvfrom(2048)
            except TimeoutError:
                with self._plant.lock:
                    self._channel.check_heartbeat(time.monotonic())
                continue
            reply = self._reply(datagram, peer)
            if reply:
                self._control.sendto(reply, peer)

    def _reply(self, datagram: bytes, peer: tuple[str, int]) -> bytes:
        with self._plant.lock:
            now_ns = self._clock.now_ns()
            self._plant.advance(now_ns)
            self._observe_power(now_ns)
            self._channel.check_heartbeat(time.monotonic())
            if self.faults.silent_gvcp or not self._alive(now_ns):
                return b""
            self._registers.offer_resend(not self.faults.no_resend)
            return self._channel.feed(datagram, peer, time.monotonic())

    def before_read(self, address: int, count: int) -> None:
        """Measure the temperature when its register is read."""
        if not self._registers.covers("DeviceTemperature", address, count):
            return
        if self.faults.temperature == "access":
            raise Nack(Status.ACCESS_DENIED, "the temperature sensor does not answer")
        if self.faults.temperature == "stuck":
            return
        sensor = self._registers.integer("DeviceTemperatureSelector") == 0
        temperature_degC = self._plant.sensor_degC if sensor else self._plant.body_degC
        if self.faults.temperature == "zero":
            temperature_degC = 0.0
        self._registers.put("DeviceTemperature", round(temperature_degC / _RESOLUTION_K) * _RESOLUTION_K)

    def after_write(self, name: str) -> None:
        """Do what a command says, or what follows from a changed feature."""
        effect = self._effects.get(name)
        if effect is not None:
            effect()

    def resend(self, resend: Resend) -> None:
        """Queue packets once more."""
        self._sender.resend(resend)

    def control_ended(self) -> None:
        """Stop streaming: nobody is there to receive."""
        self._stop_acquisition()
        self._sender.abandon()

    def _resize(self) -> None:
        pixels = self._registers.integer("Width") * self._registers.integer("Height")
        mono12 = self._registers.integer("PixelFormat") == gvsp.PixelFormat.MONO12
        self._registers.put("PayloadSize", pixels * (2 if mono12 else 1))

    def _latch_timestamp(self) -> None:
        self._registers.put("GevTimestampValue", self._clock.now_ns() - self._powered_ns)

    def _reset_timestamp(self) -> None:
        self._powered_ns = self._clock.now_ns()

    def _destination(self) -> tuple[str, int]:
        address = self._registers.integer("GevSCDA").to_bytes(4, "big")
        return socket.inet_ntoa(address), self._registers.integer("GevSCPHostPort")

    def _fire_test_packet(self) -> None:
        """One packet of exactly the packet size, so that the client learns whether it gets through."""
        size_bytes = self._registers.integer("GevSCPSPacketSize") - gvsp.IP_UDP_HEADER_bytes
        if self._destination()[1] and not self.faults.silent_gvsp:
            self._stream.sendto(bytes(size_bytes), self._destination())

    # ------------------------------------------------------------------------------------------------- acquisition

    def _start_acquisition(self) -> None:
        if self._streaming:
            return
        self._acquisition += 1
        self._streaming = True
        self._registers.put("TLParamsLocked", 1)
        self._anchor_ns = self._clock.now_ns()
        self._anchor_index = self._next_index = 0
        self._wake.notify_all()

    def _stop_acquisition(self) -> None:
        self._acquisition += 1
        self._streaming = False
        self._triggered.clear()
        self._registers.put("TLParamsLocked", 0)

    def _reschedule(self) -> None:
        """The rate or the trigger was changed: the free run goes on from here."""
        self._anchor_ns, self._anchor_index = self._clock.now_ns(), self._next_index
        self._wake.notify_all()

    def _trigger(self) -> None:
        """A software trigger; without effect unless the camera waits for one."""
        if not self._streaming or not self._triggering() or self._registers.integer("TriggerSource") != 0:
            return
        for _ in range(2 if self.faults.trigger_twice else 1):
            self._triggered.append(self._shot(self._next_index, self._clock.now_ns()))
            self._next_index += 1
        self._wake.notify_all()

    def _triggering(self) -> bool:
        return self._registers.integer("TriggerMode") == 1

    def _shot(self, index: int, start_ns: int) -> _Shot:
        return _Shot(self._acquisition, index, start_ns, self._exposure_ns(), self._registers.real("Gain"))

    def _exposure_ns(self) -> int:
        return round(self._registers.real("ExposureTime") * 1000)

    def _period_ns(self) -> int:
        """Of the free run: as asked for, but never shorter than the exposure."""
        enabled = self._registers.integer("AcquisitionFrameRateEnable")
        rate_Hz = self._registers.real("AcquisitionFrameRate") if enabled else MAX_RATE_Hz
        return max(round(NS_PER_S / rate_Hz), self._exposure_ns())

    def _due(self, now_ns: int) -> tuple[_Shot | None, int]:
        """The exposure to read out now, if any, and when to look again (ns)."""
        if not self._streaming or not self._alive(now_ns):
            return None, now_ns + NS_PER_S
        if self._triggering():
            if not self._triggered:
                return None, now_ns + NS_PER_S
            end_ns = self._triggered[0].start_ns + self._triggered[0].exposure_ns
            if self._real_time and end_ns > now_ns:
                return None, end_ns
            return self._triggered.popleft(), now_ns
        return self._free_running(now_ns)

    def _free_running(self, now_ns: int) -> tuple[_Shot | None, int]:
        """The latest frame whose exposure has ended; those missed in between only cost their ids."""
        period_ns, exposure_ns = self._period_ns(), self._exposure_ns()
        frames = math.floor((now_ns - exposure_ns - self._anchor_ns) / period_ns)
        if self._anchor_index + frames < self._next_index:
            frames = self._next_index - self._anchor_index
            return None, self._anchor_ns + frames * period_ns + exposure_ns
        shot = self._shot(self._anchor_index + frames, self._anchor_ns + frames * period_ns)
        self._next_index = shot.index + 1
        return shot, now_ns

    def _next_shot(self) -> _Shot | None:
        """Wait for the next exposure to read out; None when the camera is closed."""
        with self._wake:
            while not self._closed:
                now_ns = self._clock.now_ns()
                shot, again_ns = self._due(now_ns)
                if shot is not None:
                    if self._registers.integer("AcquisitionMode") == 1:  # SingleFrame
                        self._streaming = False
                        self._registers.put("TLParamsLocked", 0)
                    return shot
                self._wake.wait((again_ns - now_ns) / NS_PER_S if self._real_time else None)
        return None

    def _expose(self) -> None:
        self._render(self._clock.now_ns(), 0.001, 0.0)  # the first image is slow: not within an acquisition
        while (shot := self._next_shot()) is not None:
            middle_ns = shot.start_ns + shot.exposure_ns // 2
            image = self._render(middle_ns, shot.exposure_ns / NS_PER_S, shot.gain_dB)
            self._send(shot, image)

    def _send(self, shot: _Shot, image: NDArray[np.uint8]) -> None:
        with self._plant.lock:
            destination = self._destination()
            if shot.acquisition != self._acquisition or destination[1] == 0:
                return
            block = self._block(shot, image)
            gap_s = self._registers.integer("GevSCPD") / NS_PER_S
        self._sender.send(block, destination, gap_s)

    def _block(self, shot: _Shot, image: NDArray[np.uint8]) -> gvsp.Block:
        value = self._registers.integer
        x, y, width, height = value("OffsetX"), value("OffsetY"), value("Width"), value("Height")
        pixels = image[y : y + height, x : x + width]
        if pixels.shape != (height, width):
            raise ValueError(f"the renderer gave {image.shape}, too small for {width} x {height} at ({x}, {y})")
        if value("PixelFormat") == gvsp.PixelFormat.MONO12:
            pixels = (pixels.astype(np.uint16) << 4).astype("<u2")
        leader = gvsp.Leader(shot.start_ns - self._powered_ns, value("PixelFormat"), width, height, x, y)
        block_id = shot.index + 1 if self._extended_ids else shot.index % _SHORT_IDS + 1
        return gvsp.Block(block_id, leader, memoryview(pixels.tobytes()), value("GevSCPSPacketSize"), self._extended_ids)


def _bound(address: str, port: int) -> socket.socket:
    """A UDP socket; OSError when the port is taken."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address, port))
    except OSError:
        opened.close()
        raise
    return opened
