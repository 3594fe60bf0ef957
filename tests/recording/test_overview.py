import fcntl
import math
import os
import shutil
import threading

import numpy as np
import pytest

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.instants import format_date_time, format_duration, format_utc, parse_instant
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading, bad_reading
from thermostand.recording.format.inventory import SegmentState, list_segments
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.scan import scan

from .full_session import ATTACHMENTS, START_NS, record

SECONDS = 10
CAPTURE = {"frames": 6, "interval_s": 1.0, "role": "fit", "chamber_degC": 31.0}


def frame(time_ns, index):
    image = np.random.default_rng(index).integers(0, 4000, (12, 16), np.uint16)
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, index, 7 * index, 3 if index == 5 else 0, "capture")


def second(time_ns, index):
    """A run with a step that is done, one that failed, and one whose end was not recorded."""
    air = Reading("thermometers.air", 20.0 + index, "degC", time_ns)
    camera = bad_reading("camera.temperature", "degC", time_ns, "no answer")
    yield Batch("thermometers", time_ns, (air if index != 2 else bad_reading(air.channel, "degC", time_ns, "break"),))
    yield Batch("camera", time_ns, (camera,))
    yield Batch("linear", time_ns, (Reading("linear.position", 1.0, "mm", time_ns),))
    marks = {
        0: ("soak", 3, "soak", StepState.STARTED, {"duration_s": 2.0}),
        2: ("soak", 3, "soak", StepState.DONE, {"duration_s": 2.0}),
        3: ("capture", 4, "capture", StepState.STARTED, CAPTURE),
        8: ("capture", 4, "capture", StepState.FAILED, CAPTURE),
        9: ("flap", 5, "close_flap", StepState.STARTED, {}),
    }
    if index in marks:
        yield StepMark(time_ns, *marks[index])
    if 3 <= index < 8:
        yield frame(time_ns, index)
    if index == 4:
        yield Event(time_ns, "warning", "device_lost", "camera: no answer")
    if index == SECONDS - 1:
        yield Event(time_ns, "error", "run.end", "aborted: stopped by the operator")


@pytest.fixture
async def session(tmp_path):
    await record(tmp_path / "s", SECONDS, items=second, segment_s=4.0, period_ns=NS_PER_S)
    return tmp_path / "s"


async def test_a_glance_tells_what_when_and_how_much(session):
    seen = scan(session)
    files = list(session.rglob("*.mcap"))
    assert (seen.frames, seen.files, seen.simulated) == (5, "sound", False)
    assert (seen.begin_ns, seen.end_ns) == (START_NS, START_NS + 9 * NS_PER_S)
    assert seen.size_bytes == sum(path.stat().st_size for path in files)
    assert seen.metadata["recipe"] == "thermal_cycle"
    assert list(seen.attachments) == list(ATTACHMENTS)
    assert seen.count(SegmentState.FINISHED) == len(files)


async def test_the_overview_has_the_steps_as_they_went(session):
    steps = summarise_session(session).steps
    assert [(step.index, step.kind, str(step.state), step.frames) for step in steps] == [
        (3, "soak", "done", 0),
        (4, "capture", "failed", 5),
        (5, "close_flap", "started", 0),
    ]
    assert [step.begin_ns - START_NS for step in steps] == [0, 3 * NS_PER_S, 9 * NS_PER_S]
    assert [step.end_ns and step.end_ns - START_NS for step in steps] == [2 * NS_PER_S, 8 * NS_PER_S, None]
    assert steps[1].parameters == CAPTURE


async def test_the_overview_has_frames_temperatures_and_events(session):
    found = summarise_session(session)
    frames = found.frames
    assert (frames.count, frames.dropped) == (5, 3)
    assert frames.pixels == "16 x 12 px, 16 bit"
    assert (frames.first_ns, frames.last_ns) == (START_NS + 3 * NS_PER_S, START_NS + 7 * NS_PER_S)
    camera, _, air = found.channels
    assert (air.channel, air.unit, air.count, air.bad, air.min, air.max) == ("thermometers.air", "degC", 10, 1, 20, 29)
    assert air.mean == pytest.approx((sum(range(20, 30)) - 22) / 9)
    assert (camera.channel, camera.count, camera.bad) == ("camera.temperature", 10, 10)
    assert math.isnan(camera.mean)
    assert found.gaps == found.scanned.findings == ()
    assert [event.kind for event in found.events] == ["device_lost", "run.end"]
    assert found.ending is not None
    assert found.ending.text.partition(":")[0] == "aborted"


async def test_a_damaged_segment_is_reported_and_the_others_are_read(session):
    path = session / "telemetry" / "0001.mcap"
    path.write_bytes(path.read_bytes()[:-20])
    assert scan(session).state_text.startswith("damaged: telemetry/0001.mcap: ")
    found = summarise_session(session)
    assert {each.where for each in found.scanned.findings} == {"telemetry/0001.mcap"}
    assert 5 <= found.channels[2].count < 10
    assert found.frames.count == 5


async def test_a_recording_without_a_finished_segment_still_tells_what_it_is(session):
    for path in session.rglob("*.mcap"):
        path.rename(path.with_name(f"{path.name}.part"))
    seen = scan(session)
    assert seen.metadata["recipe"] == "thermal_cycle"
    assert (seen.files, len(seen.sentences(seen.files))) == ("incomplete", len(seen.inventory))
    assert (seen.frames, seen.begin_ns, seen.end_ns) == (0, None, None)
    assert summarise_session(session).steps == ()


