"""Every kind of event, once: what it says, how grave it is, what to do about it, and who is notified elsewhere.

Who has something to say publishes a row of this table: `DEVICE_BACK.at(now_ns, device="flap", lost_s=4.0)`. From the
row come the line in the log (its text), what to type after it (`get_advice`), the message to people elsewhere
(`make_alert`), how often it is reported (`ends`, `counts`: repeats.py), and docs/troubleshooting. The guard's rules
(stand/guarding) register theirs with `guard_rule`; a package of experiments may add rows with `event`.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from string import Formatter
from typing import Literal, NamedTuple

from thermostand.foundation.instants import format_utc
from thermostand.foundation.items import Event

Data = Mapping[str, object]
Level = Literal["info", "warning", "error"]
# raised: sent at once. lasting: sent when it is not over within the grace time. over: the end of one.
Phase = Literal["raised", "lasting", "over"]
AlertCause = Literal[
    "trip",
    "hold",
    "device_lost",
    "disk",
    "prompt",
    "run_started",
    "run_finished",
    "run_aborted",
    "queue_empty",
    "eta_slipped",
]
TITLES: dict[AlertCause, str] = {
    "trip": "TRIPPED",
    "hold": "held",
    "device_lost": "a device is lost",
    "disk": "the disk",
    "prompt": "somebody is needed",
    "run_started": "a run has begun",
    "run_finished": "a run is complete",
    "run_aborted": "a run has ended before its plan was done",
    "queue_empty": "the queue is empty",
    "eta_slipped": "a run takes longer",
}


class Alert(NamedTuple):
    """What an event means for people elsewhere: of which cause, which one of it, and whether it begins or is over."""

    cause: AlertCause
    key: str = ""
    phase: Phase = "raised"


class EventKind(str):
    """A row; as a string it is the kind's name.

    text: a template of the fields that a site gives, or a function of them, whose docstring is the template that people
    read; `{text}` is the message of another (an error, a rule), which is not repeated among the data. Besides Python's
    own formats there are `utc` (of ns), `min` (of s), `GB` (of bytes), and a list is joined by commas.
    level, advice and alert may depend on the data; `cases` are the data for which they differ. advice: what helps, or
    shows more, with `{folder}` for the session's; a warning or an error has one. counts: each one is published, as it
    begins or ends something that is counted, recorded or waited for. is_shown: `stand serve` prints it although it is
    an information. ends: the kind whose state it ends, of the same `device`; is_ended: whether there is one that does;
    foundation/repeat_limit.py limits both together. is_limited: an information that is withheld when it repeats, as a
    warning is.
    """

    level: Level | Callable[[Data], Level]
    text: str | Callable[..., str]
    advice: str | Callable[[Data], str]
    alert: Alert | Callable[[Data], Alert | None] | None
    counts: bool
    is_shown: bool
    cases: tuple[Data, ...]
    ends: str
    is_ended: bool
    is_limited: bool

    def at(self, time_ns: int, message: str = "", /, **data: object) -> Event:
        """One that has happened at that instant."""
        try:
            text = self.format_text(message, **data)
        except (LookupError, TypeError, ValueError):  # a message must not end what reports it, such as a run
            text = ", ".join([message or str(self), *(f"{name} {value}" for name, value in data.items())])
        return Event(time_ns, self.get_level(data), str(self), text, data)

    def get_level(self, data: Data) -> Level:
        """Return how grave it is with such data."""
        return self.level(data) if callable(self.level) else self.level

    def make_alert(self, data: Data) -> Alert | None:
        """Return what it means for people elsewhere."""
        return self.alert(data) if callable(self.alert) else self.alert

    def format_text(self, text: str = "", /, **data: object) -> str:
        """Format the text alone. LookupError, TypeError or ValueError when a field is not given, or is none that
        fits."""
        if callable(self.text):
            return self.text(text=text, **data)
        return _FORM.vformat(self.text, (), {"text": text, **data})


class _Form(Formatter):
    def format_field(self, value: object, format_spec: str) -> str:
        if isinstance(value, int | float) and format_spec in _FORMS:
            return _FORMS[format_spec](value)
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value))
        return str(super().format_field(value, format_spec))


_FORM = _Form()
_FORMS: dict[str, Callable[[float], str]] = {
    "utc": lambda time_ns: format_utc(int(time_ns)),
    "min": lambda time_s: f"{time_s / 60:.0f}",
    "GB": lambda size_bytes: f"{size_bytes / 1e9:.1f}",
}
KINDS: dict[str, EventKind] = {}
GUARD = "guard."  # before the name of each of the guard's rules


def event(
    name: str,
    level: Level | Callable[[Data], Level],
    text: str | Callable[..., str],
    advice: str | Callable[[Data], str] = "",
    *,
    alert: Alert | Callable[[Data], Alert | None] | None = None,
    counts: bool = False,
    is_shown: bool = False,
    cases: tuple[Data, ...] = ({},),
    ends: str = "",
    is_limited: bool = False,
) -> EventKind:
    """One more row; see EventKind. ValueError when there is one of that name."""
    if name in KINDS:
        raise ValueError(f"there is an event {name} already")
    KINDS[name] = row = EventKind(name)
    row.level, row.text, row.advice, row.alert = level, text, advice, alert
    row.counts, row.is_shown, row.cases = counts, is_shown, cases
    row.ends, row.is_ended, row.is_limited = ends, False, is_limited
    if ends:
        KINDS[ends].is_ended = True
    return row


def guard_rule(name: str, says: str, warned: str = "") -> str:
    """Adds the row `guard.NAME` of a rule, whose action decides what follows; returns the name. says: what it objects
    to, in general; warned: the advice where the rule only warns."""

    def text(text: str, **_: object) -> str:
        return text

    text.__doc__ = says
    event(
        GUARD + name, _get_guard_level, text, lambda data: _advise_after_guard(data) or warned, alert=_make_guard_alert
    )
    return name


def get_guard_kind(rule: str) -> EventKind:
    """The row of a rule; one that has none gets one: what trips is always reported."""
    if GUARD + rule not in KINDS:
        guard_rule(rule, "")
    return KINDS[GUARD + rule]


def get_advice(kind: str, data: Data, session: str = "") -> str:
    """Return what helps, or shows more, after a warning or an error of that kind. session: the folder of the run's."""
    row = KINDS.get(kind)
    advice = "" if row is None else row.advice(data) if callable(row.advice) else row.advice
    if row is None and kind.startswith(GUARD):
        advice = _advise_after_guard(data)
    return (advice or _ELSE).replace("{folder}", shlex.quote(session) if session else "DIR")


