"""Sessions on exchange disks: file systems without hard links, that cannot sync folders, or that change names."""

import asyncio
import errno
import os
import shutil
import stat
from pathlib import Path

import pytest

from tests.recording.runs import record_run
from thermostand.foundation.errors import SessionError
from thermostand.foundation.files import accept_unsynced_folders, sync_folder
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.records import list_frame_places
from thermostand.recording.reading.run_status import Files
from thermostand.recording.reading.scan import scan, verify
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return asyncio.run(record_run(tmp_path_factory.mktemp("recorded") / "cycle-1"))


@pytest.fixture
def session(recorded, tmp_path):
    return Path(shutil.copytree(recorded, tmp_path / "cycle-1"))


def damage(session):
    """A frame that is lost, and the segment as it is then."""
    path = session / FRAMES / "0001.mcap"
    data = bytearray(path.read_bytes())
    data[list_frame_places(path)[1].chunk.offset + 150] ^= 1
    path.write_bytes(data)
    return bytes(data)


def refuse(number):
    def call(*_, **__):
        raise OSError(number, os.strerror(number))

    return call


@pytest.mark.parametrize("number", [errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK])
def test_without_hard_links_the_original_is_kept_as_a_copy(session, monkeypatch, number):
    before = damage(session)
    monkeypatch.setattr(os, "link", refuse(number))
    (done,) = salvage_session(session)
    assert done.kept == session / FRAMES / "0001.mcap.damaged"
    assert done.kept.read_bytes() == before
    assert len(list_frame_places(session / FRAMES / "0001.mcap")) == 3
    assert salvage_session(session) == []
    assert not list(session.rglob("*.copying"))


def test_an_interrupted_repair_without_hard_links_keeps_one_copy(session, monkeypatch):
    before = damage(session)
    monkeypatch.setattr(os, "link", refuse(errno.EPERM))
    replace = os.replace
    monkeypatch.setattr(os, "replace", refuse(errno.EIO))
    with pytest.raises(SessionError):
        salvage_session(session)
    assert (session / FRAMES / "0001.mcap").read_bytes() == before
    monkeypatch.setattr(os, "replace", replace)
    salvage_session(session)
    assert [path.name for path in (session / FRAMES).glob("*.damaged")] == ["0001.mcap.damaged"]


def test_without_space_for_the_copy_nothing_is_changed(session, monkeypatch):
    before = damage(session)
    monkeypatch.setattr(os, "link", refuse(errno.EPERM))
    monkeypatch.setattr("thermostand.recording.repair.salvage.copyfile", refuse(errno.ENOSPC))
    with pytest.raises(SessionError, match="has no hard links, and a copy failed"):
        salvage_session(session)
    assert (session / FRAMES / "0001.mcap").read_bytes() == before
    assert sorted(path.name for path in (session / FRAMES).iterdir()) == [f"000{n}.mcap" for n in range(5)]


@pytest.fixture
def unsyncable(monkeypatch):
    """A file system that cannot sync a folder."""
    fsync = os.fsync

    def only_files(fd):
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(fd)

    monkeypatch.setattr(os, "fsync", only_files)


def test_folders_that_cannot_be_synced_are_reported_once_and_repair_goes_on(session, unsyncable):
    damage(session)
    reports = []
    with accept_unsynced_folders(reports.append):
        (done,) = salvage_session(session)
    assert done.kept is not None
    (sentence,) = reports
    assert str(session / FRAMES) in sentence
    assert "cannot sync folders (Invalid argument)" in sentence


def test_what_must_be_durable_is_refused_with_the_cause(session, unsyncable):
    with pytest.raises(OSError, match="cannot sync folders") as raised:
        sync_folder(session)
    assert raised.value.errno == errno.EINVAL


def capitals(session):
    for series in (TELEMETRY, FRAMES):
        for path in (session / series).iterdir():
            path.rename(path.with_name(path.name.upper()))
        (session / series).rename(session / series.upper())


def cut_short(session):
    for series, short in ((TELEMETRY, "TELEME~1"), (FRAMES, "FRAMES")):
        for path in (session / series).iterdir():
            path.rename(path.with_name(f"{path.name[:4]}~1.MCA"))
        (session / series).rename(session / short)


def only_the_files(session):
    for series in (TELEMETRY, FRAMES):
        for path in (session / series).iterdir():
            path.rename(path.with_name(path.name.upper()))


@pytest.mark.parametrize("change", [capitals, cut_short, only_the_files])
def test_names_that_a_file_system_has_changed_are_reported_with_what_to_do(session, change):
    change(session)
    for read in (scan, verify, Session.open, salvage_session):
        with pytest.raises(SessionError, match="a file system has changed its names") as raised:
            read(session)
        assert "\n" not in str(raised.value)


def test_one_changed_name_among_others_is_missing_and_named(session):
    (session / TELEMETRY / "0002.mcap").rename(session / TELEMETRY / "0002.MCAP")
    found = verify(session)
    assert found.files is Files.INCOMPLETE
    assert {each.where for each in found.findings} >= {f"{TELEMETRY}/0002.mcap", f"{TELEMETRY}/0002.MCAP"}
