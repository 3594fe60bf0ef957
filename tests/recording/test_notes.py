"""Notes and tags of a session: kept with who and when, only ever added to, whatever the file has come to."""

import os
import subprocess
import sys
from multiprocessing.pool import ThreadPool
from pathlib import Path

import pytest

from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.recording.reading.notes import (
    NOTES_NAME,
    Archived,
    Note,
    SessionNotes,
    add_archived,
    add_note,
    add_tags,
    read_notes,
)


def test_notes_and_tags_are_kept_in_order(tmp_path: Path):
    add_note(tmp_path, " door opened\n at 19:10 ", "eva", 5)
    add_tags(tmp_path, ["paper", "lens-B"], "eva", 6)
    add_tags(tmp_path, ["paper", "2026"], "jan", 7)
    add_tags(tmp_path, ["lens-B"], "jan", 8, remove=True)
    add_archived(tmp_path, Archived("/nas/cycle", 9, "0f"), "jan")
    assert read_notes(tmp_path) == SessionNotes(
        (Note(5, "eva", "door opened\n at 19:10"),), ("paper", "2026"), (Archived("/nas/cycle", 9, "0f"),)
    )


def test_without_a_file_no_note_was_made(tmp_path: Path):
    assert read_notes(tmp_path) == SessionNotes()
    assert read_notes(tmp_path / "nowhere") == SessionNotes()


def test_a_partial_or_damaged_line_costs_only_itself(tmp_path: Path):
    path = tmp_path / NOTES_NAME
    add_note(tmp_path, "first", "eva", 1)
    with path.open("ab") as file:
        file.write(b'12345678 {"entry": "note", "te')  # torn by a power cut
    add_note(tmp_path, "second", "eva", 2)
    with path.open("ab") as file:
        file.write(b"00000000 {}\n\n[]\n")
    add_note(tmp_path, "third", "eva", 3)
    assert [note.text for note in read_notes(tmp_path).notes] == ["first", "second", "third"]


@pytest.mark.parametrize("text", ["", "  \n", "x" * 4001])
def test_a_note_has_a_text_of_a_page_at_most(tmp_path: Path, text: str):
    with pytest.raises(ConfigError, match="a note has 1 to 4000 characters"):
        add_note(tmp_path, text, "eva", 1)


@pytest.mark.parametrize("tag", ["", "two words", "-x", "a,b", "x" * 41, "a\n", "../x"])
def test_a_tag_is_a_word(tmp_path: Path, tag: str):
    with pytest.raises(ConfigError, match="one word"):
        add_tags(tmp_path, [tag], "eva", 1)
    assert not (tmp_path / NOTES_NAME).exists()


def test_links_and_pipes_are_no_notes(tmp_path: Path):
    (tmp_path / "other").write_text("")
    (tmp_path / NOTES_NAME).symlink_to(tmp_path / "other")
    assert read_notes(tmp_path) == SessionNotes()
    with pytest.raises(SessionError, match="could not be kept"):
        add_note(tmp_path, "x", "eva", 1)
    (tmp_path / NOTES_NAME).unlink()
    (tmp_path / NOTES_NAME).mkdir()
    assert read_notes(tmp_path) == SessionNotes()
    (tmp_path / NOTES_NAME).rmdir()
    os.mkfifo(tmp_path / NOTES_NAME)
    assert read_notes(tmp_path) == SessionNotes()
    with pytest.raises(SessionError, match="file of notes"):
        add_note(tmp_path, "x", "eva", 1)


def test_a_note_that_a_full_disk_takes_in_part_is_refused_and_leaves_nothing(tmp_path: Path):
    code = """
import resource, signal, sys
from pathlib import Path
from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.notes import add_note, add_tags
folder = Path(sys.argv[1])
add_note(folder, "first", "eva", 1)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
size = (folder / "notes.jsonl").stat().st_size
resource.setrlimit(resource.RLIMIT_FSIZE, (size + 20, size + 20))  # a write across it is a short one, the next fails
try:
    add_tags(folder, ["keep"], "eva", 2)
except SessionError:
    sys.exit(0 if (folder / "notes.jsonl").stat().st_size == size else 4)
sys.exit(3)
"""
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False).returncode == 0
    assert read_notes(tmp_path).tags == ()
    add_tags(tmp_path, ["keep"], "eva", 3)
    assert read_notes(tmp_path) == SessionNotes((Note(1, "eva", "first"),), ("keep",))


def test_a_folder_that_is_a_link_gets_no_note(tmp_path: Path):
    other = tmp_path / "elsewhere"
    other.mkdir()
    (tmp_path / "cycle").symlink_to(other)
    with pytest.raises(SessionError, match="symbolic link"):
        add_note(tmp_path / "cycle", "x", "eva", 1)
    assert list(other.iterdir()) == []


def test_notes_given_at_once_are_all_kept(tmp_path: Path):
    with ThreadPool(8) as pool:
        pool.map(lambda number: add_note(tmp_path, f"note {number}", "eva", number), range(40))
    assert sorted(note.time_ns for note in read_notes(tmp_path).notes) == list(range(40))


def test_damage_of_the_notes_is_named_and_nothing_is_written_behind_a_partial_line(tmp_path: Path):
    for number in range(3):
        add_note(tmp_path, f"note {number}", "eva", number)
    path = tmp_path / NOTES_NAME
    whole = path.read_bytes()
    first, second, third = whole.splitlines(keepends=True)
    path.write_bytes(third + second + first)  # each sound, and two of them not of their place
    assert read_notes(tmp_path).damage.startswith("line 1 and 1 more of 3 are damaged")
    assert [note.text for note in read_notes(tmp_path).notes] == ["note 1"]
    path.write_bytes(whole[:-4])
    by_operator = read_notes(tmp_path)
    assert (len(by_operator.notes), by_operator.damage) == (2, "")
    assert f"the last {len(third) - 4} bytes are no line" in by_operator.unended
    add_note(tmp_path, "note 2", "eva", 2)
    assert path.read_bytes() == whole
    other = tmp_path / "renamed"
    other.mkdir()
    (other / NOTES_NAME).write_bytes(whole)
    add_note(other, "more", "eva", 3)
    assert (len(read_notes(other).notes), read_notes(other).damage) == (4, "")
