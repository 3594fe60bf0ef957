"""Which files a salvage makes, keeps and removes, whatever lies beside them and wherever it is killed."""

import fcntl
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.writer import Writer

from tests.recording.damage import (
    METADATA,
    hole,
    names,
    read_segment,
    write_segment,
)
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import BEING_RECORDED, format_salvaged, salvage_session, salvage_unfinished
from thermostand.recording.writing.segment import CommitSink

SERIES = [TELEMETRY, FRAMES]


@pytest.mark.parametrize("content", [b"", bytes(5000), b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(5000)])
def test_a_part_that_never_held_anything_is_removed(damaged, content):
    folder, _, _ = damaged(FRAMES, lambda data: content)
    (done,) = salvage_session(folder.parent)
    assert (done.path, done.kept, done.messages, done.lost_bytes) == (None, None, 0, 0)
    assert names(folder) == ["0000.mcap"]


def test_an_opening_without_a_message_is_removed(damaged, intact):
    folder, _, _ = damaged(FRAMES, lambda data: data[: intact[1][FRAMES, "part"].opening_bytes])
    (done,) = salvage_session(folder.parent)
    assert (done.path, done.kept) == (None, None)
    assert names(folder) == ["0000.mcap"]


def test_the_only_telemetry_is_finished_even_if_it_is_empty_so_that_the_frames_can_be_opened(tmp_path):
    written = write_segment(tmp_path / TELEMETRY, TELEMETRY, range(1))
    (tmp_path / TELEMETRY / "0000.mcap.part").write_bytes(written.data[: written.opening_bytes])
    write_segment(tmp_path / FRAMES, FRAMES, range(2))
    salvage_session(tmp_path)
    assert Session.open(tmp_path).frame_count == 2


def test_bytes_that_are_no_recording_are_kept(damaged):
    folder, _, _ = damaged(TELEMETRY, lambda data: b"notes of the night\n" * 50)
    (done,) = salvage_session(folder.parent)
    assert (done.path, done.kept) == (None, folder / "0001.mcap.damaged")
    assert done.kept.read_bytes() == b"notes of the night\n" * 50


def test_a_part_that_holds_no_more_than_its_finished_segment_is_removed(damaged):
    folder, path, written = damaged(TELEMETRY, lambda data: data)
    (done,) = salvage_session(folder.parent)
    for cut in (len(written.data), written.blocks[30].end):
        path.write_bytes(written.data[:cut])
        (again,) = salvage_session(folder.parent)
        assert (again.path, again.kept) == (done.path, None)
        assert names(folder) == ["0000.mcap", "0001.mcap"]
        assert read_segment(done.path) == written.messages


def test_a_part_that_holds_more_replaces_its_finished_segment(damaged, intact):
    cut = intact[1][TELEMETRY, "part"].blocks[30].end
    folder, path, written = damaged(TELEMETRY, lambda data: data[:cut])
    salvage_session(folder.parent)
    path.write_bytes(written.data)
    (done,) = salvage_session(folder.parent)
    assert (done.path, done.messages, done.kept) == (folder / "0001.mcap", len(written.messages), None)
    assert read_segment(done.path) == written.messages
    assert names(folder) == ["0000.mcap", "0001.mcap"]


