"""What must be so whatever breaks. An invariant is a function of the evidence that yields a sentence for each
violation; `@invariant` enters it, and says of which leg it is: virtual time, real time, or both."""

from __future__ import annotations

import bisect
import itertools
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import Flag, auto

import numpy as np

from tests import fork_server
from tests.torture.evidence import STEP_S, Evidence
from tests.torture.lives import COMPLETE, KILLED, ROOT

Rule = Callable[[Evidence], Iterable[str]]
INVARIANTS: dict[str, Rule] = {}
LEGS: dict[str, Leg] = {}
MAX_AIR_DEGC, ABOVE_K = 65.0, 3.0
FLAP_SHUT_S = 60.0
BAND_K = 1.0  # of a soak
EXPOSED_S = 0.5  # a frame's instant is the middle of its exposure, which begins when it is taken
DURABLE_S = 15.0  # what is younger may be lost by a kill
LONGEST_GAP_S, PROBED_S = 30.0, 60.0  # between readings; of how long a device is not asked that was lost
MOST_AN_HOUR = 6
RELAYS_UNIT, TIMED_ON = 2, 0x0200
STOP_S, TIMES_LATE = 1.0, 10.0  # as `python -m tests.bench stop` has it; of how late a thread beside was woken
STATUSES = (COMPLETE, 1, 4, 130, KILLED)


@dataclass(frozen=True, slots=True)
class Violation:
    """`rule` was broken; the first of its sentences, and how many there are."""

    rule: str
    text: str
    count: int


class Leg(Flag):
    """In which time it must be so."""

    VIRTUAL, REAL = auto(), auto()
    BOTH = VIRTUAL | REAL


def invariant(of: Leg) -> Callable[[Rule], Rule]:
    """Enter it under its name."""

    def enter(rule: Rule) -> Rule:
        INVARIANTS[rule.__name__], LEGS[rule.__name__] = rule, of
        return rule

    return enter


def violations(evidence: Evidence) -> list[Violation]:
    """All that is not as it must be; of a program that hung and was killed for it only that."""
    hung = any(life.status is None for life in evidence.lives)
    rules = {"ends_as_documented": ends_as_documented} if hung else INVARIANTS
    leg = Leg.REAL if evidence.case.is_real else Leg.VIRTUAL
    judged = ((name, list(rule(evidence))) for name, rule in rules.items() if LEGS[name] & leg)
    return [Violation(name, sentences[0], len(sentences)) for name, sentences in judged if sentences]


# The plant


@invariant(Leg.BOTH)
def air_is_never_too_warm(evidence: Evidence) -> Iterator[str]:
    for truth in evidence.truth:
        for row in truth[truth["bulk_air_degC"] > MAX_AIR_DEGC + ABOVE_K][:1]:
            yield f"the air is {row['bulk_air_degC']:.1f} degC at {evidence.at_s(int(row['time_ns']))} s"


def _since_s(times_ns: np.ndarray, marks_ns: Iterable[int]) -> np.ndarray:
    """How long before each instant the last mark was, s; infinite where there was none."""
    marks = np.array(list(marks_ns), dtype=np.int64)
    places = np.searchsorted(marks, times_ns, side="right") - 1
    since = np.full(len(times_ns), np.inf)
    since[places >= 0] = (times_ns[places >= 0] - marks[places[places >= 0]]) / 1e9
    return since


def _armed(evidence: Evidence, life: int) -> Iterator[int]:
    """When the heater's relay was switched on for a time."""
    for each in evidence.bus[life]:
        if each.unit == RELAYS_UNIT and each.function == 5 and each.address == TIMED_ON:
            yield each.time_ns


