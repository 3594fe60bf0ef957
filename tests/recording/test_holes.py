"""What is missing of a session is reported, by everything that reads it; a copy of it lacks the same."""

import asyncio
import re
import shutil
import time

import pytest

from tests.stand.hostile_sessions import everywhere
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepState
from thermostand.recording.exporting.export import export
from thermostand.recording.exporting.replay import replay_and_record
from thermostand.recording.exporting.trim import trim
from thermostand.recording.format.holes import Hole, format_holes, parse_holes
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.messages import TABLE_POSE
from thermostand.recording.format.summary import read_summary
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.run_status import Files, RunOutcome
from thermostand.recording.reading.scan import scan, verify
from thermostand.recording.reading.session import Session, open_whole
from thermostand.recording.repair.salvage import salvage_session

from .damage import METADATA, unlist, write_segment
from .full_session import START_NS, images, record, telemetry
from .runs import SECONDS, ended, entries, publish_half_done, publish_killed, record_run, remove, write_journal


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A complete run in five or six segments of each series; not to be changed."""
    directory = tmp_path_factory.mktemp("sessions") / "cycle-1"
    asyncio.run(record_run(directory))
    return directory


@pytest.fixture
def session(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "cycle-1")


def last_numbers(directory, series, count):
    numbers = sorted(int(path.name[:4]) for path in (directory / series).iterdir())
    return numbers[-count:]


def words(directory):
    """Run and files, on which list, info and verify agree."""
    found = verify(directory)
    assert (scan(directory).run, scan(directory).files) == (found.run, found.files)
    assert (summarise_session(directory).scanned.run, summarise_session(directory).scanned.files) == (
        found.run,
        found.files,
    )
    assert found.is_sound == (found.files is Files.SOUND)
    return found.run, found.files


def errors(directory):
    return [str(finding) for finding in verify(directory).findings if finding.severity == "error"]


def refused(directory):
    """The sentence with which a session is refused that is not whole."""
    warnings = []
    open_whole(directory, warnings.append)
    (text,) = warnings
    sentence = text.removesuffix("; only the rest is used")
    with pytest.raises(SessionError) as raised:
        open_whole(directory)
    assert str(raised.value).startswith(f"{sentence}; ")
    assert "--incomplete" in str(raised.value)
    return sentence


def test_a_whole_run_is_complete_and_sound(whole):
    assert words(whole) == (RunOutcome.COMPLETE, Files.SOUND)
    assert open_whole(whole).holes == ()


def test_a_lost_tail_of_both_series_is_incomplete(session):
    remove(session, TELEMETRY, *last_numbers(session, TELEMETRY, 2))
    remove(session, FRAMES, *last_numbers(session, FRAMES, 2))
    assert words(session) == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    telemetry, frames, steps = errors(session)
    assert telemetry.startswith("error: telemetry/0004.mcap: is missing")
    assert re.search(r"2026-01-01 18:00:20 UTC, .* 2026-01-01 18:00:14 UTC; 12 of the 20 frames", telemetry)
    assert re.match(r"error: frames/0003\.mcap: is missing: .* 2 segments", frames)
    assert steps.startswith(
        "error: 3 frames of capture-12 to capture-14, 2026-01-01 18:00:12 to 2026-01-01 18:00:14 UTC: missing"
    )
    assert re.fullmatch(
        rf"{session}: is incomplete; missing: telemetry/0004\.mcap .* \(from 2026-01-01 18:00:14 UTC\); "
        r"frames/0003\.mcap .* \(from 2026-01-01 18:00:11 UTC, 3 frames .*\); 12 of the 20 frames .*",
        refused(session),
    )


def test_frames_deleted_from_the_end_alone_are_missed_by_their_steps(session):
    remove(session, FRAMES, *last_numbers(session, FRAMES, 1))
    assert words(session) == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    assert re.search(r"frames/0004\.mcap .*\(from 2026-01-01 18:00:15 UTC, 4 frames", refused(session))
    shutil.rmtree(session / FRAMES)
    assert words(session) == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    assert re.search(r"frames/0000\.mcap .*\(20 frames", refused(session))


def test_without_its_journal_a_lost_tail_leaves_no_end_and_is_incomplete(session):
    (session / "journal.jsonl").unlink()
    assert words(session) == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    (text,) = errors(session)
    assert text.startswith("error: journal.jsonl: is missing")
    assert open_whole(session).holes == ()  # everything that was recorded is there
    for series in (TELEMETRY, FRAMES):
        remove(session, series, *last_numbers(session, series, 2))
    assert words(session) == (RunOutcome.INTERRUPTED, Files.INCOMPLETE)
    assert "stops at 2026-01-01 18:00:14 UTC" in errors(session)[1]
    assert "telemetry/0004.mcap" in refused(session)


async def test_steps_that_the_journal_has_and_the_telemetry_has_not_are_missed(tmp_path):
    directory = await record_run(tmp_path / "s", items=publish_killed, status="")
    assert words(directory) == (RunOutcome.INTERRUPTED, Files.SOUND)  # killed between two segments
    remove(directory, TELEMETRY, *last_numbers(directory, TELEMETRY, 2))
    remove(directory, FRAMES, *last_numbers(directory, FRAMES, 2))
    assert any("says that 20 steps are done, 5 more than the telemetry" in text for text in errors(directory))
    assert verify(directory).files is Files.INCOMPLETE


async def test_what_was_recorded_after_a_resumption_and_is_gone_is_missed(tmp_path):
    directory = await record_run(tmp_path / "s", items=ended("error", "aborted", status="stopped"), status="stopped")
    assert words(directory) == (RunOutcome.STOPPED, Files.SOUND)
    after_ns = START_NS + 3600 * NS_PER_S
    write_journal(
        directory,
        *entries(status="stopped"),
        {"entry": "Gap", "from_ns": START_NS, "time_ns": after_ns},
        {"entry": "Ended", "time_ns": after_ns + NS_PER_S, "status": "complete", "text": "complete"},
    )
    assert words(directory) == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    assert any("resumed at 2026-01-01 19:00:00 UTC" in text for text in errors(directory))


@pytest.mark.parametrize(
    ("level", "text", "data", "status", "word"),
    [
        ("info", "complete", {"status": "complete"}, "complete", RunOutcome.COMPLETE),
        ("error", "aborted: stopped", {"status": "stopped"}, "stopped", RunOutcome.STOPPED),
        ("error", "aborted: too hot", {"status": "tripped"}, "tripped", RunOutcome.TRIPPED),
        ("error", "failed: a device", {"status": "failed"}, "failed", RunOutcome.FAILED),
        ("error", "aborted: too hot", {}, "tripped", RunOutcome.TRIPPED),
        ("info", "complete", {}, "complete", RunOutcome.COMPLETE),
    ],
)
async def test_a_run_has_its_own_word_and_its_files_are_sound(tmp_path, level, text, data, status, word):
    directory = await record_run(tmp_path / "s", items=ended(level, text, **data), status=status)
    assert words(directory) == (word, Files.SOUND)


async def test_steps_are_counted_against_the_plan(tmp_path):
    directory = await record_run(tmp_path / "s", items=publish_half_done, status="")
    write_journal(directory, *entries(SECONDS // 2, "stopped"))
    found = summarise_session(directory)
    assert (found.scanned.run, found.planned_steps) == (RunOutcome.STOPPED, SECONDS)
    assert [step.state for step in found.steps].count(StepState.DONE) == SECONDS // 2


def test_a_gap_is_reported_with_its_times_and_its_frames(session):
    remove(session, TELEMETRY, 1, 2)
    remove(session, FRAMES, 1)
    assert verify(session).files is scan(session).files is Files.INCOMPLETE
    assert refused(session).startswith(
        f"{session}: is incomplete; "
        "missing: telemetry/0001.mcap to 0002.mcap (from 2026-01-01 18:00:02 to 2026-01-01 18:00:11 UTC); "
        "frames/0001.mcap (from 2026-01-01 18:00:03 to 2026-01-01 18:00:08 UTC); 16 of the 20 frames"
    )


def test_a_segment_of_a_huge_number_costs_nothing(session):
    shutil.copy(session / TELEMETRY / "0001.mcap", session / TELEMETRY / "99999999999.mcap")
    begun_s = time.perf_counter()
    found = errors(session)
    assert time.perf_counter() - begun_s < 10
    assert any("telemetry/99999999999.mcap: is foreign" in text for text in found)
    assert not any("is missing" in text for text in found)
    assert scan(session).files is Files.DAMAGED


@pytest.mark.parametrize("series", [TELEMETRY, FRAMES])
def test_doubled_and_swapped_segments_are_refused_and_damaged(session, series):
    first, second, doubled = (session / series / f"{number:04d}.mcap" for number in (1, 2, 7))
    shutil.copy(first, doubled)
    with pytest.raises(SessionError, match=rf"{series}/0007.mcap: was recorded as {series}/0001.mcap"):
        Session.open(session)
    assert (verify(session).files, scan(session).files) == (Files.DAMAGED, Files.DAMAGED)
    doubled.unlink()
    first.rename(doubled)
    second.rename(first)
    doubled.rename(second)
    with pytest.raises(SessionError, match=rf"{series}/0001.mcap: was recorded as {series}/0002.mcap"):
        Session.open(session)
    assert (verify(session).files, scan(session).files) == (Files.DAMAGED, Files.DAMAGED)


async def test_frames_of_another_session_are_refused_by_everything_that_uses_them(session, tmp_path):
    other = (await record_run(tmp_path / "cycle-2")) / FRAMES / "0001.mcap"
    (session / FRAMES / "0001.mcap").write_bytes(other.read_bytes().replace(b"DA1234567", b"DA7654321"))
    with pytest.raises(SessionError, match=r"frames/0001\.mcap: "):
        export(Session.open(session), tmp_path / "out", report=lambda done, text: None)
    with pytest.raises(SessionError, match=r"frames/0001\.mcap: "):
        trim(Session.open(session), tmp_path / "part", START_NS, START_NS + NS_PER_S)
    assert (verify(session).files, scan(session).files) == (Files.DAMAGED, Files.DAMAGED)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "part").exists()


def missing_middle(session):
    remove(session, TELEMETRY, 1, 2)
    remove(session, FRAMES, 2)
    return Session.open(session)


def recorded_items(session):
    """Every message but the poses for viewers, which a recorder derives from what the axes said before."""
    return [message for message in telemetry(session) if message.topic != TABLE_POSE]


def holes_of(session):
    return sorted(map(repr, session.holes))


async def test_the_copy_of_an_incomplete_session_lacks_the_same_and_invents_nothing(session, tmp_path):
    original = missing_middle(session)
    copy = Session.open(await replay_and_record(original, tmp_path / "copy", None))
    assert recorded_items(copy) == recorded_items(original)
    assert images(copy) == images(original)
    assert holes_of(copy) == holes_of(original)
    assert words(tmp_path / "copy") == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    assert refused(tmp_path / "copy").partition(": is")[2] == refused(session).partition(": is")[2]
    twice = Session.open(await replay_and_record(copy, tmp_path / "twice", None))
    assert holes_of(twice) == holes_of(original)


def test_a_part_lacks_what_the_session_lacked_in_its_range_and_no_more(session, tmp_path):
    original = missing_middle(session)
    trim(original, tmp_path / "all", START_NS - NS_PER_S, START_NS + 100 * NS_PER_S)
    assert words(tmp_path / "all") == (RunOutcome.COMPLETE, Files.INCOMPLETE)
    assert len(open_whole(tmp_path / "all", lambda text: None).holes) == len(original.holes)
    trim(original, tmp_path / "sound", START_NS + 14 * NS_PER_S, START_NS + 17 * NS_PER_S)
    assert words(tmp_path / "sound") == (RunOutcome.COMPLETE, Files.SOUND)
    (note,) = map(str, verify(tmp_path / "sound").findings[:1])
    assert "cycle-1: 2026-01-01 18:00:14 to 2026-01-01 18:00:17 UTC" in note


async def test_a_part_is_sound_however_its_run_ended_and_so_is_a_part_of_it(tmp_path):
    directory = await record_run(tmp_path / "s", items=publish_half_done, status="")
    write_journal(directory, *entries(SECONDS // 2, "stopped"))
    trim(Session.open(directory), tmp_path / "part", START_NS, START_NS + 5 * NS_PER_S)
    assert words(tmp_path / "part") == (RunOutcome.STOPPED, Files.SOUND)
    trim(Session.open(tmp_path / "part"), tmp_path / "less", START_NS + NS_PER_S, START_NS + 9 * NS_PER_S)
    assert words(tmp_path / "less") == (RunOutcome.STOPPED, Files.SOUND)
    assert "18:00:01 to 2026-01-01 18:00:05 UTC" in str(verify(tmp_path / "less").findings[0])


async def test_what_a_kill_cost_is_no_hole_and_its_copies_are_sound(tmp_path):
    directory = await record_run(tmp_path / "s", items=publish_killed, status="")
    last = max((directory / TELEMETRY).iterdir())
    with last.open("rb") as file:
        *_, chunk = read_summary(file, last.stat().st_size).iterate_chunks()
    last.with_name(f"{last.name}.part").write_bytes(last.read_bytes()[: chunk.offset + 30])
    last.unlink()
    unlist(last)
    assert words(directory) == (RunOutcome.INTERRUPTED, Files.INCOMPLETE)
    salvage_session(directory)
    write_journal(directory, *entries(16, ""))
    assert words(directory) == (RunOutcome.INTERRUPTED, Files.SOUND)
    assert open_whole(directory).holes == ()
    copy = await replay_and_record(Session.open(directory), tmp_path / "copy", None)
    assert words(copy) == (RunOutcome.INTERRUPTED, Files.SOUND)
    assert telemetry(Session.open(copy)) == telemetry(Session.open(directory))
    part = trim(Session.open(directory), tmp_path / "part", START_NS, START_NS + 100 * NS_PER_S)
    assert words(part) == (RunOutcome.INTERRUPTED, Files.SOUND)


async def test_frames_that_the_recorder_reported_as_lost_are_no_hole(tmp_path):
    directory = tmp_path / "s"
    await record(directory, 4)
    assert open_whole(directory).holes == ()


def test_a_session_of_a_later_format_is_refused_with_a_sentence(tmp_path):
    write_segment(tmp_path / TELEMETRY, TELEMETRY, range(2), finish=True, metadata={**METADATA, "format": "4"})
    with pytest.raises(SessionError, match=r"is of format '4'; .* up to 3"):
        Session.open(tmp_path)


@pytest.mark.parametrize("format_text", ["", "1", "2"])
def test_a_session_of_an_earlier_format_is_refused_with_a_sentence(session, format_text):
    everywhere(session, format=format_text)
    with pytest.raises(SessionError, match="earlier, unreleased version"):
        Session.open(session)
    assert verify(session).files is scan(session).files is Files.UNKNOWN


def test_of_a_later_format_it_is_unknown_whether_it_is_complete(session):
    everywhere(session, format="4")
    found, seen = verify(session), scan(session)
    assert found.files is seen.files is Files.UNKNOWN
    assert not found.is_sound
    assert "is of format '4'; " in seen.state_text
    assert "was not checked" in str(found.findings[0])


def test_a_field_that_this_version_does_not_know_is_named(session):
    everywhere(session, weather="fog")
    found = verify(session)
    assert found.files is scan(session).files is Files.SOUND
    assert any("does not know: weather" in finding.text for finding in found.findings)


def test_holes_in_a_record_are_read_again_and_nonsense_is_none():
    holes = (Hole(TELEMETRY, 3, 12, 5, 9, 6), Hole(FRAMES, None, None, None, 9, 1, True))
    assert parse_holes(format_holes(holes)) == holes
    for text in (
        "",
        "null",
        "7",
        "[7, {}]",
        '[{"series": "moon"}]',
        "[" * 5000,
        '[{"series":"frames","excused":true}]',
    ):
        assert [hole for hole in parse_holes(text) if hole.first] == []
