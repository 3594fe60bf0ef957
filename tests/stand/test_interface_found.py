"""A daemon is found by the folder of its session: one that was killed, hangs, or is another one."""

import asyncio
import os
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import fork_server
from tests.daemon_queries import ask, ask_status
from tests.stand.fake_service import STAND, FakeService, serve_fake
from tests.stand.interface_client import DAEMON, entries_of, obeys
from thermostand.foundation.errors import SessionError
from thermostand.stand.serving import instances as runtime
from thermostand.stand.serving.client import find_session_server, list_running_sessions
from thermostand.stand.serving.instances import DaemonEntry, DaemonInstance


async def folder_stated(session: Path) -> None:
    """Return when the daemon has said which folder it is, whatever its name."""
    while not any(entry.identity for entry in entries_of(session)):
        await asyncio.sleep(0.01)


async def test_a_session_is_found_by_its_old_name_its_new_name_and_its_folder(tmp_path: Path):
    old, new = tmp_path / "sessions" / "old", tmp_path / "elsewhere" / "new"
    old.mkdir(parents=True)
    new.parent.mkdir()
    (tmp_path / "link").symlink_to(old.parent)
    async with serve_fake(FakeService(), old):
        await folder_stated(old)

        async def reached() -> list[object]:
            """By which of the names it is reached, and what it is called in each folder."""
            names = [old, new, tmp_path / "link" / "old", Path(os.path.relpath(old))]
            found = [name for name in names if await asyncio.to_thread(obeys, name)]
            roots = (old.parent, new.parent, tmp_path / "link")
            return [found == names, *[await asyncio.to_thread(list_running_sessions, root) for root in roots]]

        assert await reached() == [False, [old], [], [tmp_path / "link" / "old"]]
        old.rename(new)
        assert await reached() == [True, [old], [new], [tmp_path / "link" / "old"]]
        new.rename(new.with_name("newer"))
        assert await asyncio.to_thread(list_running_sessions, new.with_name("newer")) == [new.with_name("newer")]
        shutil.rmtree(new.parent)
        assert await asyncio.to_thread(obeys, old)
        assert not await asyncio.to_thread(obeys, new)


async def test_two_daemons_with_one_name_are_distinguished_by_the_folder(tmp_path: Path):
    """The first one's session was renamed, and the next run took its name."""
    session, away = tmp_path / "cycle", tmp_path / "renamed"
    session.mkdir()
    async with serve_fake(FakeService("first"), session):
        await folder_stated(session)
        session.rename(away)
        session.mkdir()
        async with serve_fake(FakeService("second"), session):
            while len([entry for entry in entries_of(session) if entry.identity]) < 2:
                await asyncio.sleep(0.01)
            assert (await asyncio.to_thread(find_session_server(away).state)).reasons == ("first",)
            assert (await asyncio.to_thread(find_session_server(session).state)).reasons == ("second",)