def make_alert(event: Event) -> Alert | None:
    """Return what the event means for people elsewhere; None for most."""
    row = KINDS.get(event.kind)
    if row is None:
        return _make_guard_alert(event.data) if event.kind.startswith(GUARD) else None
    return row.make_alert(event.data)


def is_urgent(event: Event) -> bool:
    """Return whether somebody has to act on it at once, or a run waits for it: it stays as grave as it is, however
    often."""
    if event.data.get("action") in ("abort", "hold"):
        return True
    row = KINDS.get(event.kind)
    alert = row.make_alert(event.data) if row is not None and row.counts else None
    return alert is not None and alert.phase == "raised"


def get_state_change(event: Event) -> tuple[str, str] | None:
    """The state that it begins or ends, and of which device it is; None when it is of another sort."""
    row = KINDS.get(event.kind)
    begins = "" if row is None else row.ends or (event.kind if row.is_ended else "")
    return (begins, str(event.data.get("device", ""))) if begins else None


# What is to be done, of more than one kind.
RESET_ADVICE = "`stand reset` once the cause is removed"
CONNECTED = "`stand devices` shows what is connected"
SENSOR = "compare it with another thermometer at its place, and look at its cable"
CAMERA_ENDS = f"it continues when the camera answers: {CONNECTED}"
DISK_SPACE_ADVICE = "it continues when there is space: `stand session archive` copies what is finished elsewhere"
DISK = "it continues when the disk takes what waits: see that it is mounted, has space and answers"
_BY_ITSELF = "it continues by itself when that is over"
_SEE_DISK = "see that the disk has space and answers"
_NOT_ON = "look at the relay board, its supply and that channel: `stand check` tries each relay"
_SWITCHED = "find what else switches it: a key of the unit, a second program on its line"
_RESET_FOLDER = "have its disk mounted, or the folder moved back, then `stand reset`"
_SHOW_SESSION = "`stand session info {folder}` shows what is missing"
_CAREFUL = "`stand session note {folder} TEXT` informs those who fit it"
_NOTHING = "nothing is to be done"
_NEW_END = "nothing is to be done; `stand status` has the new end"
_STAGE = "see whether it has lost its supply or slipped; "
_SLEEP = "keep this computer awake: `systemctl mask sleep.target suspend.target`"
_PLAN = "`stand status --plan` shows the plan"
_QUEUE = "`stand queue list` shows the queue"
_ELSE = "`stand status` shows how it stands"  # of kinds of another version, or of an experiment's own
_TRIPPED = "once the cause is removed, `stand reset` where a daemon has the stand, else `stand resume {folder} --reset`"