@invariant(Leg.BOTH)
def heat_needs_a_permission_of_the_last_15_s(evidence: Evidence) -> Iterator[str]:
    """The relay's timer, armed by a guard that looks; what a second master switches on is off within 5 s."""
    for life, truth in enumerate(evidence.truth if "relays" in evidence.stand else ()):
        on_ns = truth["time_ns"][truth["heater_enabled"] > 0]
        late = _since_s(on_ns + int(STEP_S * 1e9), _armed(evidence, life)) > evidence.hold_s + 2 * STEP_S
        for at_s in map(evidence.at_s, map(int, on_ns[late])):
            is_odd = evidence.excused(at_s, "bus", "relays", after_s=evidence.hold_s + 2 * evidence.look_s)
            if not is_odd and not evidence.ordered(at_s, "switch_on", evidence.hold_s + 2 * evidence.look_s):
                yield f"the heater's relay is on at {at_s} s, {evidence.hold_s:g} s after it was last armed"


@invariant(Leg.BOTH)
def heat_needs_fresh_readings(evidence: Evidence) -> Iterator[str]:
    """The relay is armed only while the module with the air's thermometer answers. Before the first reading the board's
    timer is tested, with the regulator stopped."""
    unit = evidence.stand["thermometer_module"]["unit"]
    for life, bus in enumerate(evidence.bus if "relays" in evidence.stand else ()):
        read = [each.time_ns for each in bus if each.unit == unit and each.function in (3, 4) and each.is_answered]
        armed = np.array(list(_armed(evidence, life)), dtype=np.int64)
        late = (_since_s(armed, read) > evidence.stale_s + evidence.look_s) & (armed > read[0] if read else False)
        for time_ns in armed[late]:
            yield f"heat was permitted at {evidence.at_s(int(time_ns))} s without a reading of the air"


@invariant(Leg.BOTH)
def nothing_heats_unrecorded(evidence: Evidence) -> Iterator[str]:
    """No heat before the run's begin is recorded."""
    begun = [event.time_ns for event in evidence.events if event.kind in ("run.start", "run.resume")]
    for truth in evidence.truth:
        heats = (truth["heater_enabled"] > 0) & (truth["heater_on_fraction"] > 0) & (truth["cut_out_open"] == 0)
        for row in truth[heats][:1]:
            at_s = evidence.at_s(int(row["time_ns"]))
            is_odd = evidence.excused(at_s, "heater", "relays.welded", "heat_module", "regulator", after_s=30.0)
            is_odd = is_odd or evidence.ordered(at_s, "switch_on", evidence.hold_s)
            if not is_odd and (not begun or int(row["time_ns"]) + STEP_S * 1e9 < min(begun)):
                yield f"heat at {at_s} s, before anything was recorded"


@invariant(Leg.BOTH)
def compressor_rests(evidence: Evidence) -> Iterator[str]:
    """Also from life to life. What somebody else switches is none of ours."""
    off_s = None
    has_one = "compressor" in evidence.stand.get("relays", {}).get("channels", {})
    for truth in evidence.truth if has_one else ():
        on = truth["compressor_on"] > 0
        for place in np.flatnonzero(on[1:] != on[:-1]) + 1:
            at_s = evidence.at_s(int(truth["time_ns"][place]))
            is_odd = evidence.excused(at_s, "relays", "bus", after_s=30.0) or evidence.ordered(at_s, "switch_on", 30.0)
            if on[place] and off_s is not None and not is_odd and at_s - off_s < evidence.min_off_s - 2 * STEP_S:
                yield f"the compressor starts at {at_s} s, {at_s - off_s:.0f} s after it stopped"
            off_s = off_s if on[place] else at_s


# The flap, and the safe state


def _holds(evidence: Evidence) -> Iterator[tuple[int, int]]:
    """From when to when the guard's interlock held the run."""
    begun_ns = None
    for event in sorted(evidence.events, key=lambda each: each.time_ns):
        is_interlock = event.data.get("reason") == "interlock"
        if event.kind == "held" and is_interlock:
            begun_ns = begun_ns or event.time_ns
        elif begun_ns and (
            (event.kind == "released" and is_interlock) or event.kind in ("gap", "run.resume", "run.end")
        ):
            yield begun_ns, event.time_ns
            begun_ns = None


