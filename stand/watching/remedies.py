"""What to type after a message, so that its reader at the terminal need not look it up."""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from stand.gate import CAMERA_LOST, DISK_LOW, INTERLOCK, NOT_RECORDED, OPERATOR

_ROOM = "it continues when there is room: `stand session archive` copies what is finished elsewhere"
_DISK = "it continues when the disk takes what waits: see that it is there, has room and answers"
_OF_REASON = {
    OPERATOR: "`stand continue` ends the pause",
    INTERLOCK: "`stand clear` once the cause is removed",
    CAMERA_LOST: "it continues when the camera answers: `stand devices` shows what is connected",
    DISK_LOW: _ROOM,
    NOT_RECORDED: _DISK,
}
_CONNECTED = "`stand devices` shows what is connected"
_SEE_DISK = "see that the disk has room and answers"
_NOT_ON = "look at the relay board, its supply and that channel: `stand check` tries each relay"
_SWITCHED = "find what else switches it: a key of the unit, a second program on its line"
_CLEAR_FOLDER = "have its disk mounted, or the folder moved back, then `stand clear`"
_SENSOR = "compare it with another thermometer at its place, and look at its cable"
_SHOW_SESSION = "`stand session info {folder}` shows what is missing"
_CAREFUL = "`stand session note {folder} TEXT` informs those who fit it"
_NOTHING = "nothing is to be done"
_NEW_END = "nothing is to be done; `stand status` has the new end"
_STAGE = "see whether it has lost its supply or slipped; "
_SLEEP = "keep this computer awake: `systemctl mask sleep.target suspend.target`"
_OF_KIND = {
    "alert_failed": "`stand alert test` tries them",
    "by_hand_failed": _CONNECTED,
    "camera_equilibrium_late": "see what still warms or cools the camera: its supply, a draught, a lamp",
    "camera_equilibrium_lost": _NEW_END,
    "camera_lost": _OF_REASON[CAMERA_LOST],
    "camera_not_opened": _CONNECTED,
    "camera_offset_changed": "see whether the camera, its supply or its mount were touched; " + _CAREFUL,
    "camera_supply_off": _CONNECTED,
    "capture_restarted": _NEW_END,
    "cleared": _NOTHING,
    "clock_set_back": "nothing to do: its pictures are dated by the new offset; set its clock between two nights",
    "clock_step": "see that one program sets the clock: `timedatectl timesync-status`, or `chronyc tracking`",
    "compressor_dropped": "look at the relay board's supply; " + _SWITCHED,
    "compressor_not_kept": _SEE_DISK,
    "cool_down_unsure": "see by the first readings whether the camera was cold when it was switched on; " + _CAREFUL,
    "daemon_not_kept": _SEE_DISK,
    "dead_man_late": "it is tested again by itself; see what loads this computer when that is so at each start",
    "dead_man_tested": "take a board whose timed-on each command restarts (docs/drivers.md); `stand check --moves`",
    "device_lost": _CONNECTED,
    "device_slow": "look at its line: speed, cable, how many units are on it; `stand check` times each device",
    "disk_nearly_full": _ROOM,
    "flap_not_shut": "see what blocks the flap, or close it by hand",
    "folder_lost": _CLEAR_FOLDER,
    "folder_not_made": _CLEAR_FOLDER,
    "frames_dropped": _SHOW_SESSION,
    "frames_stopped": _ROOM,
    "gap": _SHOW_SESSION,
    "guard_late": "see what stopped or loads this computer; " + _SLEEP,
    "compressor_not_on": _NOT_ON,
    "heater_enable_not_on": _NOT_ON,
    "heater_enable_dropped": "look at the relay board's supply; " + _SWITCHED,
    "held": "`stand status` says what holds it, and what ends that",
    "hold_ended": _NOTHING,
    "hold_stays": _OF_REASON[INTERLOCK],
    "home_residual_large": _STAGE + _CAREFUL,
    "homed": _STAGE + _CAREFUL,
    "host_suspended": _SLEEP,
    "house_not_recorded": _SEE_DISK,
    "interface_failed": "what runs goes on; once it has ended, begin `stand serve` again",
    "journal_damaged": "`stand status --plan` shows what counts as done",
    "journal_not_saved": _DISK,
    "left_on": _SWITCHED,
    "tokens_not_read": "mend the file, and send SIGHUP again; `stand token list` reads it, too",
    "daemon_file_damaged": "read the counters in the damaged file, if they matter",
    "latch_not_cleared": "`stand clear` again, when the disk answers",
    "latch_not_kept": "see that the folder of the stand's state is there and has room",
    "loopback_trusted": "take `interface.trust_loopback` out of the stand's file when that is not wanted",
    "limits_accepted": "take `guard.accept` out of the stand's file when that is not wanted",
    "no_camera_temperature": "name the camera's temperature in the stand's file, if it has one: `stand check`",
    "no_control": "Ctrl-C where it was begun still stops the run",
    "no_dead_man": "see that a hard-wired cut-out is in the heater's line: docs/safety.md",
    "no_picture": "see that the imager takes pictures, and that its folder is the one of the stand's file",
    "not_at_ambient": "`stand status` shows when the air is as warm as the laboratory",
    "not_confirmed_safe": "switch the stand off by hand; `stand status` says when it is safe",
    "not_reported": "`stand session list` shows what the session lacks",
    "soak_unsettled": "a fit leaves its frames out; give the recipe's soak more time, or see what keeps the chamber",
    "not_settled": "the plan goes on; `max_s` of the recipe's soak gives it longer",
    "not_resumed": "`stand clear`, then `stand resume`",
    "notify_failed": "`stand alert test` tries alerts",
    "permit_not_renewed": "heat and cold drop by themselves until it answers; " + _CONNECTED,
    "picture_left_out": "see that the imager is the one of the stand's file, and stores radiometric JPEGs",
    "pictures_lost": "have it mounted; pictures that come meanwhile are read then",
    "plan_changed": "`stand status --plan` shows the plan",
    "preview": "nothing is to be done; frames are recorded all the same",
    "prompt": "`stand continue` when it is done",
    "prompt_skipped": "`stand run --attended` waits for it",
    "queue": "`stand queue list` shows the queue",
    "readings_dropped": _DISK,
    "readings_lost": _SHOW_SESSION,
    "recording_restarted": "see what killed it: `journalctl -k` tells of a lack of memory",
    "recording_lost": _SHOW_SESSION,
    "regulator_occupied": "end at the unit what occupies it: autotuning, a program of its own, local mode",
    "report": "the session's report shows where: *Sessions* on the page, or its report.html",
    "run_failed": "`stand queue list` shows the queue",
    "salvaged": "`stand session verify` reads what was recovered",
    "segment_given_up": "`stand session verify {folder}` reads all of it, once the run has ended",
    "soak_restarted": _NEW_END,
    "stand_differs": "`stand stop` if that is not meant, and `stand resume` with the right --config",
    "step_broken_off": "nothing is to be done; it is done again when the hold is over",
    "switched_off": _SWITCHED,
    "telemetry_not_saved": _DISK,
    "undecided": "`stand status --plan` shows the plan",
    "warm_up_gap": _CAREFUL,
}
_OF_RULE = {  # of those that only warn
    "contact": "see to it where it is; `stand status` shows what it reads",
    "sensor_bad": _CONNECTED,
    "sensor_drifts": _SENSOR,
    "sensor_implausible": "state `self_heating_K` of the camera in the stand's file, if that is how it is; " + _SENSOR,
    "sensor_jumped": _SENSOR,
    "sensor_missing": _CONNECTED,
    "sensor_noisy": _SENSOR,
    "sensor_outside": _SENSOR,
    "sensor_stale": _CONNECTED,
    "sensor_stuck": _SENSOR,
    "sensors_disagree": _SENSOR,
    "settings_changed": "set the stage's controller as its profile says; `stand check` compares them",
}
_BY_ITSELF = "it continues by itself when that is over"
_TRIPPED = "once the cause is removed, `stand clear` where a daemon has the stand, else"
_ELSE = "`stand status` shows how it stands"  # of kinds of another version, or of an experiment's own


def next_command(kind: str, data: Mapping[str, object], session: str = "") -> str:
    """What helps, or shows more, after a warning or an error of that kind. session: the folder of the run's."""
    folder = shlex.quote(session) if session else "DIR"
    if kind == "held" and data.get("reason") != INTERLOCK:  # what the guard says of its rule tells how that ends
        return _OF_REASON.get(str(data.get("reason")), _OF_KIND[kind])
    if kind.startswith("guard."):
        action = data.get("action")
        if action == "hold":
            return _BY_ITSELF if data.get("ends_itself") else _OF_REASON[INTERLOCK]
        by_rule = _OF_RULE.get(kind.removeprefix("guard."), _ELSE)
        return f"{_TRIPPED} `stand resume {folder} --clear`" if action == "abort" else by_rule
    if kind == "run.end":
        return f"`stand resume {folder}` continues it" if data.get("status") != "complete" else _ELSE
    return _OF_KIND.get(kind, _ELSE).replace("{folder}", folder)


def for_reason(reason: str) -> str:
    """What ends a hold of that reason; "" when nothing has to be typed."""
    return _OF_REASON[reason] if reason in (OPERATOR, INTERLOCK) else ""