async def test_a_session_without_telemetry_is_not_complete(session):
    for path in (session / "telemetry").iterdir():
        path.rename(path.with_name(f"{path.name}.damaged"))
    kept = len(list((session / "telemetry").iterdir()))
    sentence = scan(session).state_text
    assert sentence.startswith("damaged: telemetry/0000.mcap.damaged: ")
    assert sentence.endswith(f" and {kept - 1} more")
    shutil.rmtree(session / "telemetry")
    assert scan(session).state_text == "incomplete: telemetry: is missing"
    assert summarise_session(session).frames.count == 5


async def test_frames_that_the_recorder_lost_are_counted_apart_from_those_that_never_came(tmp_path):
    def items(time_ns, index):
        yield from second(time_ns, index)
        if index == 8:
            for blocks in ([[4, 5], [7, 7]], [[9, 9]]):
                yield Event(time_ns, "error", "frames_dropped", "frames lost", {"blocks": blocks})

    await record(tmp_path / "s", SECONDS, items=items, period_ns=NS_PER_S)
    frames = summarise_session(tmp_path / "s").frames
    assert (frames.dropped, frames.lost_by_recorder) == (3, 4)


async def test_what_a_salvage_kept_and_what_is_no_segment(session):
    shutil.copy(session / "frames" / "0000.mcap", session / "frames" / "0000.2.mcap.damaged")
    (session / "frames" / "notes.txt").write_text("a cloudy day")
    seen = scan(session)
    assert seen.state_text.startswith("damaged: frames/0000.2.mcap.damaged: ")
    assert [finding.where for finding in seen.findings] == ["frames/0000.2.mcap.damaged"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
async def test_a_segment_that_may_not_be_opened_hides_no_other(session):
    before = scan(session)
    part = session / "telemetry" / "0009.mcap.part"
    part.write_bytes(b"")
    part.chmod(0)
    assert scan(session).state_text.startswith("incomplete: telemetry/0009.mcap.part: is not finished")
    assert [file for file in list_segments(session) if file.path != part] == list(before.inventory)


def test_a_segment_that_is_given_another_name_meanwhile_hides_no_other(tmp_path):
    folder = tmp_path / "telemetry"
    folder.mkdir()
    (folder / "0000.mcap").write_bytes(b"")
    part = folder / "0001.mcap.part"
    part.write_bytes(b"")
    stop = threading.Event()

    def rename():
        while not stop.is_set():
            part.rename(folder / "being-named")
            (folder / "being-named").rename(part)

    renaming = threading.Thread(target=rename)
    renaming.start()
    try:
        seen = [[file.name for file in list_segments(tmp_path)] for _ in range(2000)]
    finally:
        stop.set()
        renaming.join()
    assert all(names[:1] == ["telemetry/0000.mcap"] for names in seen)


async def test_a_look_leaves_no_lock(session):
    part = session / "telemetry" / "0009.mcap.part"
    part.write_bytes(b"")
    assert list_segments(session)
    with part.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        assert [entry.state for entry in list_segments(session) if entry.path == part] == [SegmentState.RECORDING]


def test_a_folder_without_segments_is_no_session(tmp_path):
    (tmp_path / "telemetry").mkdir()
    with pytest.raises(SessionError, match="not a session"):
        scan(tmp_path)


@pytest.mark.parametrize(
    ("text", "after_begin_s"),
    [
        ("+90", 90),
        ("+1h30m", 5400),
        ("+2m5.5s", 125.5),
        ("+0s", 0),
        ("1970-01-01T00:00:12", 2),
        ("1970-01-01T01:00:12+01:00", 2),
        ("1970-01-01 00:01:00.25Z", 50.25),
    ],
)
def test_an_instant_is_a_time_in_utc_or_counts_from_the_beginning(text, after_begin_s):
    assert parse_instant(text, 10 * NS_PER_S) == round((10 + after_begin_s) * NS_PER_S)


@pytest.mark.parametrize("text", ["", "+", "noon", "+5x", "12:00", "+-5", "2026-13-01"])
def test_what_is_no_time_says_what_would_be(text):
    with pytest.raises(ConfigError, match=r"2026-01-01T18:30:00, \+1h30m or step:12"):
        parse_instant(text, 0)


@pytest.mark.parametrize(
    "text", ["+99999999h", f"+{'9' * 400}h", "1969-12-31T23:59:59", "0001-01-01T00:00+14:00", "9999-12-31T23:00-14:00"]
)
def test_a_time_that_no_recording_has_is_refused(text):
    with pytest.raises(ConfigError, match=r"years 1970 and 9999$"):
        parse_instant(text, START_NS)


def test_the_last_second_of_the_calendar_is_a_time():
    last_ns = parse_instant("9999-12-31T23:59:59.999999Z", START_NS)
    assert format_utc(last_ns) == "9999-12-31T23:59:59.999999000Z"
    assert parse_instant("1970-01-01", START_NS) == 0


def test_instants_and_durations_as_people_write_them():
    assert format_date_time(START_NS) == "2026-01-01 18:00:00"
    texts = [format_duration(round(length_s * NS_PER_S)) for length_s in (4.25, 59.99, 61, 3600, 90_000)]
    assert texts == ["4.2 s", "60.0 s", "0:01:01", "1:00:00", "1 day, 1:00:00"]
