"""Damage that a list, a verification or a fit might take for a sound session."""

import asyncio
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.recording.full_session import INFO, PUBLISHED
from tests.recording.runs import SECONDS, entries, record_run, remove, second, write_journal
from tests.stand.hostile_sessions import event, everywhere, rewrite
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepMark
from thermostand.foundation.readings import Channel, Frame
from thermostand.recording.format.batches import RecordedDevice
from thermostand.recording.format.journal_lines import JOURNAL_NAME, hash_text
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import MANIFEST_NAME, Sealed, SessionInfo, digest_journal, read_manifest
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.run_status import Files
from thermostand.recording.reading.scan import Depth, scan, verify
from thermostand.recording.reading.session import Session, open_whole
from thermostand.recording.repair.salvage import salvage_session


@pytest.fixture
async def session(tmp_path):
    return await record_run(tmp_path / "cycle-1")


def words(directory):
    """What list and verify say of its files."""
    found = verify(directory).files
    assert scan(directory).files is found
    return found


def air(directory):
    return Session.open(directory).readings("thermometers.air")[0].shape


COPIES = ["00003.mcap", "0003 (1).mcap", "._0003.mcap", "0003.2.mcap", "3.mcap", "0003 (1).mcap.part", "0003.mcap.mcap"]


@pytest.mark.parametrize("series", [TELEMETRY, FRAMES])
@pytest.mark.parametrize("name", COPIES)
def test_a_copy_under_another_name_counts_for_nothing_and_is_named(session, series, name):
    readings, frames = air(session), Session.open(session).frame_count
    shutil.copy(session / series / "0003.mcap", session / series / name)
    assert words(session) is Files.SOUND
    assert any(str(each).startswith(f"note: {series}/{name}: is no segment") for each in verify(session).findings)
    assert (air(session), open_whole(session).frame_count) == (readings, frames)
    assert salvage_session(session) == []
    assert (session / series / name).exists()


@pytest.mark.parametrize("name", COPIES[:3])
def test_a_segment_that_has_only_another_name_is_missing(session, name):
    (session / TELEMETRY / "0003.mcap").rename(session / TELEMETRY / name)
    assert words(session) is Files.INCOMPLETE


def test_a_text_that_was_edited_in_one_segment_is_damage(session):
    rewrite(session / FRAMES / "0001.mcap", attachments={"config.yaml": b"camera: {gain_dB: 9.0}\n"})
    assert words(session) is Files.DAMAGED
    with pytest.raises(SessionError, match=r"frames/0001\.mcap: has other texts"):
        list(Session.open(session).frames())


@pytest.mark.parametrize("text", [b"camera: {gain_dB: 9.0}\n", None])
def test_a_text_that_was_edited_or_removed_everywhere_is_not_what_the_run_began_with(session, text):
    texts = {name: hash_text(known) for name, known in Session.open(session).attachments.items()}
    begun, *rest = entries()
    write_journal(session, {**begun, "texts": texts}, *rest)
    assert words(session) is Files.SOUND
    if text is None:
        begun = {**begun, "texts": {**texts, "recipe.yaml": hash_text("a recipe that was attached")}}
        write_journal(session, begun, *rest)
    else:
        everywhere(session, attachments={"config.yaml": text})
    assert words(session) is Files.DAMAGED
    with pytest.raises(SessionError, match="is not attached"):
        open_whole(session)


def without_step(time_ns, index):
    """A capture of the plan that was never begun, and nobody left it out."""
    for item in second(time_ns, index):
        if not (index == 7 and isinstance(item, StepMark | Frame)):
            yield item


async def test_complete_without_a_planned_capture_is_incomplete(tmp_path):
    directory = await record_run(tmp_path / "s", items=without_step)
    write_journal(directory, *(entry for entry in entries() if entry.get("step_id") != "capture-7"))
    assert words(directory) is Files.INCOMPLETE
    assert any("of the plan: missing" in str(finding) for finding in verify(directory).findings)
    with pytest.raises(SessionError, match=f"{SECONDS - 1} of the {SECONDS} frames"):
        open_whole(directory)


