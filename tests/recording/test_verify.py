import fcntl
import random
import shutil

import numpy as np
import pytest
from mcap.reader import SeekingReader

from tests.nightly import mark_nightly
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format.inventory import list_segments
from thermostand.recording.format.mcap_contents import LIBRARY
from thermostand.recording.format.records import list_frame_places
from thermostand.recording.reading.gaps import find_silences
from thermostand.recording.reading.scan import Severity, verify
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session

from .damage import unlist
from .full_session import item_key, record

SECONDS = 12


def frame(time_ns, index, dropped=0):
    image = np.random.default_rng(index).integers(0, 255, (12, 16), np.uint8)
    return Frame("camera.image", image, time_ns, 0.1, 0.0, 40.0, 100 + index, 7 * index, dropped, "capture")


def second(time_ns, index):
    yield Batch("thermometers", time_ns, (Reading("thermometers.air", 20.0 + index, "degC", time_ns),))
    yield Batch("regulator", time_ns, (Reading("regulator.pv", 20.0 + index, "degC", time_ns),))
    state = {0: StepState.STARTED, SECONDS - 1: StepState.DONE}.get(index)
    if state is not None:
        yield StepMark(time_ns, "capture", 4, "capture", state, {"frames": SECONDS})
    yield frame(time_ns, index)
    yield Event(time_ns, "info", "note", f"second {index}")


async def recorded(directory, items=second, seconds=SECONDS, segment_s=4.0):
    await record(directory, seconds, items=items, segment_s=segment_s, period_ns=NS_PER_S)
    return directory


@pytest.fixture
async def session(tmp_path):
    """Twelve seconds in three or four segments per series."""
    return await recorded(tmp_path / "s")


def errors(directory):
    return [str(f) for f in verify(directory).findings if f.severity is Severity.ERROR]


def notes(directory):
    return [str(f) for f in verify(directory).findings if f.severity is Severity.NOTE]


async def test_a_whole_session_is_sound_and_counted(session):
    done = []
    found = verify(session, lambda done_bytes, text: done.append((done_bytes, text)))
    files = list(session.rglob("*.mcap"))
    assert found.findings == ()
    assert found.is_sound
    assert (found.segments, found.frames) == (len(files), SECONDS)
    assert found.bytes == sum(path.stat().st_size for path in files)
    # two batches, event and log each second, two marks, and the descriptions and images
    assert found.messages == SECONDS * 6 + 2
    assert [bytes_ for bytes_, _ in done] == sorted(bytes_ for bytes_, _ in done)
    assert {text for _, text in done} == {str(path.relative_to(session)) for path in files}
    assert done[-1][0] == pytest.approx(found.bytes, rel=0.2)


def everything(directory):
    """What a reader gets of the session; None when it says that it cannot be read."""
    try:
        session = Session.open(directory)
        return session.metadata, dict(session.attachments), [item_key(item) for item in session.items()]
    except SessionError:
        return None


@pytest.mark.parametrize("trials", [80, mark_nightly(400)])
async def test_one_flipped_bit_anywhere_is_found_or_changes_nothing(session, trials):
    whole = everything(session)
    randomly = random.Random(5)
    files = [path for path in sorted(session.rglob("*")) if path.is_file()]
    harmless = 0
    for _ in range(trials):
        path = randomly.choice(files)
        data = path.read_bytes()
        place = randomly.randrange(len(data))
        path.write_bytes(data[:place] + bytes([data[place] ^ 1 << randomly.randrange(8)]) + data[place + 1 :])
        try:
            if not errors(session):
                harmless += 1
                assert everything(session) == whole, f"byte {place} of {path} was not found"
        finally:
            path.write_bytes(data)
    assert harmless < trials / 20  # the text of the header, and bits that zstd ignores
    assert errors(session) == []