# A table: a row has as many lines as it needs.
# fmt: off
# The guard. What it does depends on the rule's action, not on the rule.
def _get_guard_level(data: Data) -> Level:
    return "warning" if data.get("action") == "warn" else "error"


def _advise_after_guard(data: Data) -> str:
    if data.get("action") == "hold":
        return _BY_ITSELF if data.get("ends_itself") else RESET_ADVICE
    return _TRIPPED if data.get("action") == "abort" else ""


def _make_guard_alert(data: Data) -> Alert | None:
    match data.get("action"):
        case "abort":
            return Alert("trip", "guard")
        case "hold":
            return Alert("hold", "guard", "lasting")
        case _:
            return None


def _describe_hold_end(text: str, rule: str, endings_in_last_h: int | None = None) -> str:
    """the stand is held no longer, and continues; it was held because {text}"""
    if endings_in_last_h is None:
        return f"the recording ended while the disk held it up; nothing is heated before another begins: {text}"
    return f"the stand is held no longer, and continues; it was held because {text}"


HOLD_ENDED = event(
    "hold_ended", "warning", _describe_hold_end, _NOTHING, alert=Alert("hold", "guard", "over"), counts=True
)
HOLD_STAYS = event("hold_stays", "error", "{text}", RESET_ADVICE, alert=Alert("hold", "guard"), counts=True)
GUARD_LATE = event("guard_late", "warning",
    "the guard has not looked for {gap_s:.1f} s: the daemon was stopped, suspended or held up",
    "see what stopped or loads this computer; " + _SLEEP)
SENSOR_BELIEVED = event("sensor_believed", "info",
    "{channels[0]} is believed again, at {value_degC:.2f} degC, after {suspect_s:.0f} s under suspicion: {text}",
    is_limited=True)
LATCH_NOT_KEPT = event("latch_not_kept", "error", "that the stand has tripped may be forgotten at a restart: {text}",
    "see that the folder of the stand's state exists and has space")
LATCH_NOT_RESET = event("latch_not_reset", "warning", "at a restart the stand is taken for tripped: {text}",
    "`stand reset` again, when the disk answers")
LIMITS_OVERRIDDEN = event("limits_overridden", "warning", "{text}",
    "take `guard.overrides` out of the stand's file when that is not wanted")
NOT_CONFIRMED_SAFE = event("not_confirmed_safe", "error", "{text}",
    "switch the stand off by hand; `stand status` says when it is safe", alert=Alert("trip", "unsafe"), counts=True)
CONFIRMED_SAFE = event("confirmed_safe", "info", "the stand is safe", alert=Alert("trip", "unsafe", "over"))
ALERT_FAILED = event("alert_failed", "warning", "an alert was not delivered: {text}", "`stand alert test` tries them")


# Heat and cold: the relays, the regulator, the compressor.
def _describe_switched_off(text: str, device: str, times: int, relay: str = "") -> str:
    """{device}.{relay} was on without permission; switched off"""
    if relay:
        return f"{device}.{relay} was on without permission; switched off"
    return f"{device} ran without permission ({text} above 0); stopped"