def test_segments_of_another_session_of_the_same_second_and_recipe_are_not_its_own(session):
    everywhere(session, uid="00ff")
    assert words(session) is Files.SOUND
    rewrite(session / FRAMES / "0001.mcap", uid="11ee")
    assert words(session) is Files.DAMAGED


def test_what_a_session_is_alone_goes_with_its_copies():
    info = replace(INFO, uid="00ff")
    assert SessionInfo.of(info.metadata()) == info
    assert "uid" not in INFO.metadata()


@pytest.fixture(scope="module")
def ended_sessions(tmp_path_factory):
    """Two complete runs of one second and recipe, whose manifests have their journals; not to be changed."""
    folder = tmp_path_factory.mktemp("cycles")
    for name, uid in (("cycle-1", "00ff"), ("cycle-2", "11ee")):
        directory = asyncio.run(record_run(folder / name))
        everywhere(directory, uid=uid)
        end(directory)
    return folder


def end(directory, **changes):
    """The manifest as it is written last, with the journal as it is now."""
    stated = replace(read_manifest(directory), **changes)
    data = (directory / JOURNAL_NAME).read_bytes()
    ended = replace(stated, plan={"steps": SECONDS, "frames": SECONDS}, ended=True, journal=digest_journal(data))
    (directory / MANIFEST_NAME).write_bytes(ended.encode())


@pytest.fixture
def recorded(ended_sessions, tmp_path):
    """The first of them; `session.parent / "session-2"` is the other."""
    return Path(shutil.copytree(ended_sessions, tmp_path / "cycles")) / "cycle-1"


def journal_lines_of(directory):
    return (directory / JOURNAL_NAME).read_bytes().splitlines(keepends=True)


def rewrite_journal(directory, lines):
    (directory / JOURNAL_NAME).write_bytes(b"".join(lines))


def swap_with(directory, name):
    """The segments of that name of both sessions, exchanged."""
    one, other = directory / name, directory.parent / "cycle-2" / name
    mine = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(mine)


def edit_manifest(directory, old, new):
    path = directory / MANIFEST_NAME
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def remake_manifest(directory, **changes):
    (directory / MANIFEST_NAME).write_bytes(replace(read_manifest(directory), **changes).encode())


def without(stated, *names):
    return {name: each for name, each in stated.segments.items() if name not in names}


def rewrite_without_topic(directory, topic):
    """Nothing of that topic is left in any segment, and whoever did it forgot the manifest."""
    for path in sorted((directory / TELEMETRY).glob("*.mcap")):
        rewrite(path, relist=False, without=topic)


def empty_segment(directory):
    (directory / TELEMETRY / "0006.mcap").write_bytes(b"")