@invariant(Leg.BOTH)
def flap_is_open_for_captures_only(evidence: Evidence) -> Iterator[str]:
    """From the begin of a step that opens it (a look in a soak, too) to the end of the one that closes it."""
    opens = sorted(
        (mark.time_ns, mark.kind != "close_flap" or mark.state != "done")
        for mark in evidence.marks
        if mark.kind in ("open_flap", "close_flap", "soak_until_settled")
    )
    times_ns = [time_ns for time_ns, _ in opens]
    for truth in evidence.truth if "flap" in evidence.stand else ():
        for row in truth[truth["flap_open"] > 0.5][:: int(10 / STEP_S)]:
            place = int(np.searchsorted(times_ns, int(row["time_ns"]), side="right")) - 1
            at_s = evidence.at_s(int(row["time_ns"]))
            if (place < 0 or not opens[place][1]) and not evidence.excused(at_s, "flap", after_s=FLAP_SHUT_S):
                yield f"the flap is open at {at_s} s, outside captures"


def _safe(evidence: Evidence) -> dict[str, float]:
    """What is off, or shut, in the safe state, and within how many s."""
    off_s = evidence.hold_s + evidence.look_s
    return {"heater_enabled": off_s, "compressor_on": off_s, "flap_open": FLAP_SHUT_S}


@invariant(Leg.BOTH)
def holds_are_safe(evidence: Evidence) -> Iterator[str]:
    for begin_ns, end_ns in _holds(evidence):
        for truth in evidence.truth:
            if len(truth) and truth["time_ns"][0] <= begin_ns <= truth["time_ns"][-1]:
                for name, within_s in _safe(evidence).items():
                    yield from _acting(evidence, truth, name, begin_ns + int(within_s * 1e9), end_ns, "a hold")


@invariant(Leg.BOTH)
def ends_are_safe(evidence: Evidence) -> Iterator[str]:
    """30 s after the program is gone, however it went, and from then on; apart from what nobody is left to end: a flap,
    and a climate chamber without a relay, which goes on at its set-point."""
    left = ("flap_open",) if "relays" in evidence.stand else ("flap_open", "compressor_on")
    for number, (truth, life) in enumerate(zip(evidence.truth, evidence.lives, strict=True)):
        for name in _safe(evidence) if len(truth) else ():
            if name not in left or life.status != KILLED:
                begin_ns, end_ns = evidence.off_from_ns(number), int(truth["time_ns"][-1])
                yield from _acting(evidence, truth, name, begin_ns, end_ns, f"the end with status {life.status}")


@invariant(Leg.REAL)
def heat_ends_with_the_program(evidence: Evidence) -> Iterator[str]:
    """By the relay's timer, while the program is stopped; that of one which was killed is in `ends_are_safe`."""
    for row in (row for doors in evidence.doors for row in doors if row["verb"] == "daemon_stopped"):
        begin_ns = row["time_ns"] + int((evidence.hold_s + 2 * STEP_S) * 1e9)
        for truth in evidence.truth:
            end_ns = row["time_ns"] + int(row["body"]["for_s"] * 1e9)
            yield from _acting(evidence, truth, "heater_enabled", begin_ns, end_ns, "a program that is stopped")


@invariant(Leg.REAL)
def a_stop_is_answered(evidence: Evidence) -> Iterator[str]:
    """By a program that has its doors open and is neither stopped nor about to end."""
    rows = [row for doors in evidence.doors for row in doors]
    stops = [(evidence.at_s(row["time_ns"]), row["body"]["for_s"]) for row in rows if row["verb"] == "daemon_stopped"]
    for row in (row for row in rows if row["verb"] == "stop_pressed"):
        at_s, body = evidence.at_s(row["time_ns"]), row["body"]
        begin_s, limit_s = at_s - body["took_s"], STOP_S + TIMES_LATE * body["late_s"]
        is_open = any(
            life.opened_ns
            and life.opened_ns + life.offset_ns <= row["time_ns"] - int(body["took_s"] * 1e9)
            and row["time_ns"] + int(10e9) <= life.ended_ns + life.offset_ns
            for life in evidence.lives
        )
        is_stopped = any(stop_s - 1.0 <= at_s and begin_s <= stop_s + for_s + 1.0 for stop_s, for_s in stops)
        if is_open and not is_stopped and body["took_s"] > limit_s:
            late = f"a thread beside was {body['late_s']} s late"
            yield f"a STOP by {body['way']} took {body['took_s']} s at {at_s} s, {late}"