SWITCHED_OFF = event("switched_off", "warning", _describe_switched_off, _SWITCHED)
LEFT_ON = event("left_on", "warning", "{device}.{relay} was on; switched off", _SWITCHED)
_OFF = "{device}.{relay} does not come on: the board confirms its command and reads off"
HEATER_NOT_ON = event("heater_enable_not_on", "warning", _OFF, _NOT_ON)
COMPRESSOR_NOT_ON = event("compressor_not_on", "warning", _OFF, _NOT_ON)
_DROPPED = "{device}.{relay} is off {left_s:.1f} s before its time: something else switched it"
_SUPPLY = "look at the relay board's supply; " + _SWITCHED
HEATER_DROPPED = event("heater_enable_dropped", "warning", _DROPPED, _SUPPLY)
COMPRESSOR_DROPPED = event("compressor_dropped", "warning",
    _DROPPED + "; it counts as a stop, and the compressor rests", _SUPPLY)
COMPRESSOR_SWITCHED = event("compressor", "info", "compressor {text}")
COMPRESSOR_NOT_KEPT = event("compressor_not_kept", "warning",
    "the next start will not know when the compressor last ran: {text}", _SEE_DISK)
PERMIT_NOT_RENEWED = event("permit_not_renewed", "warning", "heating and cooling permits not renewed: {text}",
    "heat and cold drop by themselves until it answers; " + CONNECTED)
REGULATOR_OCCUPIED = event("regulator_occupied", "warning", "{text}; the run waits",
    "end at the unit what occupies it: autotuning, a program of its own, local mode")
AUTOTUNED = event("autotuned", "info", "{device} is tuned at {set_point_degC:g} degC; in the stand's file: {text}")
NO_DEAD_MAN = event("no_dead_man", "warning",
    "no relay board guards the heat; when this computer dies, what ends it is {ends_it}",
    "see that a hard-wired cut-out is in the heater's line: docs/explanation/safety.md")
DEAD_MAN_LATE = event("dead_man_late", "warning",
    "{device}: this computer was held up while the relay's timer was tested; that test does not count",
    "it is tested again by itself; see what loads this computer when that is so at each start")
DEAD_MAN_TESTED = event("dead_man_tested",
    lambda data: "info" if data.get("rearmed") and data.get("dropped") else "error", "{device}: {text}",
    "take a board whose timed-on each command restarts (docs/how-to/connect-your-stand.md); `stand check --moves`",
    cases=({"rearmed": True, "dropped": True}, {"dropped": False}))
TO_AMBIENT = event("to_ambient", "info", "the plan is done; back to {ambient_degC:.1f} degC: {text}")
AT_AMBIENT = event("at_ambient", "info", "the chamber is at the laboratory's temperature")
NOT_AT_AMBIENT = event("not_at_ambient", "warning", "after {after_s:min} min {text}; open the chamber with care",
    "`stand status` shows when the air is as warm as the laboratory")


# Devices.
def _make_device_alert(phase: Phase) -> Callable[[Data], Alert]:
    return lambda data: Alert("device_lost", str(data.get("device", "")), phase)


DEVICE_LOST = event("device_lost", "warning", "{text}", CONNECTED, alert=_make_device_alert("lasting"))
DEVICE_BACK = event("device_back", "info", "{device} answers again after {lost_s:g} s",
    alert=_make_device_alert("over"), ends=DEVICE_LOST)
DEVICE_SLOW = event("device_slow", "warning",
    "{device} took {took_s:g} s to answer and is read every {period_s:g} s: readings are missing",
    "look at its line: speed, cable, how many units are on it; `stand check` times each device")
DEVICE_FAST = event("device_fast", "info", "{device} answers within {took_s:g} s again", ends=DEVICE_SLOW)
DEVICE_IDENTITY = event("device_identity", "info", "{device}: {text}")
ABSENT = event("absent", "info", "no {what}: {text}")
BY_HAND_FAILED = event("by_hand_failed", "warning", "{what}: {text}", CONNECTED)
FLAP_NOT_SHUT = event("flap_not_shut", "error", "the flap does not close, although the run is held ({reasons}): {text}",
    "see what blocks the flap, or close it by hand", alert=Alert("hold", "flap"))