@pytest.mark.parametrize("every", [13, mark_nightly(1)])
async def test_every_byte_is_guarded_but_the_name_of_the_writers_library(tmp_path, every):
    directory = tmp_path / "s"
    await record(directory, 1, items=second, encoding="raw", period_ns=NS_PER_S)
    path = directory / "frames" / "0000.mcap"  # not compressed: zstd has bits that mean nothing
    data = path.read_bytes()
    unguarded = []
    for place in range(0, len(data), every):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        if not errors(directory):
            unguarded.append(place)
    begin = data.index(LIBRARY.encode())
    assert set(unguarded) <= set(range(begin, begin + len(LIBRARY)))


def tear(path, chunk):
    """The segment as a kill leaves it: unfinished, and cut within its chunk of that number (from the end, from 1)."""
    data = path.read_bytes()
    with path.open("rb") as file:
        summary = SeekingReader(file).get_summary()
    path.with_name(f"{path.name}.part").write_bytes(data[: summary.chunk_indexes[-chunk].chunk_start_offset + 30])
    path.unlink()
    unlist(path)


def without_ends(time_ns, index):
    """No step is done, as when the recorder was killed."""
    yield from (item for item in second(time_ns, index) if getattr(item, "state", None) is not StepState.DONE)


@pytest.mark.parametrize("series", ["telemetry", "frames"])
async def test_the_end_that_a_kill_cost_is_no_error_once_the_session_is_salvaged(tmp_path, series):
    session = await recorded(tmp_path / "s", without_ends)
    tear(max((session / series).iterdir()), chunk=1)
    assert any("is not finished" in error for error in errors(session))
    salvage_session(session)
    assert errors(session) == []


async def test_a_salvaged_segment_within_the_session_is_a_note(tmp_path):
    directory = await recorded(tmp_path / "s")
    tear(directory / "telemetry" / "0001.mcap", chunk=1)
    salvage_session(directory)
    assert errors(directory) == []
    assert any(note.startswith("note: telemetry/0001.mcap: was repaired (source: 000") for note in notes(directory))


@pytest.mark.parametrize("series", ["telemetry", "frames"])
async def test_a_missing_segment_is_named(session, series):
    (session / series / "0001.mcap").unlink()
    assert f"error: {series}/0001.mcap: is missing" in errors(session)


async def test_frames_that_went_with_a_segment_are_counted(session):
    (session / "frames" / "0001.mcap").unlink()
    assert errors(session)[1].startswith(
        "error: 4 frames of capture, 2026-01-01 18:00:00 to 2026-01-01 18:00:11 UTC: missing"
    )


async def test_frames_in_a_damaged_chunk_are_not_called_missing_as_well(session):
    path = session / "frames" / "0001.mcap"
    data = bytearray(path.read_bytes())
    data[list_frame_places(path)[1].chunk.offset + 150] ^= 1
    path.write_bytes(data)
    (text,) = errors(session)
    assert text.startswith("error: frames/0001.mcap: is damaged: ")
    assert " (at byte " in text


async def test_a_cut_segment_is_damaged(session):
    path = session / "telemetry" / "0001.mcap"
    path.write_bytes(path.read_bytes()[:-30])
    (text,) = errors(session)
    assert text.startswith("error: telemetry/0001.mcap: is damaged: ")


async def test_what_a_recorder_or_a_salvage_left_is_reported(session):
    shutil.copy(session / "frames" / "0000.mcap", session / "frames" / "0007.mcap.part")
    shutil.copy(session / "frames" / "0000.mcap", session / "frames" / "0000.mcap.damaged")
    found = errors(session)
    assert any(text.startswith("error: frames/0007.mcap.part: is not finished") for text in found)
    assert any(text.startswith("error: frames/0000.mcap.damaged: is an original") for text in found)


def with_a_damaged_index(path):
    """A bit of what the index tells of the whole is wrong."""
    data = bytearray(path.read_bytes())
    data[-40] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["telemetry/0001.mcap", "frames/0000.mcap"])