async def test_a_socket_that_somebody_removed_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As a logout does with $XDG_RUNTIME_DIR and all that is in it."""
    runtime = tmp_path / "runtime"
    runtime.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    async with serve_fake(FakeService(), tmp_path), asyncio.timeout(30):
        shutil.rmtree(runtime / "thermostand")
        with pytest.raises(SessionError, match="no daemon is running"):
            await asyncio.to_thread(ask, tmp_path, "stop")
        while not await asyncio.to_thread(obeys, tmp_path):
            await asyncio.sleep(0.05)
    assert list((runtime / "thermostand").iterdir()) == []


@pytest.fixture
def daemon() -> Iterator[Callable[[Path], "subprocess.Popen[str]"]]:
    started = []

    def start(session: Path) -> "subprocess.Popen[str]":
        process = fork_server.popen(
            [sys.executable, "-m", "tests.code", DAEMON, str(session)], stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


async def test_what_a_killed_daemon_left_is_nobodys_and_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, daemon: Callable[[Path], "subprocess.Popen[str]"]
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    runtime_folder = tmp_path / "thermostand"
    process = daemon(tmp_path)
    assert obeys(tmp_path)
    (entry,) = entries_of(tmp_path)
    assert (entry.session, entry.pid, entry.stand) == (str(tmp_path), process.pid, "a stand")
    process.kill()
    process.wait()
    assert {path.suffix for path in runtime_folder.iterdir()} == {".json", ".sock", ".stop"}
    with pytest.raises(SessionError, match="is running this session"):
        ask(tmp_path, "stop")
    assert list(runtime_folder.iterdir()) == []
    assert list_running_sessions(tmp_path.parent) == []
    async with serve_fake(FakeService(), tmp_path):
        assert await asyncio.to_thread(obeys, tmp_path)


def test_a_daemon_that_hangs_is_distinguished_from_a_missing_one(
    tmp_path: Path, daemon: Callable[[Path], "subprocess.Popen[str]"]
):
    daemon(tmp_path).send_signal(signal.SIGSTOP)
    with pytest.raises(SessionError, match=r"has not answered within 0\.2 s; it may hang"):
        ask(tmp_path, "stop", timeout_s=0.2)


async def test_a_runtime_folder_of_somebody_else_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "thermostand").symlink_to(tmp_path)
    with pytest.raises(SessionError, match="set XDG_RUNTIME_DIR"):
        async with serve_fake(FakeService(), tmp_path):
            pass
    (tmp_path / "thermostand").unlink()
    (tmp_path / "thermostand").write_text("mine")
    with pytest.raises(SessionError, match="cannot be made"):
        async with serve_fake(FakeService(), tmp_path):
            pass
    (tmp_path / "thermostand").unlink()
    (tmp_path / "thermostand").mkdir(mode=0o755)
    assert stat.S_IMODE(runtime.find_runtime_folder().stat().st_mode) == 0o700


@pytest.mark.parametrize("named", ["", "relative", "/nonexistent"])
def test_without_a_folder_of_the_login_the_systems_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str):
    monkeypatch.setattr(runtime, "SYSTEM_FOLDER", tmp_path / "lock")
    monkeypatch.setenv("XDG_RUNTIME_DIR", named)
    assert runtime.find_runtime_folder() == tmp_path / "lock"
    assert (tmp_path / "lock").is_dir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime.find_runtime_folder() == tmp_path / "thermostand"
    assert runtime.list_runtime_folders() == (tmp_path / "thermostand", tmp_path / "lock")  # daemons of both are found


def test_a_folder_without_a_daemon_and_no_folder_at_all_have_their_sentence(tmp_path: Path):
    for session in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(SessionError, match="is running this session"):
            ask(session, "stop")


@pytest.mark.parametrize(
    ("reply", "sentence"),
    [
        (b"", "ended before it answered"),
        (b"HTTP/1.1 200 OK\r\ncontent-length: 100\r\n\r\n{", "sent an unknown reply"),
        (b"hello\n", "sent an unknown reply"),
        (b"HTTP/1.1 200 OK\r\n\r\n<html>", "sent an unknown reply"),
        (b'HTTP/1.1 200 OK\r\n\r\n{"stand": 3}', "sent an unknown reply"),
        (b"HTTP/1.1 409 Conflict\r\n\r\n[]", "sent an unknown reply"),
    ],
)
async def test_a_daemon_that_talks_nonsense_is_reported(tmp_path: Path, reply: bytes, sentence: str):
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(reply)
        writer.close()

    presence = DaemonInstance(DaemonEntry(str(tmp_path), os.getpid(), STAND))
    try:
        everything, stop = presence.publish()
        stop.close()
        async with await asyncio.start_unix_server(talk, sock=everything):
            with pytest.raises(SessionError, match=sentence):
                await asyncio.to_thread(ask_status, tmp_path)
    finally:
        presence.withdraw()
