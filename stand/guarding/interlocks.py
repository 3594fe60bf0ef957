"""The guard's rules that need the latest readings only."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import CONNECTED, SENSOR, guard_rule
from thermostand.foundation.readings import Quality
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value

OVER_TEMPERATURE = guard_rule("over_temperature", "a temperature is above its limit")
SENSOR_MISSING = guard_rule("sensor_missing", "a temperature that heat depends on was never read", CONNECTED)
SENSOR_BAD = guard_rule("sensor_bad", "a device says that it has no measurement", CONNECTED)
SENSOR_STALE = guard_rule("sensor_stale", "a temperature was last good too long ago", CONNECTED)
SENSORS_DISAGREE = guard_rule("sensors_disagree", "two sensors of the same air differ", SENSOR)
DEVICE_FAULT = guard_rule("device_fault", "a device reports a fault, or a setting that somebody changed")
REGULATOR_STOPPED = guard_rule("regulator_stopped", "the regulator does not control though heat is permitted")
PERMIT_MISSING = guard_rule("permit_missing", "the relay that lets heat through is off though the regulator runs")
STAGE_ALARM = guard_rule("stage_alarm", "a stage's controller has an alarm")
SETTINGS_CHANGED = guard_rule(
    "settings_changed",
    "a stage's controller is set otherwise than its profile says",
    "set the stage's controller as its profile says; `stand check` compares them",
)
DEW = guard_rule("dew", "the flap is open while water would settle on what is inside")
CONTACT = guard_rule(
    "contact",
    "a contact of the stand is not as it should be",
    "see to it where it is; `stand status` shows what it reads",
)
FLAP_OPEN = guard_rule("flap_open", "the flap is open and nothing excuses it")
PAUSED_TOO_LONG = guard_rule("paused_too_long", "an operator has paused the run and not continued it")
CAMERA_TEMPERATURE_BAD = guard_rule("camera_temperature_bad", "the camera has no temperature while frames are to come")
DISK_LOW = guard_rule("disk_low", "the recorder takes no more frames")
SWITCHED_ON_WITHOUT_PERMISSION = guard_rule(
    "switched_on_without_permission", "others have switched heat, cold or the regulator on, twice"
)
HEAT_UNCONTROLLED = guard_rule("heat_uncontrolled", "the heat reads back other than commanded, and not off")
NOT_RECORDED = guard_rule("not_recorded", "what was measured is not on the disk in time")
FOLDER_LOST = guard_rule("folder_lost", "the folder of the session is not there any more")
RECORDING_ENDED = guard_rule("recording_ended", "the process that writes the session has ended")
_CAMERA_KNOWN_S = 60.0  # one that was cut off is not read any more: an operator must be able to reset that
_OPEN_ABOVE = 0.05  # of the flap's travel; closed, it reads 0 within the drive's tolerance


def limit_temperature(channel: str, max_degC: float, *, cuts_camera: bool = False) -> Rule:
    """`channel` reads above `max_degC`; a BAD or missing value is another rule's business. cuts_camera: it is the
    camera itself that is too warm, and what it read last counts no more when it has been off for a while."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        value_degC, reading = get_value(readings, channel), readings.known(channel)
        if cuts_camera and reading is not None and now_ns - reading.time_ns > to_ns(_CAMERA_KNOWN_S):
            return None
        if value_degC > max_degC:
            text = f"{channel} is {value_degC:.2f} degC, above the limit of {max_degC} degC"
            return Fault(OVER_TEMPERATURE, text, cuts_camera=cuts_camera)
        return None

    return rule


