"""The journal: what was acknowledged is read again, whatever follows it in the file."""

import asyncio
import os
import resource
import threading
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.journals import MARK, lines_with, read_lines
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.journal_lines import format_lines, parse_lines
from thermostand.stand.running.memory.entries import (
    Begun,
    Ended,
    Gap,
    Held,
    Reset,
    Soaked,
    StepChanged,
    Tripped,
    decode,
)
from thermostand.stand.running.memory.journal import JOURNAL_NAME, Journal, take_over

ENTRIES = [
    Begun(1, "cycle-1", "0f", {"recipe.yaml": "ab"}, 7),
    StepChanged(2, "a1", "started"),
    Soaked(3, "a1", 60.0),
    Held(4, "operator", True),
    Held(5, "operator", False),
    Gap(5, 8),
    Tripped(6, "over_temperature", "too hot"),
    Reset(8),
    StepChanged(9, "a1", "done"),
    Ended(10, "stopped", "stopped by the operator: “✓”\n"),
]

times_ns = st.integers(0, 2**62)
words = st.text(max_size=20)
entries = st.one_of(
    st.builds(Begun, times_ns, words, words, st.dictionaries(words, words, max_size=3), st.none() | st.integers(0)),
    st.builds(StepChanged, times_ns, words, st.sampled_from(["started", "done"])),
    st.builds(Soaked, times_ns, words, st.floats(0, 1e6)),
    st.builds(Held, times_ns, words, st.booleans()),
    st.builds(Gap, times_ns, times_ns),
    st.builds(Tripped, times_ns, words, words),
    st.builds(Reset, times_ns),
    st.builds(Ended, times_ns, st.sampled_from(["complete", "failed"]), words),
)


async def write(journal: Journal, *written):
    journal.start(WallClock(), pytest.fail)
    for entry in written:
        await journal.write(entry)
    await journal.close()


def new_journal(directory: Path, *written) -> Path:
    asyncio.run(write(Journal.create(directory), *written))
    return directory / JOURNAL_NAME


def on_disk(directory: Path):
    return read_lines((directory / JOURNAL_NAME).read_bytes())[0]


@given(st.lists(entries, max_size=8))
def test_every_entry_is_read_as_it_was_written(written):
    data = lines_with(written)
    assert read_lines(data) == (written, len(data))
    assert data.count(b"\n") == len(written)


@given(st.lists(entries, max_size=6), st.data())
def test_any_cut_gives_the_entries_before_it(written, data):
    whole = lines_with(written)
    lines = whole.splitlines(keepends=True)
    cut = data.draw(st.integers(0, len(whole)))
    found, size_bytes = read_lines(whole[:cut])
    assert found == written[: len(found)]
    assert size_bytes == sum(map(len, lines[: len(found)])) <= cut
    assert len(found) == len(written) or cut < size_bytes + len(lines[len(found)])


@given(st.lists(entries, max_size=6), st.data())
def test_garbage_at_the_end_costs_nothing_and_a_flipped_bit_its_line(written, data):
    whole = lines_with(written)
    assert read_lines(whole + data.draw(st.binary(max_size=200)))[0] == written
    if whole:
        damaged = bytearray(whole)
        place = data.draw(st.integers(0, len(whole) - 1))
        hit = {whole[:place].count(b"\n")}
        if whole[place : place + 1] == b"\n":
            hit.add(max(hit) + 1)  # two lines are one now
        damaged[place] ^= 1 << data.draw(st.integers(0, 7))
        found, _ = read_lines(bytes(damaged))
        assert found == [entry for number, entry in enumerate(written) if number not in hit]


def flipped(path: Path, number: int) -> bytes:
    """The file with a bit flipped in its line of that number, from 0."""
    lines = path.read_bytes().splitlines(keepends=True)
    lines[number] = lines[number][:20] + bytes([lines[number][20] ^ 4]) + lines[number][21:]
    path.write_bytes(b"".join(lines))
    return path.read_bytes()


def test_a_damaged_line_is_reported_and_kept_in_a_file_and_the_lines_after_it_count(tmp_path):
    path = new_journal(tmp_path, *ENTRIES)
    damaged = flipped(path, 3)
    path.write_bytes(damaged + lines_with(ENTRIES[3:4], len(damaged))[:-4])  # and a torn tail
    for _ in range(2):  # the second time the copy is there
        journal, found = Journal.open(tmp_path)
        assert found == ENTRIES[:3] + ENTRIES[4:]
        assert journal.damage.startswith("journal.jsonl: line 4 of 10 ")
        assert "journal.jsonl.damaged" in journal.damage
        assert path.read_bytes() == damaged
        asyncio.run(write(journal))
    journal, _ = Journal.open(tmp_path)
    asyncio.run(write(journal, ENTRIES[3]))
    assert on_disk(tmp_path) == ENTRIES[:3] + ENTRIES[4:] + ENTRIES[3:4]
    journal, _ = Journal.open(tmp_path)
    asyncio.run(write(journal))
    assert [copy.name for copy in sorted(tmp_path.iterdir())] == ["journal.jsonl", "journal.jsonl.damaged"]
    assert (tmp_path / "journal.jsonl.damaged").read_bytes().startswith(damaged)


