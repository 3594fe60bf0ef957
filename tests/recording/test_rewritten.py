"""Segments that other programs have written again, in any form that MCAP allows, are valid files: they are read, and
what `session.json` states of them says whether they still hold what was recorded."""

import asyncio
import shutil
from pathlib import Path

import pytest
from mcap.writer import Writer

from tests.recording.full_session import images, item_key, telemetry
from tests.recording.rewriting import FORMS, TOOL, Form, rewrite, rewrite_all
from tests.recording.runs import record_run
from thermostand.foundation.errors import SessionError
from thermostand.recording.exporting.export import export
from thermostand.recording.exporting.mcap_export import export_mcap
from thermostand.recording.exporting.mcap_import import import_mcap
from thermostand.recording.exporting.replay import replay_and_record
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import read_manifest
from thermostand.recording.format.mcap_contents import format_digest, read_contents
from thermostand.recording.format.records import list_frame_places, read_frame_crcs
from thermostand.recording.reading.notes import add_note, read_notes
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.run_status import Files
from thermostand.recording.reading.scan import Depth, Severity, scan, summarise_findings, verify
from thermostand.recording.reading.session import Session, open_whole
from thermostand.recording.repair.salvage import format_salvaged, salvage_session


def ignore(share, text):
    assert 0.0 <= share <= 1.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A complete run; not to be changed."""
    return asyncio.run(record_run(tmp_path_factory.mktemp("recorded") / "cycle-1"))


@pytest.fixture
def session(recorded, tmp_path):
    return Path(shutil.copytree(recorded, tmp_path / "cycle-1"))


def names(directory):
    return sorted(str(path.relative_to(directory)) for path in directory.rglob("*"))


def contents(directory):
    """All that a session says, but for where it is in its files."""
    found = open_whole(directory)
    return (
        found.metadata,
        dict(found.attachments),
        sorted(map(str, map(item_key, found.items()))),
        {name: found.readings(name)[1].tobytes() for name in found.channels()},
        [item_key(each) for each in found.frames()],
        [frame for frame, _ in images(found)],
    )


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_session_in_another_form_is_read_as_it_was_and_never_touched(recorded, session, form):
    rewrite_all(session, form)
    before = {path: path.read_bytes() for path in session.rglob("*") if path.is_file()}
    assert contents(session) == contents(recorded)
    seen = verify(session)
    assert (seen.files, seen.frames, seen.messages) == (Files.SOUND, 20, verify(recorded).messages)
    assert scan(session).files is scan(session, Depth.TELEMETRY).files is Files.SOUND
    rewritten = {each.where: each.text for each in seen.findings if TOOL in each.text}
    assert rewritten.keys() == {file.name for file in seen.inventory}
    assert all("complete" in text for text in rewritten.values())
    assert summarise_session(session).scanned.run == summarise_session(recorded).scanned.run
    done = salvage_session(session)
    assert all(each.kept is None and not each.lost_bytes for each in done)
    assert [format_salvaged(each).partition(": ")[2] for each in done] == [rewritten[name] for name in rewritten]
    assert {path: path.read_bytes() for path in session.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("name", ["unchunked", "one large chunk", "lz4"])
def test_an_export_of_rewritten_segments_has_the_same_files(recorded, session, tmp_path, name):
    rewrite_all(session, FORMS[name])
    export(Session.open(recorded), tmp_path / "before", report=ignore)
    export(Session.open(session), tmp_path / "after", report=ignore)
    found = {name: (tmp_path / "after" / name).read_bytes() for name in names(tmp_path / "after") if "." in name}
    assert found.keys() == {name for name in names(tmp_path / "before") if "." in name}
    others = {name for name, data in found.items() if (tmp_path / "before" / name).read_bytes() != data}
    assert others == {"README.txt", "session.json", "ro-crate-metadata.json"}  # the first two say that it was rewritten
    assert TOOL in found["README.txt"].decode()
    assert TOOL in found["session.json"].decode()


def test_a_frame_of_a_rewritten_segment_is_found_again_by_its_bytes(recorded, session):
    path = session / FRAMES / "0001.mcap"
    rewrite(path)
    crcs = read_frame_crcs(path, list_frame_places(path))
    assert len(set(crcs)) == len(crcs) == 4
    assert crcs == read_frame_crcs(path, list_frame_places(path))


def test_messages_that_are_missing_are_counted(session):
    rewrite(session / TELEMETRY / "0001.mcap", Form(keep=lambda topic, message: topic != "/log"))
    (found,) = [each for each in verify(session).findings if each.where == f"{TELEMETRY}/0001.mcap"]
    assert (found.severity, found.files) == (Severity.ERROR, Files.INCOMPLETE)
    assert "4 of 4 on /log" in found.text
    with pytest.raises(SessionError, match="lacks messages"):
        open_whole(session)
    warned = []
    assert open_whole(session, warned.append).frame_count == 20
    assert found.text in warned[0]


def change_a_byte(topic, data):
    return data.replace(b"half second 5", b"half second 6")


@pytest.mark.parametrize("depth", Depth)
def test_content_that_was_changed_is_reported(session, depth):
    rewrite(session / TELEMETRY / "0001.mcap", Form(change=change_a_byte))
    found = scan(session, depth)
    assert found.files is Files.CHANGED
    (one,) = [each for each in found.findings if each.files is Files.CHANGED]
    assert one.where == f"{TELEMETRY}/0001.mcap"
    with pytest.raises(SessionError, match="content was changed"):
        open_whole(session)
    done = salvage_session(session)
    assert [one.text in format_salvaged(each) for each in done] == [True]


def test_damage_in_a_rewritten_segment_is_damage(session):
    path = session / TELEMETRY / "0001.mcap"
    rewrite(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert verify(session).files is Files.DAMAGED
    path.write_bytes(data[: len(data) // 2])
    assert verify(session).files is scan(session).files is Files.DAMAGED


def write_strange(path):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="rosbag2")
        channel = writer.register_channel("/x", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()


def test_a_sound_file_of_somebody_else_is_named_and_left_alone(recorded, session):
    strange = [session / TELEMETRY / "0006.mcap", session / FRAMES / "0017.mcap", session / FRAMES / "bag.mcap"]
    strange.append(session / "bag.mcap")
    for path in strange:
        write_strange(path)
    before = names(session)
    seen = verify(session)
    assert seen.files is Files.SOUND
    named = {each.where: each.text for each in seen.findings if each.severity is Severity.NOTE}
    assert named.keys() >= {str(path.relative_to(session)) for path in strange}
    assert "rosbag2" in named[f"{TELEMETRY}/0006.mcap"]
    assert contents(session) == contents(recorded)
    assert salvage_session(session) == []
    assert names(session) == before


def test_a_file_of_somebody_else_in_place_of_a_segment_is_no_segment(session):
    write_strange(session / TELEMETRY / "0002.mcap")
    assert verify(session).files is Files.INCOMPLETE
    with pytest.raises(SessionError, match=r"telemetry/0002\.mcap"):
        open_whole(session)


def test_like_lines_are_one_line_with_a_count(session):
    rewrite_all(session)
    found = [each for each in verify(session).findings if TOOL in each.text]
    lines = summarise_findings(found * 300)
    assert len(lines) == 2  # of the telemetry, and of the frames
    assert ["1799 more" in lines[0], "1499 more" in lines[1]] == [True, True]
    assert len(summarise_findings(found[:10])) == 10


def test_the_digest_is_of_the_messages_whatever_their_order_and_adds_up(recorded):
    listed = read_manifest(recorded).segments
    whole = read_contents(recorded / TELEMETRY / "0001.mcap")
    assert whole.digest == listed[f"{TELEMETRY}/0001.mcap"].content
    assert dict(whole.counts) == dict(listed[f"{TELEMETRY}/0001.mcap"].messages)
    total = sum(int(each.content, 16) for each in listed.values())
    assert format_digest(total) != format_digest(total + 1)


@pytest.mark.parametrize("form", [None, FORMS["lz4"], FORMS["unchunked"]])
def test_a_session_that_was_exported_as_one_file_is_opened_again(recorded, session, tmp_path, form):
    add_note(session, "windy", "eva", 1)
    export_mcap(Session.open(session), tmp_path / "one.mcap", report=ignore)
    if form is not None:
        rewrite(tmp_path / "one.mcap", form)
    again = import_mcap(tmp_path / "one.mcap", tmp_path / "again", ignore)
    assert contents(again) == contents(recorded)
    seen = verify(again)
    assert (seen.files, seen.run) == (Files.SOUND, verify(recorded).run)
    assert not read_manifest(again).remade
    assert read_notes(again).notes == read_notes(session).notes
    assert (again / "journal.jsonl").read_bytes() == (recorded / "journal.jsonl").read_bytes()


def test_a_file_without_the_frames_makes_a_session_that_lacks_them(session, tmp_path):
    export_mcap(Session.open(session), tmp_path / "one.mcap", frames=False, report=ignore)
    again = import_mcap(tmp_path / "one.mcap", tmp_path / "again", ignore)
    assert verify(again).files is Files.INCOMPLETE
    assert read_manifest(again).remade


def test_a_file_that_is_no_recording_makes_no_session(session, tmp_path):
    write_strange(tmp_path / "bag.mcap")
    data = (session / TELEMETRY / "0001.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-20])
    (tmp_path / "text.mcap").write_text("a cloudy day")
    for name in ("bag", "cut", "text"):
        with pytest.raises(SessionError, match=name):
            import_mcap(tmp_path / f"{name}.mcap", tmp_path / "again", ignore)
        assert not (tmp_path / "again").exists()


async def test_a_replayed_copy_keeps_journal_and_notes(recorded, tmp_path):
    session = Path(shutil.copytree(recorded, tmp_path / "cycle-1"))
    add_note(session, "windy", "eva", 1)
    copy = await replay_and_record(Session.open(session), tmp_path / "copy", None)
    assert read_notes(copy) == read_notes(session)
    assert (copy / "journal.jsonl").read_bytes() == (session / "journal.jsonl").read_bytes()
    assert telemetry(Session.open(copy)) == telemetry(Session.open(session))


def test_an_export_of_a_repaired_session_says_so(session, tmp_path):
    path = session / FRAMES / "0001.mcap"
    path.write_bytes(path.read_bytes()[:-30])
    salvage_session(session)
    assert verify(session).files is Files.SOUND
    export(Session.open(session), tmp_path / "out", report=ignore)
    export_mcap(Session.open(session), tmp_path / "out.mcap", report=ignore)
    exported = read_contents(tmp_path / "out.mcap").metadata["export"]
    for text in ((tmp_path / "out" / "README.txt").read_text(), exported["findings"]):
        assert "frames/0001.mcap: was repaired" in text
    assert exported["files"] == "sound"