def require_fresh_reading(channel: str, stale_after_s: float) -> Rule:
    """`channel` was never read, was last GOOD more than `stale_after_s` ago, or the device itself has reported for
    the second poll that it has no measurement: sensor break, converter error, out of range.

    A poll or two may be STALE, or BAD by the wire: a reply that is late or garbled is asked for again.
    """
    declined_ns: int | None = None  # the first of the polls in a row in which the device had no measurement

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        nonlocal declined_ns
        reading, good_ns = readings.latest(channel), readings.last_good_ns(channel)
        if reading is None:
            return Fault(SENSOR_MISSING, f"{channel} has never been read")
        is_bad = reading.quality is Quality.BAD
        if declined_ns is not None and good_ns is not None and good_ns > declined_ns:
            declined_ns = None
        if is_bad and reading.cause != "wire":
            if declined_ns is not None and reading.time_ns > declined_ns:
                return Fault(SENSOR_BAD, f"{channel} is BAD: {reading.reason}")
            declined_ns = reading.time_ns
        age_s = math.inf if good_ns is None else (now_ns - good_ns) / NS_PER_S
        if age_s > stale_after_s:
            text = f"{channel} was last good {age_s:.1f} s ago, limit {stale_after_s} s"
            return (
                Fault(SENSOR_BAD, f"{channel} is BAD: {reading.reason}; {text}")
                if is_bad
                else Fault(SENSOR_STALE, text)
            )
        return None

    return rule


def limit_disagreement(channel: str, other: str, max_K: float) -> Rule:
    """Make the rule that objects when two sensors of the same air differ by more than `max_K`."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        value_degC, other_degC = get_value(readings, channel), get_value(readings, other)
        if abs(value_degC - other_degC) > max_K:
            text = f"{channel} {value_degC:.2f} degC and {other} {other_degC:.2f} degC differ by more than {max_K} K"
            return Fault(SENSORS_DISAGREE, text)
        return None

    return rule


def forbid_device_fault(channel: str) -> Rule:
    """A device says that something is wrong: a flag, whose reading's reason says what.

    The regulator's names a set-point changed by hand, and manual mode; its driver compares the set-point with the one
    it sent under the lock of both, so that a change of ours never looks like one of theirs.
    """

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.known(channel)
        if reading is not None and reading.value > 0:
            return Fault(DEVICE_FAULT, f"{channel}: {reading.reason}")
        return None

    return rule


def require_regulator_running(running: str, permit: str) -> Rule:
    """The stand permits heat, yet the regulator does not control: its keys were pressed."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        if get_value(readings, running) == 0 and get_value(readings, permit) == 1:
            return Fault(REGULATOR_STOPPED, f"{running} is 0 though heating is permitted: stopped at the unit")
        return None

    return rule


def require_permit_relay(running: str, permit: str) -> Rule:
    """The regulator controls, yet the relay that lets heat through stays open: a lost write, a stuck relay."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        if get_value(readings, running) == 1 and get_value(readings, permit) == 0:
            return Fault(PERMIT_MISSING, f"{permit} is off though the regulator runs")
        return None

    return rule


def forbid_stage_alarm(position: str) -> Rule:
    """An axis' controller has an alarm; not homed or without current, as before the first move, is none."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.known(position)
        if reading is not None and reading.cause == "alarm":
            return Fault(STAGE_ALARM, f"{position}: {reading.reason}")
        return None

    return rule


def forbid_changed_settings(channel: str) -> Rule:
    """A stage's controller is set otherwise than its profile says."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.known(channel)
        if reading is not None and reading.quality is Quality.GOOD and reading.reason:
            return Fault(SETTINGS_CHANGED, f"{channel.partition('.')[0]}: {reading.reason}")
        return None

    return rule


def forbid_dew(flap: str, channels: tuple[str, ...], lowest_degC: Callable[[Readings], float]) -> Rule:
    """The flap is open while one of the channels is below what water of the laboratory's air would settle on."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        if not get_value(readings, flap) > _OPEN_ABOVE:
            return None
        limit_degC = lowest_degC(readings)
        for channel in channels:
            value_degC = get_value(readings, channel)
            if value_degC < limit_degC:
                limit = f"and water may settle below {limit_degC:.1f} degC"
                return Fault(DEW, f"{channel} is {value_degC:.2f} degC with the flap open, {limit}")
        return None

    return rule