async def test_an_original_from_which_everything_was_recovered_is_a_note(session, name):
    with_a_damaged_index(session / name)
    assert errors(session)
    salvage_session(session)
    assert errors(session) == []
    assert notes(session)[0].startswith(f"note: {name}.damaged: a repair recovered")


async def test_an_original_from_which_something_is_lost_stays_an_error(session):
    path = session / "frames" / "0001.mcap"
    data = bytearray(path.read_bytes())
    data[list_frame_places(path)[1].chunk.offset + 150] ^= 1
    path.write_bytes(data)
    salvage_session(session)
    with_a_damaged_index(path)
    salvage_session(session)  # it recovers all that the first one did
    kept, frame_lost = errors(session)
    assert kept.startswith("error: frames/0001.mcap.damaged: is an original")
    assert frame_lost.startswith("error: 1 frame of capture")
    assert notes(session)[0].startswith("note: frames/0001.2.mcap.damaged: a repair recovered")


async def test_an_original_that_was_cut_short_stays_an_error(session):
    path = session / "telemetry" / "0001.mcap"
    with path.open("rb") as file:
        chunk = SeekingReader(file).get_summary().chunk_indexes[-1]
    path.write_bytes(path.read_bytes()[: chunk.chunk_start_offset])  # what is left of it is sound
    salvage_session(session)
    assert any(error.startswith("error: telemetry/0001.mcap.damaged: is an original") for error in errors(session))


async def test_a_segment_that_is_being_recorded_is_no_error(session):
    part = session / "frames" / f"{len(list((session / 'frames').iterdir())):04d}.mcap.part"
    part.write_bytes(b"")
    with part.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert errors(session) == []
        (note,) = notes(session)
        assert note.startswith(f"note: frames/{part.name}: is being recorded")
        assert [str(entry.state) for entry in list_segments(session)].count("recording") == 1


def as_left(path):
    """The segment as a killed recorder leaves it, with everything in it."""
    return path.rename(path.with_name(f"{path.name}.part"))


def not_finished(parts):
    return [f"error: {path.parent.name}/{path.name}: is not finished" for path in sorted(parts)]


async def test_a_session_whose_frames_are_all_unfinished_is_not_finished_and_nothing_else(session):
    parts = [as_left(path) for path in (session / "frames").iterdir()]
    assert [text.partition("; ")[0] for text in errors(session)] == not_finished(parts)
    assert notes(session) == []


@pytest.mark.parametrize("series", ["telemetry", "frames"])
@pytest.mark.parametrize("number", [0, 1, 2])
async def test_what_is_in_a_segment_that_was_not_read_is_not_called_missing(session, series, number):
    part = as_left(session / series / f"{number:04d}.mcap")
    assert [text.partition("; ")[0] for text in errors(session)] == not_finished([part])
    assert notes(session) == []


async def test_a_session_that_is_being_recorded_has_no_error_at_any_time(tmp_path):
    found = []

    def items(time_ns, index):
        found.extend(map(str, verify(tmp_path / "s").findings))
        yield from second(time_ns, index)

    await recorded(tmp_path / "s", items)
    assert len(found) >= SECONDS
    assert all(".mcap.part: is being recorded" in text for text in found)
    assert verify(tmp_path / "s").findings == ()


async def test_a_session_without_telemetry_is_reported(session):
    shutil.rmtree(session / "telemetry")
    assert errors(session) == ["error: telemetry: is missing"]


async def test_a_segment_of_another_place_is_reported(session):
    shutil.copy(session / "frames" / "0001.mcap", session / "frames" / "0002.mcap")
    assert any(text.startswith("error: frames/0002.mcap: records another place") for text in errors(session))