FLAP_SHUT_IN_HOLD = event("flap_shut_in_hold", "info", "the flap was shut: the run is held ({reasons})")
HOMED = event("homed", "warning", "{axis} had lost its scale and was homed; captures since its last home are suspect",
    _STAGE + _CAREFUL)
_HOME = "{axis}: home was at {residual:.5f} {unit} ({steps:.2f} steps)"
HOME_RESIDUAL = event("home_residual", "info", _HOME)
HOME_RESIDUAL_LARGE = event("home_residual_large", "warning",
    _HOME + ", more than {limit_steps:g} steps; captures since its last good home are suspect", _STAGE + _CAREFUL)
RE_APPROACHED = event("re-approached", "info", "{axis}: {reason}; approached {position:g} {unit} again")
PICTURES_LOST = event("pictures_lost", "warning", "{device}: {reason}",
    "have it mounted; pictures that come meanwhile are read then")
PICTURES_BACK = event("pictures_back", "info", "{device}: its folder is there again", ends=PICTURES_LOST)
NO_PICTURE = event("no_picture", "warning", "{device}: no picture for {minutes:g} min",
    "see that the imager takes pictures, and that its folder is the one of the stand's file")
PICTURE_TAKEN = event("picture_taken", "info", "{device}: {file} of {model} {serial_number}")
PICTURE_LEFT_OUT = event("picture_left_out", "warning", "{device}: {file} is left out: {reason}",
    "see that the imager is the one of the stand's file, and stores radiometric JPEGs")
CLOCK_SET_BACK = event("clock_set_back", "warning",
    "{device}: its clock was set back by {by_s} s, and its pictures are dated accordingly from now on",
    "nothing to do: its pictures are dated by the new offset; set its clock between two runs")

# The camera.
CAMERA_LOST = event("camera_lost", "warning", "{text}", CAMERA_ENDS, alert=Alert("device_lost", "camera", "lasting"))
CAMERA_BACK = event("camera_back", "info", "{text}", alert=Alert("device_lost", "camera", "over"), ends=CAMERA_LOST)
CAMERA_NOT_OPENED = event("camera_not_opened", "warning", "the camera is powered, and cannot be opened: {text}",
    CONNECTED)
CAMERA_SUPPLY_OFF = event("camera_supply_off", "error",
    "the camera's supply is off though it was switched on: a brown-out of the relay board, or a person", CONNECTED,
    counts=True)
NO_CAMERA_TEMPERATURE = event("no_camera_temperature", "warning",
    "the camera is configured to have no temperature: no drift over it can be fitted to this session",
    "name the camera's temperature in the stand's file, if it has one: `stand check`")
COOLED_DOWN = event("cooled_down", "info",
    "after {waited_s:.0f} s the camera should be {excess_K:+.2f} K from the air, within {band_K:g} K")
COOL_DOWN_UNSURE = event("cool_down_unsure", "warning", "{text}",
    "see by the first readings whether the camera was cold when it was switched on; " + _CAREFUL)
CAMERA_EQUILIBRIUM_LOST = event("camera_equilibrium_lost", "warning",
    "the camera's equilibrium is lost, it is soaked again: {reason}", _NEW_END, counts=True)


def _describe_equilibrium(text: str, soaked_s: float, rate_K_per_min: float | None) -> str:
    """the camera is in equilibrium after {soaked_s:min} min: its temperature moves by {rate_K_per_min} K/min"""
    how = "is not known; five time constants are over"
    if rate_K_per_min is not None:
        how = f"moves by at most {rate_K_per_min:.3f} K/min"
    return f"the camera is in equilibrium after {soaked_s / 60:.0f} min: its temperature {how}"


def _describe_no_equilibrium(text: str, soaked_s: float, rate_K_per_min: float | None) -> str:
    """the camera is not in equilibrium after {soaked_s:min} min: its temperature moves by {rate_K_per_min} K/min"""
    how = "is known at times only" if rate_K_per_min is None else f"moves by up to {rate_K_per_min:.3f} K/min"
    return f"the camera is not in equilibrium after {soaked_s / 60:.0f} min: its temperature {how}; still waiting"