def _acting(evidence: Evidence, truth: np.ndarray, name: str, begin_ns: int, end_ns: int, when: str) -> Iterator[str]:
    """The first time at which this is on, or open, though what drives it can be reached."""
    drives = ("flap",) if name == "flap_open" else ("relays", "bus")
    if name == "compressor_on" and "climate_chamber" in evidence.stand:
        drives = ("chamber",)
    elif name == "heater_enabled" and "relays" not in evidence.stand:
        return
    is_within = (truth["time_ns"] > begin_ns) & (truth["time_ns"] < end_ns - int(STEP_S * 1e9))
    for row in truth[is_within & (truth[name] > 0.01)]:
        at_s = evidence.at_s(int(row["time_ns"]))
        if not evidence.excused(at_s, *drives, after_s=60.0) and not evidence.ordered(at_s, "switch_on", 40.0):
            yield f"{name} is {row[name]:.2g} at {at_s} s, in {when}"
            return


# Records


@invariant(Leg.BOTH)
def files_are_readable(evidence: Evidence) -> Iterator[str]:
    yield from evidence.unreadable if evidence.is_complete else ()


@invariant(Leg.BOTH)
def frames_saved_are_recorded_once(evidence: Evidence) -> Iterator[str]:
    """What HTTP said was saved, and what captures that are done have to have since they were begun last: no more of a
    camera that nothing has befallen."""
    for (topic, time_ns), count in evidence.frames.items():
        if count > 1:
            yield f"{topic} has the frame at {evidence.at_s(time_ns)} s {count} times"
    for row in (row for doors in evidence.doors for row in doors):
        run = row["answer"].get("run") if isinstance(row["answer"], dict) else None
        due = sum(time_ns <= row["time_ns"] + EXPOSED_S * 1e9 for _, time_ns in evidence.frames)
        if run and run["frames_saved"] > due:
            at_s = evidence.at_s(row["time_ns"])
            yield f"{run['frames_saved']} frames were saved at {at_s} s, of which {due} are there"
    skipped = {entry.get("step_id") for entry in evidence.journal if entry["entry"] == "Skipped"}
    lost = {event.data.get("step_id") for event in evidence.events if "lost" in event.kind or "dropped" in event.kind}
    times_ns = {time_ns for _, time_ns in evidence.frames}
    begun_ns = {event.data["step_id"]: event.time_ns for event in evidence.events if event.kind == "capture_restarted"}
    taken = Counter(
        step_id
        for time_ns, step_id, _ in evidence.metas
        if time_ns in times_ns and time_ns >= begun_ns.get(step_id, time_ns)
    )
    is_lossy = any(event.kind == "camera_lost" for event in evidence.events) or any(
        fault.name.startswith("camera") for fault in evidence.case.faults
    )
    for mark in evidence.marks:
        if mark.kind == "capture" and mark.state == "done" and mark.step_id not in skipped | lost:
            cameras = len(mark.parameters.get("cameras", ())) or len(evidence.stand["cameras"])
            found, wanted = taken[mark.step_id], mark.parameters["frames"] * cameras
            if evidence.is_complete and (found < wanted or (found > wanted and not is_lossy)):
                yield f"the capture {mark.step_id} is done with {found} of {wanted} frames"


@invariant(Leg.BOTH)
def journal_and_recording_agree(evidence: Evidence) -> Iterator[str]:
    """The steps that are done, of a run that is complete and was not killed: each once in both."""
    if not evidence.is_complete or evidence.killed:
        return
    journal = Counter((row["step_id"], row["state"]) for row in evidence.journal if row["entry"] == "Step")
    journal.update((row["step_id"], "skipped") for row in evidence.journal if row["entry"] == "Skipped")
    recorded = Counter((mark.step_id, mark.state) for mark in evidence.marks if mark.state != "failed")
    for key in sorted(journal.keys() | recorded.keys()):
        if journal[key] != recorded[key]:
            yield f"step {key[0]} {key[1]}: {journal[key]} times in the journal, {recorded[key]} in the recording"


