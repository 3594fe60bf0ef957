"""Whether the camera may have been off while nobody watched it; in doubt it was."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from foundation.readings import Quality, Reading
from recording.reading.session import Session
from stand.imaging.camera_cooling import Cooling
from stand.imaging.equilibrium import CAMERA, LOST, REACHED
from stand.running.camera_offset import settled_offsets

_SAME_K = 1.0  # a camera that is as warm as it was last has been on


@dataclass(frozen=True, slots=True)
class CameraBefore:
    """What a session tells of the camera. last: its last temperature, None when it never gave one. boot_id: of the
    host, "" when it is not known. lost: why it was not in equilibrium at the end, "" when nothing speaks against it.
    offsets_K: camera minus air by set-point (degC)."""

    last: Cooling | None = None
    boot_id: str = ""
    lost: str = ""
    offsets_K: Mapping[float, float] = field(default_factory=dict[float, float])


def doubt(before: CameraBefore, boot_id: str | None, was_supplied: bool | None, reading: Reading | None) -> str:
    """Why the camera may have been off since, "" when it was not.

    boot_id: of the host now, None in virtual time. was_supplied: whether its supply read on before it was switched on,
    None when that is not known. reading: its first temperature.
    """
    if not was_supplied:
        return "its supply was found off after the gap"
    if boot_id is not None and (not boot_id or boot_id != before.boot_id):
        return "the host has been started anew since, maybe after a power cut"
    if reading is not None and reading.quality is Quality.GOOD and before.last is not None:
        change_K = reading.value - before.last.camera_degC
        if abs(change_K) > _SAME_K:
            return f"it is {change_K:+.1f} K from its last temperature before the gap"
    return before.lost


def camera_before(session: Session) -> CameraBefore:
    """By what is recorded."""
    boot_id = lost = ""
    events = [event for event in session.events() if event.kind in (LOST, REACHED, "run.start", "run.resume")]
    lost_ns = -1
    for event in events:
        named = event.data.get("boot_id")
        boot_id = named if isinstance(named, str) else boot_id
        if event.kind == LOST:
            lost, lost_ns = "its equilibrium had been lost before", event.time_ns
        elif event.kind == REACHED:
            lost = ""
    if any(mark.kind == "PowerCamera" and mark.time_ns > lost_ns for mark in session.steps()):
        lost = ""  # by the plan, which soaks it as it needs it
    return CameraBefore(_last_word(session), boot_id, lost, settled_offsets(session))


def _last_word(session: Session) -> Cooling | None:
    """The camera's last temperature; None when it never gave one."""
    times_ns, values_degC = session.readings(CAMERA)
    for time_ns, camera_degC in zip(reversed(times_ns.tolist()), reversed(values_degC.tolist()), strict=True):
        if not math.isnan(camera_degC):
            return Cooling(camera_degC, time_ns)
    return None