# What was done, the word it makes, the file that it is reported of, and whether a list, which reads both ends of each
# file, says the same.
CASES = {
    "the last segment of the frames removed": (
        lambda s: remove(s, FRAMES, 4), Files.INCOMPLETE, "frames/0004.mcap", True
    ),
    "the last segment of the telemetry removed": (
        lambda s: remove(s, TELEMETRY, 5), Files.INCOMPLETE, "telemetry/0005.mcap", True
    ),
    "a segment in the middle removed": (
        lambda s: remove(s, FRAMES, 2), Files.INCOMPLETE, "frames/0002.mcap", True
    ),
    "segments of two sessions exchanged": (
        lambda s: swap_with(s, "frames/0002.mcap"), Files.DAMAGED, "frames/0002.mcap", True
    ),
    "a segment rewritten with another event": (
        lambda s: rewrite(s / TELEMETRY / "0001.mcap", relist=False, behind=[event("note", "all is well", "")]),
        Files.DAMAGED, "telemetry/0001.mcap", True,
    ),
    "an empty segment behind the last": (empty_segment, Files.DAMAGED, "telemetry/0006.mcap", True),
    "the channel of a device taken out": (
        lambda s: rewrite_without_topic(s, "/readings/regulator"), Files.DAMAGED, "telemetry/0000.mcap", True
    ),
    "the journal's last lines cut off": (
        lambda s: rewrite_journal(s, journal_lines_of(s)[:-2]), Files.INCOMPLETE, JOURNAL_NAME, True
    ),
    "the journal's first lines cut off": (
        lambda s: rewrite_journal(s, journal_lines_of(s)[2:]), Files.DAMAGED, JOURNAL_NAME, True
    ),
    "a line of the journal edited": (
        lambda s: rewrite_journal(s, [line.replace(b"done", b"gone") for line in journal_lines_of(s)]),
        Files.DAMAGED, JOURNAL_NAME, True,
    ),
    "the journal written anew with other steps": (
        lambda s: write_journal(s, *({**each, "step_id": "x"} for each in entries())),
        Files.DAMAGED, JOURNAL_NAME, True,
    ),
    "the journal removed": (lambda s: (s / JOURNAL_NAME).unlink(), Files.INCOMPLETE, JOURNAL_NAME, True),
    "a pipe for the journal": (
        lambda s: ((s / JOURNAL_NAME).unlink(), os.mkfifo(s / JOURNAL_NAME)), Files.INCOMPLETE, JOURNAL_NAME, True
    ),
    "a pipe for the manifest": (
        lambda s: ((s / MANIFEST_NAME).unlink(), os.mkfifo(s / MANIFEST_NAME)), Files.DAMAGED, MANIFEST_NAME, True
    ),
    "the manifest removed": (lambda s: (s / MANIFEST_NAME).unlink(), Files.INCOMPLETE, MANIFEST_NAME, True),
    "the manifest empty": (lambda s: (s / MANIFEST_NAME).write_bytes(b""), Files.DAMAGED, MANIFEST_NAME, True),
    "the manifest of another session": (
        lambda s: shutil.copy(s.parent / "cycle-2" / MANIFEST_NAME, s), Files.DAMAGED, MANIFEST_NAME, True
    ),
    "the manifest edited": (
        lambda s: edit_manifest(s, '"frames": 20', '"frames": 19'), Files.DAMAGED, MANIFEST_NAME, True
    ),
    "the manifest of a newer format": (
        lambda s: edit_manifest(s, '"format": 3', '"format": 4'), Files.UNKNOWN, MANIFEST_NAME, True
    ),
    "a folder for a manifest": (
        lambda s: ((s / MANIFEST_NAME).unlink(), (s / MANIFEST_NAME).mkdir()), Files.DAMAGED, MANIFEST_NAME, True
    ),
    "a manifest of wrong types, with the right checksum": (
        lambda s: remake_manifest(s, segments={"frames/0000.mcap": Sealed(*["x", 7, {}])}),
        Files.DAMAGED, MANIFEST_NAME, True,
    ),
    "a segment that the manifest does not list": (
        lambda s: remake_manifest(s, segments=without(read_manifest(s), "frames/0002.mcap")),
        Files.DAMAGED, "frames/0002.mcap", True,
    ),
    "a text that the manifest does not list": (
        lambda s: remake_manifest(s, texts={}), Files.DAMAGED, "", True
    ),
    "a text removed that the manifest lists": (
        lambda s: remake_manifest(s, texts={**read_manifest(s).texts, "recipe.yaml": hash_text("a: 1")}),
        Files.DAMAGED, "", True,
    ),
    "a bit flipped where no CRC is": (
        lambda s: flip_library(s / FRAMES / "0001.mcap"), Files.DAMAGED, "frames/0001.mcap", False
    ),
}  # fmt: skip


def named(found):
    """The files that findings are about."""
    return [finding.where for finding in found.findings if finding.where]