def test_lines_of_another_place_or_journal_do_not_count(tmp_path):
    """A sector that the disk wrote elsewhere holds whole lines with right CRCs: one may reset a trip."""
    path, other = new_journal(tmp_path, *ENTRIES), lines_with(ENTRIES, mark=b"0badf00d")
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    moved = b"".join([*lines[:2], lines[5], *lines[3:]])
    foreign = other[: len(lines[0])] + whole[len(lines[0]) :]
    for data, lost in ((moved, 2), (foreign, 0)):
        found = parse_lines(data)
        assert [text for text in found.sound if decode(text) not in ENTRIES] == []
        assert lost + 1 in found.damaged
        assert len(found.sound) < len(ENTRIES)
    assert parse_lines(foreign).damaged == (1,)
    assert parse_lines(other).damaged == ()


def test_a_second_damage_is_kept_in_a_file_as_well(tmp_path):
    path = new_journal(tmp_path, *ENTRIES)
    first = flipped(path, 3)
    asyncio.run(write(Journal.open(tmp_path)[0]))
    second = flipped(path, 1)
    journal, found = Journal.open(tmp_path)
    asyncio.run(write(journal))
    assert found == [ENTRIES[0], ENTRIES[2], *ENTRIES[4:]]
    assert "line 2 and 1 more of 10 are damaged" in journal.damage
    assert (tmp_path / "journal.jsonl.damaged").read_bytes() == first
    assert (tmp_path / "journal.jsonl.2.damaged").read_bytes() == second


def test_a_damaged_last_line_is_cut_off_but_not_lost(tmp_path):
    path = new_journal(tmp_path, *ENTRIES)
    damaged = flipped(path, len(ENTRIES) - 1)
    journal, found = Journal.open(tmp_path)
    asyncio.run(write(journal))
    assert found == ENTRIES[:-1] == on_disk(tmp_path)
    assert "line 10 of 10 is damaged" in journal.damage
    assert (tmp_path / "journal.jsonl.damaged").read_bytes() == damaged


def test_a_partial_tail_is_cut_off_and_the_journal_goes_on_behind_the_last_whole_line(tmp_path):
    path = new_journal(tmp_path, *ENTRIES[:3])
    whole = path.read_bytes()
    path.write_bytes(whole + lines_with(ENTRIES[3:4], len(whole))[:-4])
    journal, found = Journal.open(tmp_path)
    assert found == ENTRIES[:3]
    assert path.read_bytes() == whole
    asyncio.run(write(journal, *ENTRIES[3:]))
    assert on_disk(tmp_path) == ENTRIES


def test_a_journal_that_is_open_is_refused_to_a_second_daemon(tmp_path):
    journal = Journal.create(tmp_path)
    with pytest.raises(SessionError, match="is running this session"):
        Journal.open(tmp_path)
    asyncio.run(journal.close())
    assert on_disk(tmp_path) == []


def test_no_journal_and_a_second_one_are_refused_with_a_sentence(tmp_path):
    with pytest.raises(SessionError, match=r"no journal of .*\("):
        Journal.open(tmp_path)
    new_journal(tmp_path)
    with pytest.raises(SessionError, match="no journal can"):
        Journal.create(tmp_path)


@pytest.mark.parametrize("line", [b'{"entry": "Teleported", "time_ns": 1}', b'{"entry": "Gap", "to": 1}', b"[]", b"x"])
def test_a_whole_line_of_another_version_is_refused_with_a_sentence(tmp_path, line):
    (tmp_path / JOURNAL_NAME).write_bytes(format_lines([line], MARK))
    with pytest.raises(SessionError, match="another version"):
        Journal.open(tmp_path)
    (tmp_path / JOURNAL_NAME).unlink()
    new_journal(tmp_path)  # nothing stays locked or open


async def test_entries_that_the_disk_refuses_are_written_with_the_next(tmp_path):
    """The kernel refuses a file beyond a size, in the middle of a line, as a full disk would."""
    reported = []
    journal = Journal.create(tmp_path)
    journal.start(WallClock(), reported.append)
    await journal.write(ENTRIES[0])
    size_bytes = (tmp_path / JOURNAL_NAME).stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes + 10, hard))
    try:
        await journal.write(ENTRIES[1])
        await journal.write(ENTRIES[2])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    (report,) = reported
    assert "No space left on" in report
    assert (tmp_path / JOURNAL_NAME).stat().st_size == size_bytes
    await journal.write(ENTRIES[3])
    await journal.close()
    assert on_disk(tmp_path) == ENTRIES[:4]


async def test_notes_are_on_the_disk_in_their_order_when_the_journal_is_closed(tmp_path):
    journal = Journal.create(tmp_path)
    journal.start(WallClock(), pytest.fail)
    for entry in ENTRIES:
        journal.note(entry)
    await journal.close()
    await journal.close()
    assert on_disk(tmp_path) == ENTRIES


