"""Copies of sessions: whole, read back, resumable; what is deleted has one, and what is in use is never touched."""

import asyncio
import fcntl
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.recording.runs import record_run
from thermostand.foundation.errors import SessionError
from thermostand.recording.exporting import archive as module
from thermostand.recording.exporting.archive import MANIFEST, DeletionRule, archive, check_copy, delete, explain_unfit
from thermostand.recording.reading.catalogue import inspect_session
from thermostand.recording.reading.notes import add_note, add_tags, read_notes
from thermostand.recording.reading.scan import verify

DAY_NS = 86_400 * 10**9


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return asyncio.run(record_run(tmp_path_factory.mktemp("cycles") / "cycle"))


@pytest.fixture
def session(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "sessions" / "cycle"))


@pytest.fixture
def nas(tmp_path: Path) -> Path:
    return tmp_path / "nas"


def contents(directory: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in directory.rglob("*")
        if path.is_file() and path.name != MANIFEST
    }


def test_a_copy_is_the_session_and_is_known(session: Path, nas: Path):
    add_note(session, "windy", "eva", 1)
    assert inspect_session(session).archived == ""
    done: list[int] = []
    copy = archive(inspect_session(session), nas, "eva", 5, done.append)
    assert copy == nas / "cycle"
    assert contents(copy) == contents(session)
    assert sum(done) >= 2 * inspect_session(session).size_bytes
    assert verify(copy).is_sound
    assert inspect_session(session).archived == str(copy)
    check_copy(copy, inspect_session(session).contents)
    assert (read_notes(session).archived[0].time_ns, list(nas.iterdir())) == (5, [copy])


def test_a_session_that_grew_since_is_not_archived_any_more_and_its_copy_is_not_overwritten(session: Path, nas: Path):
    archive(inspect_session(session), nas, "eva", 5)
    with (session / "journal.jsonl").open("ab") as file:
        file.write(b"00000000 {}\n")
    assert inspect_session(session).archived == ""
    with pytest.raises(SessionError, match="is there already"):
        archive(inspect_session(session), nas, "eva", 6)


def test_notes_given_later_leave_it_archived(session: Path, nas: Path):
    archive(inspect_session(session), nas, "eva", 5)
    add_tags(session, ["paper"], "eva", 6)
    assert inspect_session(session).archived


def test_an_interrupted_copy_goes_on_behind_its_last_file(session: Path, nas: Path, monkeypatch):
    copied: list[str] = []
    whole = module._copy_file

    def cut(source: Path, target: Path, report):
        if len(copied) == 4:
            raise KeyboardInterrupt
        copied.append(source.name)
        return whole(source, target, report)

    monkeypatch.setattr(module, "_copy_file", cut)
    with pytest.raises(KeyboardInterrupt):
        archive(inspect_session(session), nas, "eva", 5)
    monkeypatch.setattr(module, "_copy_file", whole)
    assert not (nas / "cycle").exists()
    first = {path: path.stat().st_ino for path in (nas / "cycle.part").rglob("*.mcap")}
    assert first
    (nas / "cycle.part" / "frames" / ".0003.mcap.copying").write_bytes(b"part")
    copy = archive(inspect_session(session), nas, "eva", 6)
    assert contents(copy) == contents(session)
    assert {path.stat().st_ino for path in copy.rglob("*.mcap")} >= set(first.values())


def test_what_reads_back_differently_is_no_copy_and_the_next_try_mends_it(session: Path, nas: Path):
    part = nas / "cycle.part" / "frames"
    part.mkdir(parents=True)
    data = bytearray((session / "frames" / "0001.mcap").read_bytes())
    data[100] ^= 1
    (part / "0001.mcap").write_bytes(data)
    with pytest.raises(SessionError, match="reads back differently"):
        archive(inspect_session(session), nas, "eva", 5)
    assert inspect_session(session).archived == ""
    assert contents(archive(inspect_session(session), nas, "eva", 6)) == contents(session)


def test_what_is_recorded_unfinished_or_may_be_resumed_is_not_copied(session: Path, nas: Path):
    entry = inspect_session(session)
    for run in ("running", "interrupted"):
        with pytest.raises(SessionError, match=f"its run is {run} and may be resumed"):
            archive(replace(entry, run=run), nas, "eva", 5)
    shutil.copy(session / "frames" / "0000.mcap", session / "frames" / "0009.mcap.part")
    assert "was never finished" in explain_unfit(inspect_session(session))
    assert not nas.exists()


def test_a_full_disk_is_reported_before_anything_is_copied(session: Path, nas: Path, monkeypatch):
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 9, 1))
    with pytest.raises(SessionError, match=r"0.0 GB free, .* needs 0.1 GB"):
        archive(inspect_session(session), nas, "eva", 5)


def test_the_rule_says_what_may_be_deleted(session: Path, nas: Path):
    end_ns = inspect_session(session).end_utc_ns
    rule = DeletionRule(30)
    assert not rule.applies(inspect_session(session), end_ns + 40 * DAY_NS)
    archive(inspect_session(session), nas, "eva", 5)
    entry = inspect_session(session)
    assert [rule.applies(entry, end_ns + days * DAY_NS) for days in (0, 29, 30, 31)] == [False, False, True, True]
    assert not rule.applies(replace(entry, files="damaged"), end_ns + 40 * DAY_NS)
    assert not rule.applies(replace(entry, tags=("keep",)), end_ns + 40 * DAY_NS)
    assert str(rule).startswith("deleted are sound sessions")


def test_what_has_a_copy_is_deleted(session: Path, nas: Path):
    copy = archive(inspect_session(session), nas, "eva", 5)
    before = contents(session)
    delete(inspect_session(session))
    assert list(session.parent.iterdir()) == []
    assert contents(copy) == before


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda session, copy: (copy / "frames/0001.mcap").write_bytes(b"x"), "is not a complete copy"),
        (lambda session, copy: (copy / MANIFEST).unlink(), "is not a complete copy"),
        (lambda session, copy: shutil.rmtree(copy), "is not a complete copy"),
        (lambda session, copy: (session / "frames/0004.mcap").unlink(), "has changed since it was copied; it is kept"),
    ],
)
def test_without_a_whole_copy_nothing_is_deleted(session: Path, nas: Path, change, reason: str):
    copy = archive(inspect_session(session), nas, "eva", 5)
    entry = inspect_session(session)
    change(session, copy)
    before = contents(session)
    with pytest.raises(SessionError, match=reason):
        delete(entry)
    assert contents(session) == before


def test_a_flipped_bit_of_the_copy_is_found_before_anything_is_deleted(session: Path, nas: Path):
    copy = archive(inspect_session(session), nas, "eva", 5)
    data = bytearray((copy / "frames/0001.mcap").read_bytes())
    data[-100] ^= 1
    (copy / "frames/0001.mcap").write_bytes(data)
    with pytest.raises(SessionError, match="reads back differently"):
        delete(inspect_session(session))
    assert session.is_dir()
    assert (copy / "frames/0001.mcap").exists()


def test_a_session_that_a_daemon_has_open_is_not_deleted(session: Path, nas: Path):
    archive(inspect_session(session), nas, "eva", 5)
    entry = inspect_session(session)
    with (session / "journal.jsonl").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(SessionError, match="it is kept"):
            delete(entry)
    assert session.is_dir()
