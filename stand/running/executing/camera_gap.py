"""What a gap may have done to the camera.

It may have been off while nobody watched it; without evidence it counts as off. And its own temperature minus that of
the air near it, once a set-point has settled, may be another one: what the camera gives off and how the air takes it.
A gap in which that has changed (another mount, a fan, another camera board) parts a session in two: before and after
are not of one equilibrium.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.events import (
    CAMERA_EQUILIBRIUM,
    CAMERA_EQUILIBRIUM_LOST,
    CAMERA_OFFSET_CHANGED,
    CAMERA_OFFSET_SAME,
    RUN_BEGINS,
)
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item, StepState
from thermostand.foundation.readings import Quality, Reading
from thermostand.recording.reading.session import Session
from thermostand.stand.imaging.camera_cooling import CameraTemperature
from thermostand.stand.imaging.equilibrium import CAMERA

AIR = "thermometers.air"
LIMIT_K = 1.0  # round number; nothing was measured
_WINDOW_S = 120.0  # round number; nothing was measured
_STEADY_K = 0.2
"""How much a settled camera changes from one half of that window to the other. One that warms up with 400 s, as those
of the simulator and of the paper do within a factor of two, and does so, is still 1.3 K from where it will be."""
_TRANSIENT_ROLES = frozenset({"warm_up", "settling", "other"})


@dataclass(frozen=True, slots=True)
class OffsetGap:
    """What was settled before it, camera minus air by set-point (K by degC), and its instants (ns)."""

    before_K: Mapping[float, float]
    from_ns: int
    to_ns: int


class OffsetWatch:
    """One to a run. `gap`: the one after which the run is resumed, None when it begins."""

    def __init__(self, hub: Hub, clock: Clock, gap: OffsetGap | None = None) -> None:
        self._hub = hub
        self._clock = clock
        self._settled_K = {} if gap is None else dict(gap.before_K)
        self._gap = gap
        self._readings: dict[str, deque[tuple[int, float]]] = {CAMERA: deque(), AIR: deque()}
        hub.subscribe(self._receive)

    def close(self) -> None:
        """Listen no more: the run is over."""
        self._hub.unsubscribe(self._receive)

    def note_settled(self, chamber_degC: float) -> None:
        """The set-point has settled: keep its offset, and compare it when it is the first since a gap; the event
        `camera_offset_changed`, or `camera_offset_same`."""
        after_K = self._compute_offset_K()
        if math.isnan(after_K):
            return
        gap, before_K = self._gap, self._settled_K
        if gap is not None and before_K:
            nearest_degC = min(before_K, key=lambda each_degC: abs(each_degC - chamber_degC))
            self._report_change(gap, nearest_degC, before_K[nearest_degC], chamber_degC, after_K)
        self._gap = None
        self._settled_K = {**before_K, chamber_degC: after_K}

    def _compute_offset_K(self) -> float:
        since_ns = self._clock.now_ns() - to_ns(_WINDOW_S)
        camera, air = (
            [value for time_ns, value in self._readings[name] if time_ns >= since_ns] for name in (CAMERA, AIR)
        )
        return float(np.mean(camera) - np.mean(air)) if _is_steady(camera) and air else math.nan

    def _report_change(
        self, gap: OffsetGap, before_degC: float, before_K: float, after_degC: float, after_K: float
    ) -> None:
        kind = CAMERA_OFFSET_CHANGED if abs(after_K - before_K) > LIMIT_K else CAMERA_OFFSET_SAME
        event = kind.at(
            self._clock.now_ns(),
            before_K=before_K,
            after_K=after_K,
            before_degC=before_degC,
            after_degC=after_degC,
            gap_ns=gap.from_ns,
            gap_end_ns=gap.to_ns,
        )
        self._hub.publish(event)

    def _receive(self, item: Item) -> None:
        """The hub's subscriber."""
        if isinstance(item, Event) and item.kind == CAMERA_EQUILIBRIUM_LOST and self._gap is None:
            self._gap = OffsetGap(self._settled_K, item.time_ns, item.time_ns)
        if isinstance(item, Batch):
            for reading in item.readings:
                kept = self._readings.get(reading.channel)
                if kept is not None and math.isfinite(reading.value):
                    kept.append((reading.time_ns, reading.value))
                    while kept[0][0] < reading.time_ns - to_ns(_WINDOW_S):
                        kept.popleft()