async def test_a_journal_that_was_removed_is_written_again_with_all_its_lines_and_stays_locked(tmp_path: Path):
    reported: list[str] = []
    journal, path = Journal.create(tmp_path), tmp_path / JOURNAL_NAME
    journal.start(WallClock(), reported.append)
    await journal.write(*ENTRIES[:2])
    assert await journal.recover()  # it is there
    path.unlink()
    await journal.write(ENTRIES[2])
    await journal.write(ENTRIES[3])
    assert len(reported) == 1
    assert "was removed or renamed" in journal.lost
    assert not await journal.recover()
    assert (journal.lost, on_disk(tmp_path)) == ("", ENTRIES[:2])
    with pytest.raises(SessionError, match="is running this session"):
        Journal.open(tmp_path)
    await journal.write(ENTRIES[4])
    assert await journal.recover()
    await journal.close()
    reopened, read = Journal.open(tmp_path)
    reopened.release()
    assert read == ENTRIES[:5]
    assert [each.name for each in tmp_path.iterdir()] == [JOURNAL_NAME]


async def test_who_writes_to_a_disk_that_hangs_may_leave_at_once_and_its_line_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    begun, hangs, sync = threading.Event(), threading.Event(), os.fdatasync

    def slow(fd: int) -> None:
        begun.set()
        hangs.wait(20.0)
        sync(fd)

    journal = Journal.create(tmp_path)
    journal.start(WallClock(), pytest.fail)
    await journal.write(ENTRIES[0])
    monkeypatch.setattr(os, "fdatasync", slow)
    writing = asyncio.create_task(journal.write(ENTRIES[1]))
    await asyncio.to_thread(begun.wait, 20.0)
    writing.cancel()
    done, _ = await asyncio.wait([writing], timeout=10.0)
    assert done
    hangs.set()
    await journal.close()
    assert on_disk(tmp_path) == ENTRIES[:2]


async def test_a_journal_that_is_closed_leaves_no_thread(tmp_path: Path):
    threads = len(os.listdir("/proc/self/task"))
    journal = Journal.create(tmp_path)
    journal.start(WallClock(), pytest.fail)
    await journal.write(ENTRIES[0])
    await journal.close()
    async with asyncio.timeout(20.0):
        while len(os.listdir("/proc/self/task")) > threads:
            await asyncio.sleep(0.01)


async def test_a_journal_whose_folder_comes_back_goes_on_in_it(tmp_path: Path):
    reported: list[str] = []
    folder, hidden = tmp_path / "session", tmp_path / "hidden"
    folder.mkdir()
    journal = Journal.create(folder)
    journal.start(WallClock(), reported.append)
    await journal.write(ENTRIES[0])
    folder.rename(hidden)
    await journal.write(ENTRIES[1])
    with pytest.raises(OSError, match="No such file"):
        await journal.recover()
    hidden.rename(folder)
    assert await journal.recover()
    await journal.write(ENTRIES[2])
    await journal.close()
    assert (len(reported), journal.lost, on_disk(folder)) == (1, "", ENTRIES[:3])


async def test_what_is_noted_of_a_journal_that_is_closed_or_was_given_up_is_nothing(tmp_path: Path):
    for number, ends in enumerate((Journal.close, Journal.abandon)):
        folder = tmp_path / str(number)
        folder.mkdir()
        journal = Journal.create(folder)
        with pytest.raises(ValueError, match="is started before"):
            await journal.write(ENTRIES[0])
        journal.note(ENTRIES[0])
        journal.start(WallClock(), pytest.fail)
        await journal.write(ENTRIES[1])
        ended = ends(journal)
        if ended is not None:
            await ended
        journal.note(ENTRIES[2])
        assert await journal.recover()
        reopened, read = Journal.open(folder)  # nobody has it any more
        reopened.release()
        assert read == [ENTRIES[1]]


def test_a_journal_that_somebody_else_has_is_not_taken_over_and_nothing_stays_open(tmp_path: Path):
    journal = Journal.create(tmp_path)
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(BlockingIOError):
        take_over(tmp_path / JOURNAL_NAME, 0)
    with pytest.raises(SessionError, match="is running this session"):
        Journal.open(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == files
    journal.release()
    file = take_over(tmp_path / JOURNAL_NAME, 0)
    file.append(b"a line\n")
    file.close()
    file.close()
    assert (tmp_path / JOURNAL_NAME).read_bytes() == b"a line\n"


def test_a_pipe_in_its_place_is_refused_and_not_waited_for(tmp_path: Path):
    os.mkfifo(tmp_path / JOURNAL_NAME)
    with pytest.raises(SessionError, match=r"journal\.jsonl: is no file"):
        Journal.open(tmp_path)


def test_an_entry_nested_deeper_than_anything_is_of_another_version():
    text = b"[" * 100_000
    with pytest.raises(SessionError, match="another version"):
        read_lines(b"%08x %s\n" % (zlib.crc32(text), text))


def test_one_that_fills_the_memory_is_refused(tmp_path: Path):
    (tmp_path / JOURNAL_NAME).touch()
    os.truncate(tmp_path / JOURNAL_NAME, 1 << 40)
    with pytest.raises(SessionError, match=r"journal\.jsonl: is larger than 32 MB"):
        Journal.open(tmp_path)