def require_contact_state(channel: str, fault_when: float, text: str) -> Rule:
    """A contact of the stand reads `fault_when` (0 open, 1 closed)."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        return Fault(CONTACT, text) if get_value(readings, channel) == fault_when else None

    return rule


def forbid_open_flap(position: str, is_excused: Callable[[], bool] = lambda: False) -> Rule:
    """The flap is open and nothing excuses it; how long that may last is the watch's grace time."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        openness = get_value(readings, position)
        if openness > _OPEN_ABOVE and not is_excused():
            return Fault(FLAP_OPEN, f"{position} is {openness:.2f}, open")
        return None

    return rule


def limit_pause(is_paused: Callable[[], bool]) -> Rule:
    """An operator's pause stands; how long it may is the watch's grace time."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        return Fault(PAUSED_TOO_LONG, "an operator has paused the run and not continued it") if is_paused() else None

    return rule


def require_camera_temperature(channel: str, frames_to_come: Callable[[], bool]) -> Rule:
    """The camera says that it has no temperature, while it is powered and frames are to come: no model of drift can use
    those. One that does not answer at all is lost, which is another matter."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.known(channel)
        if reading is not None and reading.quality is Quality.BAD and frames_to_come():
            return Fault(CAMERA_TEMPERATURE_BAD, f"{channel} is BAD: {reading.reason}")
        return None

    return rule


def require_frame_recording(reason: Callable[[], str]) -> Rule:
    """The recorder takes no more frames; `reason()` says why, "" while it does."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        return Fault(DISK_LOW, reason()) if reason() else None

    return rule


def forbid_intrusion(times: Callable[[], int]) -> Rule:
    """Heat, cold or the regulator were switched on, twice since the permission was withdrawn, by others. The first
    time is put right with an event; a second one does not end by itself."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        if times() < 2:
            return None
        text = f"heat, cold or the regulator were switched on {times()} times without permission: by whom?"
        return Fault(SWITCHED_ON_WITHOUT_PERMISSION, text)

    return rule


def forbid_uncontrolled_heat(why: Callable[[], str]) -> Rule:
    """What a regulator of our own heats by does not obey: it reads back other than commanded, and not off. No grace:
    the relay in series is all that ends the heat then."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        return Fault(HEAT_UNCONTROLLED, f"the heat does not obey: {why()}") if why() else None

    return rule


class Recording(Protocol):
    """What a rule may ask of the recorder; it never asks the disk."""

    @property
    def waiting_since_ns(self) -> int | None:
        """The instant at which the oldest item was published that is not yet durable in the session's own folder; None:
        nothing due."""
        ...

    @property
    def folder_lost(self) -> str:
        """Why the session's folder is not there any more; "" while it is."""
        ...

    @property
    def writer_ended(self) -> str:
        """Why the process that writes the session is not there any more; "" while it is."""
        ...


def require_durable_recording(recording: Recording, durable_within_s: float) -> Rule:
    """Readings, frames or events are not on the disk in time: heat without a record is of no use."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        since_ns = recording.waiting_since_ns
        if since_ns is None or now_ns - since_ns <= to_ns(durable_within_s):
            return None
        age_s = (now_ns - since_ns) / NS_PER_S
        text = f"what was measured {age_s:.0f} s ago is not on the disk yet, limit {durable_within_s:g} s"
        return Fault(NOT_RECORDED, text)

    return rule


def require_session_folder(recording: Recording) -> Rule:
    """The session's folder was removed or renamed while it is being recorded."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        return Fault(FOLDER_LOST, recording.folder_lost) if recording.folder_lost else None

    return rule


def require_recording_process(recording: Recording) -> Rule:
    """Make the rule that trips when nothing will be recorded any more in this run: the process that writes the session
    was killed."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        ended = recording.writer_ended
        return Fault(RECORDING_ENDED, f"{ended}; nothing is recorded any more") if ended else None

    return rule