CAMERA_EQUILIBRIUM = event("camera_equilibrium", "info", _describe_equilibrium)
CAMERA_EQUILIBRIUM_LATE = event("camera_equilibrium_late", "warning", _describe_no_equilibrium,
    "see what still warms or cools the camera: its supply, a draught, a lamp")
_OFFSETS = (
    "camera minus air was {before_K:.2f} K at {before_degC:g} degC before the gap, and is {after_K:.2f} K at "
    "{after_degC:g} degC after it"
)
CAMERA_OFFSET_SAME = event("camera_offset_same", "info", _OFFSETS)
CAMERA_OFFSET_CHANGED = event("camera_offset_changed", "warning", _OFFSETS,
    "see whether the camera, its supply or its mount were touched; " + _CAREFUL)

# The recording and its disk.
TELEMETRY_NOT_SAVED = event("telemetry_not_saved", "error", "telemetry is kept in memory: {text}", DISK,
    alert=Alert("disk", "telemetry", "lasting"), counts=True)
TELEMETRY_SAVED_AGAIN = event("telemetry_saved_again", "info", "the disk takes telemetry again",
    alert=Alert("disk", "telemetry", "over"))
DISK_NEARLY_FULL = event("disk_nearly_full", "warning", "{free_bytes:GB} of {total_bytes:GB} GB are free on the disk",
    DISK_SPACE_ADVICE, alert=Alert("disk", "nearly full"))
FRAMES_STOPPED = event("frames_stopped", "error", "frames are not recorded any more: {reason}", DISK_SPACE_ADVICE,
    alert=Alert("disk", "frames", "lasting"), counts=True)
FRAMES_RESUMED = event("frames_resumed", "info", "frames are recorded again", alert=Alert("disk", "frames", "over"))
FRAMES_DROPPED = event("frames_dropped", "error", "frames lost: {text}, {total} in all; {reason}", _SHOW_SESSION,
    counts=True)
READINGS_DROPPED = event("readings_dropped", "error",
    "the disk has taken nothing for so long that readings are dropped; events and frames' data are kept", DISK,
    alert=Alert("disk", "readings"), counts=True)
READINGS_LOST = event("readings_lost", "error",
    "{readings} readings from {from_ns:utc} to {to_ns:utc} were dropped while the disk took nothing", _SHOW_SESSION,
    alert=Alert("disk", "readings", "over"), counts=True)
FOLDER_LOST = event("folder_lost", "error", "{text}", _RESET_FOLDER, counts=True)
FOLDER_BACK = event("folder_back", "info", "the session's folder {folder} is back")
FOLDER_NOT_MADE = event("folder_not_made", "error", "{folder}: no folder can be made there again ({text})",
    _RESET_FOLDER)


def _describe_recording_loss(text: str, what: list[str], from_ns: int, to_ns: int, reason: str, counts: object) -> str:
    """{reason}; {what} continue in a new place without what was recorded from {from_ns} to {to_ns}"""
    span = f"from {format_utc(from_ns)} to {format_utc(to_ns)}"
    return f"{reason}; {' and '.join(what)} continue in a new place without what was recorded {span}{text}"


RECORDING_LOST = event("recording_lost", "error", _describe_recording_loss, _SHOW_SESSION, counts=True)
SEARCH_FAILED = event("search_failed", "warning", "{text}", _NOTHING + ": frames are larger, and none is lost")
SEGMENT_GIVEN_UP = event("segment_given_up", "warning", "{text}",
    "`stand session verify {folder}` reads all of it, once the run has ended")
SALVAGED = event("repaired", "warning", "{text}", "`stand session verify` reads what was recovered")
TRIMMED = event("session.trimmed", "info", "{text}")


def _describe_clock_step(text: str, offset_before_ns: int, offset_after_ns: int, **_: object) -> str:
    """the system clock moved against the stand's clock, which is not changed"""
    by_s, utc_s = (offset_after_ns - offset_before_ns) / 1e9, offset_after_ns / 1e9
    if not by_s:
        return f"UTC is still {utc_s:+.3f} s from recorded instants"
    return (
        f"the system clock moved {by_s:+.3f} s against the stand's clock, which is not changed; UTC is now "
        f"{utc_s:+.3f} s from recorded instants"
    )


