"""The camera the stand knows: grab a frame, read its temperature.

Nothing here waits on the wire by itself: `Connection` blocks, in the camera's own lane. When the camera is lost,
`Unreachable` is raised until `open` is called again; that makes everything new and writes every setting again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from thermostand.drivers.framing.aravis_library import AravisError
from thermostand.drivers.settings import Identity
from thermostand.drivers.wires.camera_connection import Connection, Shot
from thermostand.drivers.wires.camera_errors import device_error, lacks_control
from thermostand.drivers.wires.camera_settings import (
    AravisCameraSettings,
    EffectiveSettings,
    GigeCameraSettings,
    significant_bits,
)
from thermostand.drivers.wires.frame_count import FrameCount
from thermostand.foundation.clock import Clock, VirtualClock, to_ns
from thermostand.foundation.errors import DeviceError, Unreachable
from thermostand.foundation.readings import Frame, Reading, bad_reading
from thermostand.foundation.workers import Result, WorkerThread

Settings = GigeCameraSettings
ATTEMPTS = 3  # frames in a row that may fail before the camera counts as lost

_CLOCK_SLACK_S = 1.0  # its clock is read that well, and it is heard for longer than that before it may be lost


class AravisCamera:
    """A GigE or USB3 Vision camera under `name`; channels `<name>.image` and `<name>.temperature`."""

    def __init__(self, name: str, settings: AravisCameraSettings, clock: Clock) -> None:
        self._name = name
        self.settings = settings
        self._clock = clock
        self._lane: WorkerThread | None = None
        self._connection: Connection | None = None
        self._lost = ""
        self._has_opened = False  # since it was made, or closed
        self._heard_ns: int | None = None  # since then, too
        self.restarted = ""  # why it has, or may have, restarted between the last open and the one before; "" if not
        self._frames = FrameCount()
        self._counts: Counter[str] = Counter()
        self._answered: Identity | None = None  # the first time

    @property
    def name(self) -> str:
        """The configured name."""
        return self._name

    @property
    def identity(self) -> Identity:
        """Vendor, model, serial number and version; Unreachable before `open`."""
        return self._require_connection().identity

    @property
    def is_usable(self) -> bool:
        """Whether it is open and has not been lost since."""
        connection = self._connection
        return connection is not None and not self._lost and not connection.control_lost.is_set()

    @property
    def effective(self) -> EffectiveSettings:
        """The settings as the camera took them; Unreachable before `open`."""
        return self._require_connection().effective

    def counters(self) -> dict[str, int]:
        """Counted since the camera was made: frames, triggers, missed, stale, incomplete_*, wrong_size, opened,
        lost, and Aravis' own n_*; a counter that never moved may be absent."""
        return dict(self._counts)

    async def open(self) -> None:
        """Connect, check the serial number, write and compare all settings; forgets any earlier connection.

        Unreachable: no answer. Refused: a setting is not taken, another camera, or another client is in control
        (tried for the heartbeat and 2 s more, since it may be our own that died).
        """
        if self._lane is None:
            self._lane = WorkerThread(self._name, self._clock)
        await self._perform(self._connect)
        self._has_opened = True
        self.restarted = self._explain_restart(self._require_connection().clock_began_ns)
        self._heard_ns = self._clock.now_ns()

    async def close(self) -> None:
        """Stop and let go of the camera; never raises, up to 7.5 s when it is dead, 2.5 s when it is known to be. May
        be called while another call is under way, and twice."""
        lane = self._lane
        if lane is None:
            return
        self._lost = self._lost or "closed"
        await lane.call(self._disconnect)
        lane.close()
        if self._lane is lane:
            self._lane = self._heard_ns = None
            self._has_opened = False

    async def start(self) -> None:
        """Start acquisition, always on a new stream."""
        await self._call(self._require_connection().start)

    async def stop(self) -> None:
        """Stop acquisition."""
        await self._call(self._require_connection().stop)

    async def grab(self, exposure_s: float | None = None, due_ns: int = 0) -> Frame:
        """One complete frame that was exposed after the call; starts acquisition when it is not running.

        `exposure_s` holds for this frame, the configured one otherwise. A software trigger is sent at `due_ns` when
        that is still ahead, which in virtual time it must not be: who comes some ms early finds everything prepared.
        Incomplete frames are never used, the next one is tried. Unreachable: control lost, or 3 failures in a row;
        Refused: exposure not taken.
        """
        connection = self._require_connection()
        wanted_s = self.settings.exposure_s if exposure_s is None else exposure_s
        if not connection.running:
            await self._call(connection.start)
        if self.settings.trigger == "software":
            shot = await self._grab_triggered(connection, wanted_s, due_ns)
        else:
            shot = await self._grab_free_running(connection, wanted_s)
        return Frame(
            channel=f"{self._name}.image",
            image=shot.image,
            time_ns=shot.start_ns + to_ns(shot.exposure_s / 2),
            exposure_s=shot.exposure_s,
            gain_dB=connection.effective.gain_dB,
            camera_degC=shot.camera_degC,
            block_id=shot.block_id,
            camera_ticks=shot.camera_ticks,
            dropped=shot.dropped,
            significant_bits=significant_bits(self.settings.pixel_format),
        )

    async def read(self) -> tuple[Reading, ...]:
        """(Reading("camera.temperature", 41.5, "degC", ...),), BAD with the reason when the camera has none, it cannot
        be read, or the camera is closed (it is switched off before a warm-up) or being opened; Unreachable when it
        was lost."""
        channel = f"{self._name}.temperature"
        if not self._has_opened:
            return (bad_reading(channel, "degC", self._clock.now_ns(), "the camera is closed"),)
        value_degC, reason, cause = await self._call(self._require_connection().temperature)
        self._require_connection()
        time_ns = self._clock.now_ns()
        if cause != "wire":
            self._heard_ns = time_ns
        if reason:
            return (bad_reading(channel, "degC", time_ns, reason, cause),)
        return (Reading(channel, value_degC, "degC", time_ns),)

    async def describe_temperature_place(self) -> str:
        """Return which feature shows the temperature, and what the camera offers for its selector, in words; "" when
        none was found: `read` then says why."""
        return await self._call(self._require_connection().temperature_place)

    async def _grab_triggered(self, connection: Connection, exposure_s: float, due_ns: int) -> Shot:
        for _ in range(ATTEMPTS):
            shot = await self._call(connection.trigger, exposure_s, due_ns)
            self._require_connection()
            if shot is not None:
                return shot
        raise self._lose(f"{ATTEMPTS} software triggers brought no complete frame")

    async def _grab_free_running(self, connection: Connection, exposure_s: float) -> Shot:
        """Sleep until the frame is due, then take it: virtual time moves only while no thread waits on a wire."""
        called_ns = self._clock.now_ns()
        await self._call(connection.prepare, exposure_s)
        for _ in range(ATTEMPTS):
            await self._clock.sleep_until(connection.next_frame_due_ns(max(called_ns, self._clock.now_ns())))
            shot = await self._call(connection.take_next_free, called_ns)
            self._require_connection()
            if shot is not None:
                return shot
        raise self._lose(f"{ATTEMPTS} frame periods brought no complete frame")

    async def _call(self, function: Callable[..., Result], *args: object) -> Result:
        """Ask something of the camera that is connected; Unreachable when it has lost us."""
        if isinstance(self._clock, VirtualClock):
            await self._perform(self._require_connection().check_control)
            self._require_connection()
        return await self._perform(function, *args)

    async def _perform(self, function: Callable[..., Result], *args: object) -> Result:
        """Call in the worker thread; what Aravis reports leaves as a DeviceError."""
        if self._lane is None:
            raise Unreachable(self._name, "not open")
        try:
            return await self._lane.call(function, *args)
        except AravisError as error:
            if self._connection is not None and lacks_control(error):
                raise self._lose(f"control lost: {error}") from error
            raise device_error(self._name, error) from error

    def _require_connection(self) -> Connection:
        """The connection, or Unreachable until the next `open`."""
        if self._connection is None:
            raise Unreachable(self._name, "not open")
        if self._connection.control_lost.is_set() and not self._lost:
            self._lose("control lost: the camera restarted, dropped us, or is silent")
        if self._lost:
            raise Unreachable(self._name, self._lost)
        return self._connection

    def _lose(self, reason: str) -> DeviceError:
        self._counts["lost"] += 1
        self._lost = reason
        return Unreachable(self._name, reason)

    def _explain_restart(self, clock_began_ns: int | None) -> str:
        """A camera that has restarted counts its time from then on."""
        if self._heard_ns is None:
            return ""
        if clock_began_ns is None:
            return "the camera was lost, and has no clock that shows whether it has restarted"
        is_younger = clock_began_ns > self._heard_ns - to_ns(_CLOCK_SLACK_S)
        return "the camera was lost and has restarted: its clock began after its last answer" if is_younger else ""

    def _connect(self) -> None:
        self._disconnect()
        self._connection = Connection(
            self._name, self.settings, self._clock, self._frames, self._counts, self._answered
        )
        self._answered = self._connection.identity
        self._counts["opened"] += 1

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        self._lost = ""
        if connection is not None:
            connection.close()


Camera = AravisCamera
