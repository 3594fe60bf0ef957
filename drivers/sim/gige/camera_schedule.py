"""When the camera exposes: software trigger and free run as a function of the clock; no thread, no socket."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from thermostand.drivers.sim.gige.camera_registers import Registers
from thermostand.drivers.sim.gige.genicam import MAX_RATE_Hz
from thermostand.foundation.clock import NS_PER_S

_IDLE_ns = NS_PER_S
_SINGLE_FRAME = 1
_SOFTWARE = 0


@dataclass(frozen=True)
class Shot:
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
        self._triggered: deque[Shot] = deque()
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

    def is_current(self, shot: Shot) -> bool:
        """The acquisition that the exposure belongs to has not been stopped."""
        return shot.acquisition == self._acquisition

    @property
    def is_free_running(self) -> bool:
        """It exposes as time goes on, without being triggered."""
        return self.streaming and not self._triggering()

    def due(self, now_ns: int) -> tuple[Shot | None, int]:
        """The exposure to read out now, if any, and when to look again (ns)."""
        shot, again_ns = self._due(now_ns)
        if shot is not None and self._registers.integer("AcquisitionMode") == _SINGLE_FRAME:
            self._set_streaming(False)
        return shot, again_ns

    def _due(self, now_ns: int) -> tuple[Shot | None, int]:
        if not self.streaming:
            return None, now_ns + _IDLE_ns
        return self._due_triggered(now_ns) if self._triggering() else self._due_free_running(now_ns)

    def _due_triggered(self, now_ns: int) -> tuple[Shot | None, int]:
        if not self._triggered:
            return None, now_ns + _IDLE_ns
        end_ns = self._triggered[0].start_ns + self._triggered[0].exposure_ns
        if self._real_time and end_ns > now_ns:
            return None, end_ns
        return self._triggered.popleft(), now_ns

    def _due_free_running(self, now_ns: int) -> tuple[Shot | None, int]:
        """The latest frame whose exposure has ended; those missed in between only cost their ids."""
        period_ns, exposure_ns = self._period_ns(), self._exposure_ns()
        latest = self._anchor_index + (now_ns - exposure_ns - self._anchor_ns) // period_ns
        index = max(latest, self._next_index)
        start_ns = self._anchor_ns + (index - self._anchor_index) * period_ns
        if latest < index:
            return None, start_ns + exposure_ns
        return self._expose(index, start_ns), now_ns

    def _expose(self, index: int, start_ns: int) -> Shot:
        self._next_index = index + 1
        return Shot(self._acquisition, index, start_ns, self._exposure_ns(), self._registers.real("Gain"))

    def _triggering(self) -> bool:
        return self._registers.integer("TriggerMode") == 1

    def _exposure_ns(self) -> int:
        return round(self._registers.real("ExposureTime") * 1000)

    def _period_ns(self) -> int:
        """Of the free run: as asked for, but never shorter than the exposure."""
        enabled = self._registers.integer("AcquisitionFrameRateEnable")
        rate_Hz = self._registers.real("AcquisitionFrameRate") if enabled else MAX_RATE_Hz
        return max(round(NS_PER_S / rate_Hz), self._exposure_ns())

    def _set_streaming(self, streaming: bool) -> None:
        self.streaming = streaming
        self._registers.put("TLParamsLocked", int(streaming))