CLOCK_STEP = event("clock_step",
    lambda data: "info" if data.get("offset_before_ns") == data.get("offset_after_ns") else "warning",
    _describe_clock_step,
    "see that one program sets the clock: `timedatectl timesync-status`, or `chronyc tracking`", counts=True,
    cases=({"offset_before_ns": 0, "offset_after_ns": 1}, {}))
HOST_SUSPENDED = event("host_suspended", "warning",
    "the host was suspended for {text}: nothing was watched or recorded meanwhile", _SLEEP, counts=True)


# A run and its plan.


def _advise_after_end(data: Data) -> str:
    return "" if data.get("status") == "complete" else "`stand resume {folder}` continues it"


def _make_end_alert(data: Data) -> Alert:
    return Alert("run_finished" if data.get("status") == "complete" else "run_aborted")


RUN_START = event("run.start", "info", "recipe {recipe}", alert=Alert("run_started"), counts=True)
RUN_RESUME = event("run.resume", "info",
    "recipe {recipe} is resumed, {steps_done} steps are done; thermostand {version}", alert=Alert("run_started"),
    counts=True)
RUN_END = event("run.end", lambda data: "info" if data.get("status") == "complete" else "error", "{text}",
    _advise_after_end, alert=_make_end_alert, counts=True, cases=({"status": "complete"}, {"status": "failed"}))
RUN_BEGINS = (RUN_START, RUN_RESUME)
RUN_FAILED = event("run_failed", "error", "{text}", _QUEUE, alert=Alert("run_aborted"), counts=True)
"""Of one that may not have begun."""
GAP = event("gap", "warning", "until now nothing was recorded and nobody watched the stand, for {text}", _SHOW_SESSION)
RESET = event("reset", "warning", "the trip was reset before the run was resumed: {text}", _NOTHING)
STAND_DIFFERS = event("stand_differs", "warning", "{text}",
    "`stand stop` if that is not meant, and `stand resume` with the right --config")
JOURNAL_DAMAGED = event("journal_damaged", "warning", "{text}", "`stand status --plan` shows what counts as done")
JOURNAL_NOT_SAVED = event("journal_not_saved", "error", "{text}", DISK)
PLAN_CHANGED = event("plan_changed", lambda data: "info" if data.get("decided") else "warning", "{text}", _PLAN,
    counts=True, cases=({}, {"decided": "as a recipe says"}))
TELL_PLAN = (*RUN_BEGINS, PLAN_CHANGED)
"""Whose data have the number of `steps` and `frames` of the plan."""
UNDECIDED = event("undecided", "warning", "{text}", _PLAN)
STEP_BROKEN_OFF = event("step_broken_off", "warning", "{step} was broken off by an interlock ({text})",
    "nothing is to be done; it is done again when the hold is over", counts=True)
CAPTURE_RESTARTED = event("capture_restarted", "warning",
    "capture {step_id} is restarted, {text}; its {frames} frames so far do not count", _NEW_END, counts=True)
WARM_UP_GAP = event("warm_up_gap", "warning",
    "the run was held: the camera has warmed up for {missing_s:.1f} s without a frame", _CAREFUL, counts=True)
RESTORED = event("restored", "info", "{text}")
SOAK_RESTARTED = event("soak_restarted", "warning", "{text}; the soak is restarted", _NEW_END, counts=True)
SOAK_CREDITED = event("soak_credited", "info", "{text}")
SOAK_LONGER = event("soak_longer", "info", "{text}; the soak goes on, for {by_s:.0f} s at least")
SOAK_UNSETTLED = event("soak_unsettled", "warning", "{text}; the frames after it are marked as unsettled",
    "a fit leaves its frames out; give the recipe's soak more time, or see what keeps the chamber")
FRAME_UNSETTLED = event("frame_unsettled", "warning",
    "the chamber is at {degC:.1f} degC, not within {band_K:g} K of {chamber_degC:g} degC; a frame is marked so",
    "a fit leaves it out; give the soak before it more time, or see what disturbs the chamber")