async def test_losses_the_recording_tells_of_are_notes(tmp_path):
    def items(time_ns, index):
        yield from (item for item in second(time_ns, index) if not isinstance(item, Frame))
        yield frame(time_ns, index, dropped=2 if index == 3 else 0)

    directory = await recorded(tmp_path / "s", items)
    assert errors(directory) == []
    assert [text.partition(" lost ")[0] for text in notes(directory)] == ["note: 2 frames of step 5 (capture)"]


async def test_frames_the_recorder_says_it_lost_are_notes(tmp_path):
    def items(time_ns, index):
        yield from second(time_ns, index)
        if index == SECONDS - 1:
            text = "frames lost: 4 (blocks 104 to 107 of step capture), 4 in all; disk full"
            yield Event(time_ns, "error", "frames_dropped", text, {"blocks": [[104, 107]]})

    directory = await recorded(tmp_path / "s", items)
    (directory / "frames" / "0001.mcap").unlink()
    assert errors(directory) == ["error: frames/0001.mcap: is missing"]
    assert ": lost by the recorder" in notes(directory)[0]
    assert notes(directory)[1].startswith("note: 2026-01-01 18:00:11 UTC: frames lost: 4 (blocks 104 to")


async def test_silence_of_everything_and_of_one_device_are_notes(tmp_path):
    def items(time_ns, index):
        if index < 4 or 15 <= index < 20 or index >= 30:
            yield from second(time_ns, index)
        elif index >= 20:
            yield from (item for item in second(time_ns, index) if not isinstance(item, Batch) or "reg" in item.device)

    directory = await recorded(tmp_path / "s", items, seconds=40, segment_s=60.0)
    assert errors(directory) == []
    everything, thermometers = (text.split(" from ") for text in notes(directory))
    assert everything == ["note: everything was silent", "2026-01-01 18:00:03 to 2026-01-01 18:00:15 UTC (12.0 s)"]
    assert thermometers == ["note: thermometers was silent", "2026-01-01 18:00:19 to 2026-01-01 18:00:30 UTC (11.0 s)"]


def every(period_s, *stretches):
    """Instants each `period_s` within the stretches [begin, end), s."""
    return np.concatenate([np.arange(b, e, period_s) for b, e in stretches]).astype(np.int64) * NS_PER_S


def test_devices_with_different_periods_fall_silent_together():
    found = find_silences(
        {
            "thermometers.air": every(5, (0, 600), (900, 1500)),
            "thermometers.artifact": every(5, (0, 600), (900, 1500)),
            "linear.position": every(30, (0, 600), (910, 1500)),
        }
    )
    assert [(gap.names, gap.begin_ns, gap.end_ns) for gap in found] == [
        (("everything",), 595 * NS_PER_S, 900 * NS_PER_S)
    ]


def test_a_channel_of_a_device_that_stops_early_or_begins_late_is_named_alone():
    found = find_silences(
        {
            "thermometers.air": every(1, (0, 100)),
            "thermometers.artifact": every(1, (0, 40)),
            "camera.temperature": every(1, (20, 100)),
        }
    )
    assert [(gap.names, gap.begin_ns, gap.end_ns) for gap in found] == [
        (("camera",), 0, 20 * NS_PER_S),
        (("thermometers.artifact",), 39 * NS_PER_S, 99 * NS_PER_S),
    ]


def test_slow_but_even_channels_and_single_readings_are_no_gaps():
    assert find_silences({"linear.position": every(30, (0, 600)), "flap.position": np.array([5], np.int64)}) == []
    assert find_silences({}) == []


def test_a_folder_without_segments_is_no_session(tmp_path):
    with pytest.raises(SessionError, match="not a session"):
        verify(tmp_path)


async def test_a_segment_of_another_session_is_reported(session, tmp_path):
    other = await recorded(tmp_path / "other")
    data = (other / "frames" / "0001.mcap").read_bytes().replace(b"cycle-1", b"cycle-2")
    (session / "frames" / "0001.mcap").write_bytes(data)
    assert any(text.startswith("error: frames/0001.mcap: belongs to") for text in errors(session))