@pytest.mark.parametrize("spoil", [lambda data: data[: len(data) // 3], lambda data: b""])
def test_a_part_wins_over_a_damaged_finished_segment(damaged, spoil):
    folder, path, written = damaged(TELEMETRY, lambda data: data)
    (done,) = salvage_session(folder.parent)
    spoiled = spoil(done.path.read_bytes())
    done.path.write_bytes(spoiled)
    path.write_bytes(written.data)
    salvage_session(folder.parent)
    assert read_segment(done.path) == written.messages
    assert names(folder)[2:] in (["0001.mcap.damaged"], [])
    assert (folder / "0001.mcap.damaged").read_bytes() == spoiled


def test_a_part_with_other_messages_than_its_finished_segment_is_kept(damaged, intact):
    folder, path, written = damaged(TELEMETRY, lambda data: data)
    path.replace(folder / "0000.mcap.part")
    (done,) = salvage_session(folder.parent)
    assert (done.source, done.path, done.messages) == (folder / "0000.mcap.part", folder / "0000.mcap", 0)
    assert done.kept.read_bytes() == written.data
    assert read_segment(done.path) == intact[1][TELEMETRY, "finished"].messages


def test_of_a_part_that_shares_some_frames_with_its_finished_segment_these_are_counted(tmp_path):
    folder, shared = tmp_path / "cycle" / FRAMES, 10
    write_segment(folder, FRAMES, range(20))
    salvage_session(folder.parent)
    write_segment(folder, FRAMES, range(20 - shared, 30))
    (folder / "0001.mcap.part").replace(folder / "0000.mcap.part")
    (done,) = salvage_session(folder.parent)
    assert done.messages == 2 * shared
    assert done.reason.startswith(f"holds {2 * shared} messages that 0000.mcap does not hold")
    assert done.kept == folder / "0000.mcap.damaged"


def test_a_living_recording_is_left_alone(damaged):
    folder, path, written = damaged(FRAMES, lambda data: data[:-5])
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        (done,) = salvage_session(folder.parent)
        assert (done.source, done.path, done.reason) == (path, None, BEING_RECORDED)
        assert format_salvaged(done).endswith("it is being recorded")
        assert path.read_bytes() == written.data[:-5]
    (done,) = salvage_session(folder.parent)
    assert done.path == folder / "0001.mcap"


def test_a_copy_that_was_not_finished_is_removed_unless_it_is_being_written(damaged):
    folder, _, _ = damaged(FRAMES, lambda data: data)
    copy = folder / "0000.mcap.tmp"
    copy.write_bytes(b"half a copy")
    with copy.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        salvage_session(folder.parent)
        assert copy.exists()
    salvage_session(folder.parent)
    assert not copy.exists()


@pytest.mark.parametrize("moment", [fcntl.flock, os.replace], ids=["before its lock", "before its final name"])
def test_the_copy_of_another_salvage_at_work_is_left_alone(damaged, moment):
    folder, path, written = damaged(FRAMES, lambda data: data)
    others = []

    def another_salvage(_frame, event, called):
        if event == "c_call" and called is moment and (folder / "0001.mcap.tmp").exists():
            sys.setprofile(None)
            others.extend(salvage_session(folder.parent))

    sys.setprofile(another_salvage)
    try:
        (done,) = salvage_session(folder.parent)
    finally:
        sys.setprofile(None)
    assert [(other.source, other.reason) for other in others] == [(path, BEING_RECORDED)]
    assert (done.path, done.kept) == (folder / "0001.mcap", None)
    assert read_segment(done.path) == written.messages
    assert names(folder) == ["0000.mcap", "0001.mcap"]


@pytest.mark.parametrize("change", [lambda data: data, hole(9000, 9500)], ids=["whole", "damaged"])
def test_a_salvage_that_was_killed_at_any_step_is_repeated(damaged, change):
    folder, path, _ = damaged(FRAMES, change)
    data = path.read_bytes()
    (done,) = salvage_session(folder.parent)
    expected, kept = names(folder), read_segment(done.path)
    assert salvage_session(folder.parent) == []

    path.write_bytes(data)  # killed before the original went: the copy is there
    salvage_session(folder.parent)
    assert [name for name in names(folder) if "damaged" not in name] == ["0000.mcap", "0001.mcap"]

    folder, path, _ = damaged(FRAMES, change)  # killed between the second name and the copy's own
    if len(expected) == 3:
        os.link(path, folder / expected[2])
    (folder / "0001.mcap.tmp").write_bytes(b"half a copy")
    salvage_session(folder.parent)
    assert names(folder) == expected
    assert read_segment(done.path) == kept
    assert salvage_session(folder.parent) == []


PARTIAL, DAMAGED = (lambda data: data[:-60]), hole(9000, 9500)
PLACED = ["replace", "sync_folder"]
KEPT = ["link", "sync_folder"]
GONE = ["unlink", "sync_folder"]
LISTED = ["fsync", *PLACED]


@pytest.mark.parametrize(
    ("which", "change", "steps"),
    [
        ("part", PARTIAL, ["fsync", *PLACED, *GONE, *LISTED]),
        ("part", DAMAGED, ["fsync", *KEPT, *PLACED, *GONE, *LISTED]),
        ("finished", DAMAGED, ["fsync", *KEPT, *PLACED, *LISTED]),
        ("part", lambda data: b"", GONE),
    ],
    ids=["partial", "damaged", "finished and damaged", "empty"],
)
def test_each_step_is_on_the_disk_before_the_next_so_that_a_power_cut_loses_nothing(damaged, which, change, steps):
    folder, _, _ = damaged(FRAMES, change, which)
    done, sizes = list[str](), list[int]()

    def write_down(frame, event, called):
        if event != "c_call" or called not in (os.fsync, os.link, os.replace, os.unlink):
            return
        is_of_folder = frame.f_code.co_name == "sync_folder"
        done.append("sync_folder" if is_of_folder else called.__name__)
        if done[-1] == "fsync":
            sizes.extend(path.stat().st_size for path in folder.glob("*.tmp"))

    sys.setprofile(write_down)
    try:
        (salvaged,) = salvage_session(folder.parent)
    finally:
        sys.setprofile(None)
    assert done == steps
    assert sizes == ([salvaged.path.stat().st_size] if salvaged.path else [])  # nothing of it waits in memory


@contextmanager
def small_disk(folder, size_bytes):
    if os.geteuid():
        pytest.skip("only root can mount a small disk")
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "tmpfs", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def test_a_full_disk_leaves_the_original_as_it_was(tmp_path, intact):
    data = intact[1][FRAMES, "part"].data
    with small_disk(tmp_path / "disk", len(data) + 20_000) as disk:
        (disk / "cycle" / FRAMES).mkdir(parents=True)
        part = disk / "cycle" / FRAMES / "0000.mcap.part"
        part.write_bytes(data)
        with pytest.raises(SessionError, match=r"cannot be repaired .*No space left"):
            salvage_unfinished(disk)
        assert names(disk) == ["cycle/frames/0000.mcap.part"]
        assert part.read_bytes() == data


def test_what_a_dead_recorder_had_reserved_is_space_for_the_copy(tmp_path, intact):
    data = intact[1][FRAMES, "part"].data
    disk_bytes = 4 * len(data)
    with small_disk(tmp_path / "disk", disk_bytes) as disk:
        (disk / "cycle" / FRAMES).mkdir(parents=True)
        sink = CommitSink(disk / "cycle" / FRAMES / "0000.mcap.part", disk_bytes - 20_000)
        sink.append([data])
        sink.close()
        done, _ = salvage_unfinished(disk)
        assert read_segment(done.path) == intact[1][FRAMES, "part"].messages


def write_with_attachment(path, attached):
    """A telemetry segment with a binary attachment before its metadata; where that begins."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        begin = file.tell()
        writer.add_attachment(0, 0, "earlier.mcap", "application/octet-stream", attached)
        writer.add_metadata("session", METADATA)
        channel = writer.register_channel("/x", "json", writer.register_schema("x", "jsonschema", b"{}"))
        for index in range(50):
            writer.add_message(channel, index, b"%d" % index, index)
        writer.finish()
    return begin


@pytest.mark.parametrize("place", [None, 0, 40, 3000], ids=["whole", "head", "name", "content"])
def test_an_attached_recording_is_not_taken_for_this_one(tmp_path, intact, place):
    (tmp_path / TELEMETRY).mkdir()
    part = tmp_path / TELEMETRY / "0000.mcap.part"
    begin = write_with_attachment(part, intact[1][TELEMETRY, "finished"].data)
    if place is not None:
        part.write_bytes(hole(begin + place, begin + place + 8)(part.read_bytes()))
    done = salvage_session(tmp_path)[0]
    assert [record.topic for record in read_segment(done.path)] == ["/x"] * 50


def test_the_start_of_the_daemon_looks_at_unfinished_segments_only(damaged):
    assert salvage_unfinished(Path("/nowhere")) == []
    folder, _, _ = damaged(FRAMES, lambda data: data[:-5])
    (folder / "0000.mcap").write_bytes(b"damaged")
    outside = folder.parent / "other"
    outside.mkdir()
    (outside / "0000.mcap.part").write_bytes(b"no series of ours")
    results = salvage_unfinished(folder.parent.parent)
    assert folder / "0001.mcap.part" in [done.source for done in results]
    assert (folder / "0000.mcap").read_bytes() == b"damaged"
    assert (outside / "0000.mcap.part").exists()


def test_a_directory_that_is_no_session_is_refused(tmp_path):
    with pytest.raises(SessionError, match="not a session"):
        salvage_session(tmp_path)