@invariant(Leg.BOTH)
def frames_are_at_their_temperature(evidence: Evidence) -> Iterator[str]:
    """The air is within the soaks' band and what its sensor may be off, or the frame says `unsettled`. Each capture
    of a case has a soak before it, which somebody may have left out."""
    wanted = {mark.step_id: mark.parameters.get("chamber_degC") for mark in evidence.marks if mark.kind == "capture"}
    for time_ns, step_id, flags in evidence.metas:
        at_s, degC, row = evidence.at_s(time_ns), wanted.get(step_id), evidence.true_at(time_ns)
        is_odd = evidence.excused(at_s, "thermometer", "regulator", "chamber", after_s=600.0)
        if degC is None or row is None or is_odd or "unsettled" in flags:
            continue
        if abs(float(row["bulk_air_degC"]) - degC) > BAND_K + _SENSOR_K:
            yield f"a frame at {at_s} s for {degC:g} degC was taken at {row['bulk_air_degC']:.2f} degC"


_SENSOR_K = 1.0  # the module's +-0.1 % of 200 K, a converter's noise, and how far the plant moves within a poll
_TRUE = {name: f"{name}_degC" for name in ("air", "granite_inside", "granite_outside", "artifact", "laboratory")}


@invariant(Leg.BOTH)
def readings_are_true(evidence: Evidence) -> Iterator[str]:
    """A GOOD reading is what the plant was, within what its sensor may be off; of sensors that were not broken."""
    for name, rows in evidence.temperatures.items():
        for time_ns, value, quality in rows if name in _TRUE else ():
            at_s, row = evidence.at_s(time_ns), evidence.true_at(time_ns)
            is_odd = evidence.excused(at_s, "thermometer", "regulator.probe_exchanged", after_s=30.0)
            # What has drifted stays so far off.
            is_odd = is_odd or evidence.excused(at_s, "thermometer.drift_K_per_h", after_s=math.inf)
            if row is None or is_odd or not quality.endswith("GOOD"):
                continue
            if abs(value - (true := float(row[_TRUE[name]]))) > _SENSOR_K:
                yield f"{name} was read as {value:.2f} degC at {at_s} s, and is {true:.2f} degC"


@invariant(Leg.BOTH)
def http_says_what_is_recorded(evidence: Evidence) -> Iterator[str]:
    """A temperature that HTTP showed is in the recording, but for the last ones before a kill."""
    if not evidence.is_complete or any("lost" in event.kind or "dropped" in event.kind for event in evidence.events):
        return
    recorded = {name: sorted((row[0], row[1]) for row in rows) for name, rows in evidence.temperatures.items()}
    for row in (row for doors in evidence.doors for row in doors):
        readings = row["answer"].get("readings", {}) if isinstance(row["answer"], dict) else {}
        for channel, shown in readings.items():
            device, _, name = channel.partition(".")
            if device != "thermometers" or shown["unit"] != "degC" or shown["quality"] != "good":
                continue
            at_s, time_ns = evidence.at_s(shown["time_ns"]), shown["time_ns"]
            rows = recorded.get(name, [])
            first = bisect.bisect_left(rows, (time_ns, -math.inf))
            last = bisect.bisect_right(rows, (time_ns + evidence.batch_ns, math.inf))
            values = [value for _, value in rows[first:last]]
            is_recorded = any(abs(value - shown["value"]) < 1e-6 for value in values)
            if not is_recorded and not evidence.killed_soon(at_s, DURABLE_S):
                yield f"HTTP showed {channel} {shown['value']:.3f} of {at_s} s, the recording has {values}"


