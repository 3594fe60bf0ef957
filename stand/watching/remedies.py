"""What to type after a message, so that its reader at the terminal need not look it up."""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from stand.gate import CAMERA_LOST, DISK_LOW, INTERLOCK, NOT_RECORDED, OPERATOR

_ROOM = "it continues when there is room: `stand session archive` copies what is finished elsewhere"
_DISK = "it continues when the disk takes what waits; `stand status` shows how it stands"
_OF_REASON = {
    OPERATOR: "`stand continue` ends the pause",
    INTERLOCK: "`stand clear` once the cause is removed",
    CAMERA_LOST: "it continues when the camera answers: `stand devices` shows what is connected",
    DISK_LOW: _ROOM,
    NOT_RECORDED: _DISK,
}
_CONNECTED = "`stand devices` shows what is connected"
_SEE_DISK = "see that the disk has room and answers"
_OF_KIND = {
    "by_hand_failed": _CONNECTED,
    "camera_not_opened": _CONNECTED,
    "device_slow": _CONNECTED,
    "flap_not_shut": "see what blocks the flap, or close it by hand",
    "journal_not_saved": _DISK,
    "readings_dropped": _DISK,
    "compressor_not_kept": _SEE_DISK,
    "daemon_not_kept": _SEE_DISK,
    "house_not_recorded": _SEE_DISK,
    "queue": "`stand queue list` shows the queue",
    "prompt": "`stand continue` when it is done",
    "hold_stays": _OF_REASON[INTERLOCK],
    "camera_lost": _OF_REASON[CAMERA_LOST],
    "camera_supply_off": _CONNECTED,
    "device_lost": _CONNECTED,
    "frames_stopped": _ROOM,
    "telemetry_not_saved": _DISK,
    "disk_nearly_full": _ROOM,
    "not_confirmed_safe": "switch the stand off by hand; `stand status` says when it is safe",
    "alert_failed": "`stand alert test` tries them",
    "notify_failed": "`stand alert test` tries alerts",
    "salvaged": "`stand session verify` reads what was recovered",
    "plan_changed": "`stand status --plan` shows the plan",
    "run_failed": "`stand queue list` shows the queue",
}
_BY_ITSELF = "it continues by itself when that is over"
_TRIPPED = "once the cause is removed, `stand clear` where a daemon has the stand, else"
_ELSE = "`stand status` shows how it stands"


def next_command(kind: str, data: Mapping[str, object], session: str = "") -> str:
    """What helps, or shows more, after a warning or an error of that kind. session: the folder of the run's."""
    folder = shlex.quote(session) if session else "DIR"
    if kind == "held" and data.get("reason") != INTERLOCK:  # what the guard says of its rule tells how that ends
        return _OF_REASON.get(str(data.get("reason")), _ELSE)
    if kind.startswith("guard."):
        action = data.get("action")
        if action == "hold":
            return _BY_ITSELF if data.get("ends_itself") else _OF_REASON[INTERLOCK]
        return f"{_TRIPPED} `stand resume {folder} --clear`" if action == "abort" else _ELSE
    if kind == "run.end":
        return f"`stand resume {folder}` continues it" if data.get("status") != "complete" else _ELSE
    return _OF_KIND.get(kind, _ELSE)


def for_reason(reason: str) -> str:
    """What ends a hold of that reason; "" when nothing has to be typed."""
    return _OF_REASON[reason] if reason in (OPERATOR, INTERLOCK) else ""