def flip_library(path):
    """The name of the writer's library in the header, which nothing reads."""
    data = path.read_bytes()
    path.write_bytes(data.replace(b"thermostand", b"thermostanD", 1))


@pytest.mark.parametrize(("change", "files", "where", "is_listed"), CASES.values(), ids=CASES)
def test_each_case_has_its_word_and_its_sentence_in_all_that_reads(recorded, change, files, where, is_listed):
    assert words(recorded) is Files.SOUND
    change(recorded)
    found = verify(recorded)
    assert (found.files, found.is_sound) == (files, False)
    assert where in [finding.where for finding in found.findings if finding.files is files]
    if is_listed:
        listed = scan(recorded)
        assert listed.files is files
        assert summarise_session(recorded).scanned.files is files
        assert where in [finding.where for finding in listed.findings if finding.files is files]
    if where != JOURNAL_NAME and is_listed:  # no export and no fit reads the journal
        with pytest.raises(SessionError):
            open_whole(recorded)


@pytest.mark.parametrize("case", ["the manifest removed", "the manifest empty", "the manifest of another session"])
def test_a_repair_makes_a_manifest_of_what_is_left_and_it_says_so(recorded, case):
    CASES[case][0](recorded)
    salvage_session(recorded)
    found = verify(recorded)
    if case == "the manifest of another session":  # it may be the segments that are another's
        assert found.files is Files.DAMAGED
        return
    assert found.files is Files.SOUND
    assert named(found) == [MANIFEST_NAME]
    assert open_whole(recorded).frame_count == SECONDS


def test_a_segment_that_its_recorder_did_not_come_to_list_is_a_note_until_it_is_listed(recorded):
    remake_manifest(recorded, segments=without(read_manifest(recorded), "frames/0004.mcap"), ended=False, journal=None)
    found = verify(recorded)
    assert found.files is scan(recorded).files is Files.SOUND
    assert named(found) == ["frames/0004.mcap"]
    assert salvage_session(recorded) == []
    assert named(verify(recorded)) == []


@pytest.mark.parametrize("depth", Depth)
async def test_a_complete_run_without_a_device_that_was_declared_is_not_sound(tmp_path, depth):
    found = scan(await record_run(tmp_path / "s", items=without_regulator), depth)
    assert found.files is Files.INCOMPLETE
    assert "regulator" in [finding.text.partition(":")[0] for finding in found.findings]


async def test_a_complete_run_without_a_channel_that_was_declared_is_not_sound(tmp_path):
    more = RecordedDevice("regulator", (*PUBLISHED["regulator"].channels, Channel("mv_heat", "%")))
    found = verify(await record_run(tmp_path / "s", devices={**PUBLISHED, "regulator": more}))
    assert found.files is Files.INCOMPLETE
    assert "regulator.mv_heat" in [finding.text.partition(":")[0] for finding in found.findings]


@pytest.mark.parametrize(("is_used", "files"), [(True, Files.INCOMPLETE), (False, Files.SOUND)])
async def test_a_camera_that_was_not_switched_on_may_have_no_reading_and_one_with_frames_may_not(
    tmp_path, is_used, files
):
    name = "camera" if is_used else "spare"
    unread = RecordedDevice("camera", (Channel("temperature", "degC"),), is_opened=False)
    found = verify(await record_run(tmp_path / "s", devices={**PUBLISHED, name: unread}))
    assert found.files is files
    assert name in [finding.text.partition(":")[0] for finding in found.findings]


def without_regulator(time_ns, index):
    return (item for item in second(time_ns, index) if getattr(item, "device", "") != "regulator")


def test_the_same_seed_gives_the_same_manifest(tmp_path):
    made = [asyncio.run(record_run(tmp_path / name / "cycle-1")) / MANIFEST_NAME for name in "ab"]
    assert made[0].read_bytes() == made[1].read_bytes()
    assert json.loads(made[0].read_bytes())["plan"] == {"steps": SECONDS, "frames": SECONDS}