def compute_settled_offsets(session: Session) -> dict[float, float]:
    """Camera minus air (K) by set-point (degC), as it was last when a capture began there with a settled camera."""
    found: dict[float, float] = {}
    readings = [session.readings(channel) for channel in (CAMERA, AIR)]
    for mark in session.steps():
        chamber_degC, role = mark.parameters.get("chamber_degC"), mark.parameters.get("role")
        if mark.kind != "capture" or mark.state is not StepState.STARTED or role in _TRANSIENT_ROLES:
            continue
        camera, air = (
            values[(times_ns > mark.time_ns - _WINDOW_S * NS_PER_S) & (times_ns <= mark.time_ns) & np.isfinite(values)]
            for times_ns, values in readings
        )
        if isinstance(chamber_degC, int | float) and _is_steady(camera) and len(air):
            found[float(chamber_degC)] = float(camera.mean() - air.mean())
    return found


def _is_steady(camera_degC: Sequence[float] | NDArray[np.float64]) -> bool:
    """Return whether the camera has settled, by what it read within the window."""
    middle = len(camera_degC) // 2
    return middle > 0 and abs(float(np.mean(camera_degC[middle:]) - np.mean(camera_degC[:middle]))) <= _STEADY_K


_SAME_K = 1.0  # a camera that is as warm as it was last has been on


@dataclass(frozen=True, slots=True)
class CameraHistory:
    """What a session records of the camera. last: its last temperature, None when it never gave one. boot_id: of the
    host, "" when it is not known. lost: why it was not in equilibrium at the end, "" when it was.
    offsets_K: camera minus air by set-point (degC)."""

    last: CameraTemperature | None = None
    boot_id: str = ""
    lost: str = ""
    offsets_K: Mapping[float, float] = field(default_factory=dict[float, float])


def explain_possible_power_loss(
    before: CameraHistory, boot_id: str | None, was_supplied: bool | None, reading: Reading | None
) -> str:
    """Return why the camera may have been off since, "" when it was not.

    boot_id: of the host now, None in virtual time. was_supplied: whether its supply read on before it was switched on,
    None when that is not known. reading: its first temperature.
    """
    if not was_supplied:
        return "its supply was found off after the gap"
    if boot_id is not None and (not boot_id or boot_id != before.boot_id):
        return "the host has restarted since, maybe after a power cut"
    if reading is not None and reading.quality is Quality.GOOD and before.last is not None:
        change_K = reading.value - before.last.camera_degC
        if abs(change_K) > _SAME_K:
            return f"it is {change_K:+.1f} K from its last temperature before the gap"
    return before.lost


def load_camera_history(session: Session) -> CameraHistory:
    """Load the camera's history from the recording."""
    boot_id = lost = ""
    events = [
        event for event in session.events() if event.kind in (CAMERA_EQUILIBRIUM_LOST, CAMERA_EQUILIBRIUM, *RUN_BEGINS)
    ]
    lost_ns = -1
    for event in events:
        named = event.data.get("boot_id")
        boot_id = named if isinstance(named, str) else boot_id
        if event.kind == CAMERA_EQUILIBRIUM_LOST:
            lost, lost_ns = "its equilibrium had been lost before", event.time_ns
        elif event.kind == CAMERA_EQUILIBRIUM:
            lost = ""
    if any(mark.kind == "power_camera" and mark.time_ns > lost_ns for mark in session.steps()):
        lost = ""  # by the plan, which soaks it as it needs it
    if CAMERA not in session.channels():  # a stand without a camera, or one that has reported nothing yet
        return CameraHistory(None, boot_id, lost)
    return CameraHistory(_find_last_temperature(session), boot_id, lost, compute_settled_offsets(session))


def _find_last_temperature(session: Session) -> CameraTemperature | None:
    """The camera's last temperature; None when it never gave one."""
    times_ns, values_degC = session.readings(CAMERA)
    for time_ns, camera_degC in zip(reversed(times_ns.tolist()), reversed(values_degC.tolist()), strict=True):
        if not math.isnan(camera_degC):
            return CameraTemperature(camera_degC, time_ns)
    return None
