"""The index of a folder's sessions: what it says is what a look says, whatever becomes of the files or of the index."""

import asyncio
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.recording.full_session import START_NS
from tests.recording.runs import record_run
from thermostand.recording.reading import catalogue as module
from thermostand.recording.reading.catalogue import INDEX_NAME, SessionCache, inspect_session, load_catalogue
from thermostand.recording.reading.notes import add_note, add_tags


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return asyncio.run(record_run(tmp_path_factory.mktemp("cycles") / "cycle"))


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    for name in ("a", "b", "c"):
        shutil.copytree(recorded, tmp_path / name)
    (tmp_path / "no-session").mkdir()
    return tmp_path


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The sessions that were looked at; the list is emptied by the test."""
    seen: list[str] = []

    def look(path: Path):
        seen.append(path.name)
        return inspect_session(path)

    monkeypatch.setattr(module, "inspect_session", look)
    return seen


def listed(folder: Path, looks: list[str]) -> list[str]:
    """What a list says is what a look at each says; which sessions it has looked at."""
    looks.clear()
    entries = load_catalogue(folder)
    looked = sorted(looks)
    assert entries == sorted((inspect_session(entry.path) for entry in entries), key=lambda entry: str(entry.path))
    return looked


def test_a_session_is_looked_at_once(folder: Path, looks: list[str]):
    assert listed(folder, looks) == ["a", "b", "c"]
    assert listed(folder, looks) == []


def test_who_must_not_write_remembers_instead(folder: Path, looks: list[str]):
    memory = SessionCache()
    for expected in (["a", "b", "c"], []):
        looks.clear()
        assert [entry.path.name for entry in load_catalogue(folder, memory=memory)] == ["a", "b", "c"]
        assert sorted(looks) == expected
    assert not (folder / INDEX_NAME).exists()
    shutil.rmtree(folder / "b")
    assert len(load_catalogue(folder, memory=memory)) == len(memory) == 2


@pytest.mark.parametrize(
    "change",
    [
        lambda session: (session / "telemetry/0001.mcap").write_bytes(b""),
        lambda session: os.utime(session / "frames/0001.mcap", ns=(1, 1)),
        lambda session: (session / "frames/0002.mcap").unlink(),
        lambda session: (session / "frames/0002.mcap").rename(session / "frames/0002.mcap.part"),
        lambda session: (session / "journal.jsonl").unlink(),
        lambda session: add_note(session, "windy", "me", 1),
        lambda session: (session.rename(session.with_name("old")), shutil.copytree(session.with_name("old"), session)),
    ],
)
def test_what_changed_is_looked_at_again(folder: Path, looks: list[str], change):
    listed(folder, looks)
    change(folder / "b")
    assert listed(folder, looks) in (["b"], ["b", "old"])
    assert listed(folder, looks) == []


def test_sessions_that_are_gone_renamed_or_moved_in(folder: Path, looks: list[str]):
    listed(folder, looks)
    shutil.rmtree(folder / "a")
    (folder / "c").rename(folder / "d")
    assert listed(folder, looks) == ["d"]
    with closing(sqlite3.connect(folder / INDEX_NAME)) as index:
        assert [name for (name,) in index.execute("SELECT name FROM sessions")] == [b"b", b"d"]


def rewrite(sql: str, folder: Path) -> None:
    with closing(sqlite3.connect(folder / INDEX_NAME)) as index, index:
        index.execute(sql)


@pytest.mark.parametrize(
    "harm",
    [
        lambda folder: (folder / INDEX_NAME).unlink(),
        lambda folder: (folder / INDEX_NAME).write_bytes(b"no database at all" * 100),
        lambda folder: (folder / INDEX_NAME).write_bytes(b""),
        lambda folder: (folder / INDEX_NAME).write_bytes((folder / INDEX_NAME).read_bytes()[:5000]),
        lambda folder: rewrite("CREATE TABLE more (x)", folder),
        lambda folder: rewrite("DROP TABLE sessions", folder),
        lambda folder: rewrite("UPDATE sessions SET sealed = 'another version'", folder),
        lambda folder: rewrite("UPDATE sessions SET entry = replace(entry, 'complete', 'stopped ')", folder),
        lambda folder: rewrite("UPDATE sessions SET entry = '{}'", folder),
        lambda folder: rewrite("UPDATE sessions SET entry = replace(entry, '20', '\"20\"')", folder),
        lambda folder: rewrite("UPDATE sessions SET entry = 7", folder),
    ],
)
def test_an_index_that_is_lost_damaged_or_another_ones_is_made_again(folder: Path, looks: list[str], harm):
    listed(folder, looks)
    harm(folder)
    assert listed(folder, looks) == ["a", "b", "c"]
    assert listed(folder, looks) == []


def test_a_link_is_not_followed_and_a_folder_in_its_place_does_no_harm(folder: Path, looks: list[str], tmp_path: Path):
    elsewhere = tmp_path / "elsewhere.sqlite"
    (folder / INDEX_NAME).symlink_to(elsewhere)
    listed(folder, looks)
    assert not elsewhere.exists()
    (folder / INDEX_NAME).unlink()
    (folder / INDEX_NAME).mkdir()
    assert listed(folder, looks) == ["a", "b", "c"]


def test_where_nothing_can_be_written_each_is_looked_at(folder: Path, looks: list[str], monkeypatch):
    def refused(*_args: object, **_options: object):
        raise sqlite3.OperationalError("attempt to write a readonly database")

    monkeypatch.setattr(sqlite3, "connect", refused)
    assert listed(folder, looks) == ["a", "b", "c"]
    assert listed(folder, looks) == ["a", "b", "c"]


def test_while_another_one_writes_the_index_the_list_is_complete(folder: Path, looks: list[str], monkeypatch):
    listed(folder, looks)
    monkeypatch.setattr(module, "_BUSY_S", 0.01)
    add_tags(folder / "b", ["paper"], "me", START_NS)
    with closing(sqlite3.connect(folder / INDEX_NAME)) as index:
        index.execute("BEGIN EXCLUSIVE")
        assert listed(folder, looks) == ["a", "b", "c"]


def test_the_progress_counts_those_that_are_looked_at(folder: Path):
    reported: list[object] = []

    def progress(count: int):
        reported.append(count)
        return lambda done, text: reported.append((done, text))

    load_catalogue(folder, progress)
    assert reported[0] == 3
    assert sorted(str(each[1]) for each in reported[1:] if isinstance(each, tuple)) == ["a", "b", "c"]
    reported.clear()
    load_catalogue(folder, progress)
    assert reported == []