@invariant(Leg.BOTH)
def readings_go_on(evidence: Evidence) -> Iterator[str]:
    """The air is recorded from the first reading of a life to its last, also where it cannot be read."""
    times_ns = np.array([row[0] for row in evidence.temperatures.get("air", ())], dtype=np.int64)
    begins_ns = [int(truth["time_ns"][0]) for truth in evidence.truth if len(truth)] if evidence.is_complete else []
    for begin_ns, end_ns in itertools.pairwise([*begins_ns, sys.maxsize]):
        own = np.unique(times_ns[(times_ns >= begin_ns) & (times_ns < end_ns)])
        for place in np.flatnonzero(np.diff(own) > LONGEST_GAP_S * 1e9):
            at_s = evidence.at_s(int(own[place]))
            if not evidence.excused(at_s + LONGEST_GAP_S, "bus", "thermometers", after_s=PROBED_S):
                yield f"no reading of the air for {(own[place + 1] - own[place]) / 1e9:.0f} s from {at_s} s on"


@invariant(Leg.BOTH)
def verify_finds_what_is_lost_and_nothing_else(evidence: Evidence) -> Iterator[str]:
    """Of a run that is complete nothing is damaged, and what is missing has an event that says so."""
    if not evidence.is_complete:
        return
    program = [sys.executable, "-m", "thermostand.stand.cli", "session", "verify", "--json", str(evidence.session)]
    ended = fork_server.run(program, cwd=ROOT, capture_output=True, text=True)
    try:
        found = json.loads(ended.stdout)
    except ValueError:
        yield f"verify ended with {ended.returncode}: {ended.stderr[-300:]}"
        return
    lost = any("lost" in event.kind or "dropped" in event.kind for event in evidence.events)
    if not found["sound"] and not lost:
        yield f"verify finds {found['findings'][:2]}"
    if found["frames"] != len(evidence.frames):
        yield f"verify counts {found['frames']} frames, there are {len(evidence.frames)}"


# How it ends


@invariant(Leg.BOTH)
def ends_as_documented(evidence: Evidence) -> Iterator[str]:
    for number, life in enumerate(evidence.lives):
        if life.status is None:
            yield f"life {number} hung: {life.err[-3000:]}"
        elif life.status not in STATUSES:
            yield f"life {number} ended with status {life.status}: {(life.err or life.out)[-400:]}"
        elif any(word in life.err for word in ("Traceback", "never retrieved", "was destroyed")):
            yield f"life {number}: {life.err[-600:]}"
        elif life.status not in (COMPLETE, KILLED) and not life.err.strip():
            yield f"life {number} ended with status {life.status} and said nothing"


@invariant(Leg.REAL)
def nothing_is_left(evidence: Evidence) -> Iterator[str]:
    """What the program has started ends with it."""
    yield from evidence.lives[-1].left


@invariant(Leg.BOTH)
def is_completed_in_the_end(evidence: Evidence) -> Iterator[str]:
    """Faults end; a run that is resumed after them comes to its end."""
    last = evidence.lives[-1]
    if last.status is not None and not evidence.is_complete and "complete, but" not in last.err:
        yield f"not complete after {len(evidence.lives)} lives: {last.err.strip()[-400:]}"


@invariant(Leg.VIRTUAL)
def advice_says_what_to_mend(evidence: Evidence) -> Iterator[str]:
    """Who resumes mends what he was reported: nothing ends a run a third time with the same words."""
    ends = (life.err.strip().splitlines() for life in evidence.lives if life.status in (1, 4))
    event = Counter(_without_numbers(lines[-1]) for lines in ends if lines)
    for words, count in event.items():
        if count > 2:
            yield f"{count} lives ended with: {words[:300]}"


def _without_numbers(text: str) -> str:
    return re.sub(r"[\d.]+", "#", text)


@invariant(Leg.BOTH)
def nobody_is_pestered(evidence: Evidence) -> Iterator[str]:
    """No warning or error more than six times an hour."""
    times: dict[tuple[str, str], set[int]] = {}  # what is reported while a run begins is in two records
    for event in evidence.events:
        if event.level != "info":
            times.setdefault((event.kind, _without_numbers(event.text)), set()).add(event.time_ns)
    for (kind, text), instants in times.items():
        when = sorted(instants)
        spans = [last - first for first, last in zip(when, when[MOST_AN_HOUR:], strict=False)]
        if spans and min(spans) < 3600e9:
            yield f"{kind} {MOST_AN_HOUR + 1} times in {min(spans) / 1e9:.0f} s: {text[:200]}"
