import numpy as np
import pytest

from tests.recording.full_session import INFO, MS, START_NS, frame, images, make_half_second, record, telemetry
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import TRIMMED
from thermostand.foundation.items import StepMark, StepState
from thermostand.recording.exporting.replay import replay_and_record
from thermostand.recording.exporting.trim import trim
from thermostand.recording.format.layout import FRAMES
from thermostand.recording.reading.session import Session

HALF_NS = NS_PER_S // 2


def within(messages, begin_ns, end_ns):
    return [message for message in messages if begin_ns <= message.time_ns < end_ns]


def trimmed(session, out, begin_ns, end_ns):
    """The new session, its messages without the event at the start, and that event."""
    part = Session.open(trim(session, out, begin_ns, end_ns))
    opening, log, *rest = telemetry(part)
    assert (opening.topic, log.topic) == ("/experiment/event", "/log")
    (event,) = (event for event in part.events() if event.kind == TRIMMED)
    return part, rest, event


async def test_a_part_is_a_session_with_every_message_of_its_range(tmp_path):
    await record(tmp_path / "s", 12)
    session = Session.open(tmp_path / "s")
    assert len(session.segments) >= 6
    begin_ns, end_ns = START_NS + 3 * HALF_NS, START_NS + 9 * HALF_NS
    part, rest, event = trimmed(session, tmp_path / "part", begin_ns, end_ns)
    assert rest == within(telemetry(session), begin_ns, end_ns)
    assert images(part) == images(session)[4:10]
    assert part.frame_times_ns.tolist() == [START_NS + k * HALF_NS - 50 * MS for k in range(4, 10)]
    assert session.metadata == INFO.metadata()
    assert {name: text for name, text in part.metadata.items() if name != "extent"} == session.metadata
    assert dict(part.attachments) == dict(session.attachments)
    assert part.channels() == session.channels()
    assert [got.step_id for got in part.frames()] == [f"capture-{k}" for k in range(4, 10)]
    assert event.time_ns == begin_ns
    assert event.text == (
        "trimmed from session cycle-1: 2026-01-01T18:00:01.623456789Z up to 2026-01-01T18:00:04.623456789Z, "
        "the end not included"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part", "s"]


async def test_the_begin_belongs_to_a_part_and_the_end_does_not(tmp_path):
    await record(tmp_path / "s", 6)
    session = Session.open(tmp_path / "s")
    times_ns = session.frame_times_ns.tolist()
    part, rest, _ = trimmed(session, tmp_path / "part", times_ns[1], times_ns[3])
    assert part.frame_times_ns.tolist() == times_ns[1:3]
    assert rest == within(telemetry(session), times_ns[1], times_ns[3])
    one, _, _ = trimmed(session, tmp_path / "one", times_ns[1], times_ns[1] + 1)
    assert one.frame_times_ns.tolist() == [times_ns[1]]
    assert [got.camera_degC for got in one.frames()] == [frame(times_ns[1], 1).camera_degC]


def soak(time_ns, index):
    """A step from the second half second to the fifth."""
    yield from (item for item in make_half_second(time_ns, index) if not isinstance(item, StepMark))
    if index in (1, 4):
        state = StepState.STARTED if index == 1 else StepState.DONE
        yield StepMark(time_ns, "cycle/soak-30", 7, "soak", state, {"soak_s": 1.5})


async def test_the_step_under_way_is_shown_again_at_the_start(tmp_path):
    await record(tmp_path / "s", 8, items=soak)
    session = Session.open(tmp_path / "s")
    begin_ns = START_NS + 3 * HALF_NS
    part, rest, event = trimmed(session, tmp_path / "part", begin_ns, begin_ns + 10 * NS_PER_S)
    started, done = session.steps()
    assert part.steps() == [
        StepMark(begin_ns, started.step_id, 7, "soak", StepState.STARTED, {"soak_s": 1.5}),
        done,
    ]
    assert rest[1:] == within(telemetry(session), begin_ns, begin_ns + 10 * NS_PER_S)
    assert "cycle/soak-30, started 2026-01-01T18:00:00.623456789Z, is repeated" in event.text
    after, _, event = trimmed(session, tmp_path / "after", done.time_ns + 1, begin_ns + 10 * NS_PER_S)
    assert after.steps() == []
    assert "is repeated" not in event.text


async def test_a_part_of_a_part_and_its_replay_keep_the_origin(tmp_path):
    await record(tmp_path / "s", 8)
    once = Session.open(trim(Session.open(tmp_path / "s"), tmp_path / "once", 0, START_NS + 2 * NS_PER_S))
    assert min(message.time_ns for message in telemetry(once)) == START_NS
    twice = Session.open(trim(once, tmp_path / "twice", START_NS, START_NS + NS_PER_S))
    assert [event.kind for event in twice.events()] == [TRIMMED, TRIMMED, "note", "note"]
    copy = Session.open(await replay_and_record(twice, tmp_path / "copy", None))
    assert copy.events() == twice.events()


async def test_a_long_part_is_cut_into_segments_as_a_recording_is(tmp_path):
    await record(tmp_path / "s", 6, segment_s=60.0, period_ns=300 * NS_PER_S)
    session = Session.open(tmp_path / "s")
    part, rest, _ = trimmed(session, tmp_path / "part", 0, START_NS + 10_000 * NS_PER_S)
    assert rest == telemetry(session)
    names = [f"{path.parent.name}/{path.name}" for path in part.segments]
    assert names == [f"{series}/000{k}.mcap" for series in ("telemetry", "frames") for k in range(3)]


async def test_images_of_several_kinds_keep_theirs(tmp_path):
    await record(tmp_path / "s", 3, encoding="raw")
    await record(tmp_path / "s", 3, encoding="zstd")  # a second run continues the folder, at the same instants
    session = Session.open(tmp_path / "s")
    part, _, _ = trimmed(session, tmp_path / "part", 0, START_NS + NS_PER_S)
    assert sorted(images(part)) == sorted([*images(session)[:3], *images(session)[3:]])
    for index, got in enumerate(sorted(part.frames(), key=lambda got: got.block_id)):
        np.testing.assert_array_equal(got.image, frame(0, index // 2).image)


async def test_an_empty_part_is_refused_with_the_span_of_the_session(tmp_path):
    await record(tmp_path / "s", 4)
    session = Session.open(tmp_path / "s")
    for begin_ns, end_ns in ((0, START_NS - 50 * MS), (START_NS + 1, START_NS + 2), (START_NS + 9, START_NS)):
        with pytest.raises(SessionError, match=r"has nothing from .* it goes from 20\d\d-\d\d-\d\d \d\d:\d\d:\d\d to"):
            trim(session, tmp_path / "part", begin_ns, end_ns)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


async def test_a_part_that_cannot_be_read_whole_leaves_nothing(tmp_path):
    await record(tmp_path / "s", 12)
    session = Session.open(tmp_path / "s")
    damaged = sorted((tmp_path / "s" / FRAMES).iterdir())[1]
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(SessionError, match="damaged"):
        trim(session, tmp_path / "part", 0, START_NS + 60 * NS_PER_S)
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


async def test_nothing_is_overwritten_by_a_part(tmp_path):
    await record(tmp_path / "s", 4)
    before = {path: path.read_bytes() for path in (tmp_path / "s").rglob("*.mcap")}
    with pytest.raises(SessionError, match="exists already"):
        trim(Session.open(tmp_path / "s"), tmp_path / "s", 0, START_NS + NS_PER_S)
    assert {path: path.read_bytes() for path in (tmp_path / "s").rglob("*.mcap")} == before