SETTLED = event("settled", "info", "settled after {soaked_s:min} min: {text}")
NOT_SETTLED = event("not_settled", "warning", "not settled after {soaked_s:min} min: {text}",
    "the plan goes on; `max_s` of the recipe's soak gives it longer")
PROMPT = event("prompt", lambda data: "warning" if data.get("attended") else "info", "{what}",
    "`stand continue` when it is done",
    alert=lambda data: Alert("prompt", str(data.get("what"))) if data.get("attended") else None, counts=True,
    cases=({"attended": True}, {}))
PROMPT_SKIPPED = event("prompt_skipped", "warning", "no operator; not done: {what}",
    "`stand run --attended` waits for it", counts=True)
ETA_SLIPPED = event("eta_slipped", "info", "the run ends {later_s:min} min later than expected, at {text}",
    alert=Alert("eta_slipped"))


# The program: what clients order, the queue, the daemon.
def _describe_command(text: str, who: str, how: str, result: str, **_: object) -> str:
    """{who} ({how}): {text}"""
    return f"{who or 'somebody'} ({how}): {text}{'' if result == 'done' else f': {result}'}"


COMMAND = event("command", "info", _describe_command, counts=True, is_shown=True)
NOTE = event("note", "info", "{text}")
OPEN = event("open", "info", "{stand} is open; sessions go to {sessions}{text}")
QUEUE = event("queue", "info", "{text}", is_shown=True)
QUEUE_STILL_HALTED = event("queue_still_halted", "warning", "{text}", _QUEUE)
QUEUE_EMPTY = event("queue_empty", "info", "all that was queued is done", alert=Alert("queue_empty"))
NOT_RESUMED = event("not_resumed", "error", "run {run} is not resumed by itself: {text}",
    "`stand reset`, then `stand resume`")
RECORDING_RESTARTED = event("recording_restarted", "warning", "{session}: its writer was killed; the run is resumed",
    "see what killed it: `journalctl -k` reports a lack of memory")
IDLE_LOG_NOT_RECORDED = event("idle_log_not_recorded", "error",
    "nothing is recorded between runs, so nothing is heated: {text}", _SEE_DISK)
IDLE_LOG_NOT_ENDED = event("idle_log_not_ended", "warning", "{text}", _SEE_DISK)
"""The record between runs that was to be completed, or to be followed by today's."""
IDLE_LOGS_REMOVED = event("idle_logs_removed", "info",
    "records between runs older than {days} days were removed: {names}")
REPORTED = event("reported", "info", "the report of {session} is made; the page has it under Sessions")
REHEARSED = event("rehearsed", "info", "the rehearsal of {recipe} is done: {session}, marked as simulated")
NOT_REHEARSED = event("not_rehearsed", "warning", "the rehearsal of {recipe} ended: {text}",
    "`stand run RECIPE --config FILE --virtual-time` shows it in a terminal")
REPORT = event("report", "warning", "{session}: {text}",
    "the session's report shows where: *Sessions* on the page, or its report.html")
NOT_REPORTED = event("not_reported", "warning", "{text}", "`stand session list` shows what the session lacks")
DAEMON_NOT_KEPT = event("daemon_not_kept", "warning", "counters are not kept for the next start: {text}", _SEE_DISK)
DAEMON_FILE_DAMAGED = event("daemon_file_damaged", "warning", "{text}",
    "read the counters in the damaged file, if they matter")
LOOPBACK_TRUSTED = event("loopback_trusted", "warning",
    "every program of this machine {text} without a token (trust_loopback)",
    "take `interface.trust_loopback` out of the stand's file when that is not wanted")
TOKENS_READ = event("tokens_read", "info", "tokens were read again: {text}", is_shown=True)
TOKENS_NOT_READ = event("tokens_not_read", "warning", "{text}; the tokens stay as they were",
    "mend the file, and send SIGHUP again; `stand token list` reads it, too")
INTERFACE_FAILED = event("interface_failed", "warning", "{text}",
    "what runs goes on; once it has ended, begin `stand serve` again")
NO_CONTROL = event("no_control", "warning", "{text}", "Ctrl-C where it was begun still stops the run")
PREVIEW = event("preview", "warning", "{text}", "nothing is to be done; frames are recorded all the same")
