"""Who is told of a trip, by which command, and what comes of one that fails or hangs."""

import asyncio
import os
import select
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.stand.guard_bench import NOTIFIERS, Bench, NotedFile
from thermostand.foundation.clock import WallClock
from thermostand.stand.guarding.notify_process import run_command


@pytest.fixture(autouse=True)
def _ended_notifiers() -> Iterator[None]:
    yield
    while NOTIFIERS:
        NOTIFIERS.pop().close()


async def test_a_guard_that_fails_aborts_makes_safe_and_tells(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    bench = Bench("hold", command=(script(f'printf "%s" "$1" > {reported}'),))
    bench.broken = KeyError("channel")
    time = asyncio.create_task(bench.clock.run())
    with pytest.raises(KeyError):
        await bench.guard.run()
    await bench.guard.notified()
    time.cancel()
    assert bench.log == ["stop guard_failed", "revoke", "safe"]
    text = "the guard failed (KeyError: 'channel')"
    assert [(event.level, event.kind, event.text) for event in bench.events] == [("error", "guard.guard_failed", text)]
    assert reported.read_text() == text


@pytest.fixture
def script(tmp_path: Path) -> Callable[[str], str]:
    """An executable shell script; what it is given is "$@"."""

    def make(body: str) -> str:
        path = tmp_path / "notify"
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return str(path)

    return make


async def test_a_command_gets_a_trip_as_one_argument(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    bench = Bench("hold", command=(script(f'printf "%s|" "$@" > {reported}'), "--to", "a b"))
    bench.objecting = {0}
    await bench.run_for(2)
    assert reported.read_text() == "--to|a b|it is so|"
    assert [event.kind for event in bench.events] == ["guard.rule0"]


async def test_a_hold_that_has_come_back_too_often_and_now_stays_is_told(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    bench = Bench("hold", command=(script(f'echo "$1" >> {reported}'),))
    bench.guard.watches[0].ends_itself = True
    bench.latch.file = NotedFile(bench.log)
    for _ in range(4):
        bench.objecting = {0}
        await bench.run_for(2)
        bench.objecting = set()
        await bench.run_for(2)
    told = reported.read_text().splitlines()
    assert told[:4] == ["it is so"] * 4
    assert len(told) == 5
    assert "more than 3 times" in told[4]
    assert bench.log.count("latch rule0") == 1  # now it is for an operator


async def test_a_run_that_is_taken_down_waits_until_somebody_was_notified(tmp_path: Path, script: Callable[[str], str]):
    """The guard ends at once, while the command still runs: it only can in real time."""
    reported = tmp_path / "reported"
    bench = Bench("abort", command=(script(f"sleep 0.3; touch {reported}; exit 3"),), clock=WallClock())
    bench.objecting = {0}
    watching = asyncio.create_task(bench.guard.run())
    while bench.log[-1:] != ["safe"]:
        await asyncio.sleep(0)
    await asyncio.wait([watching])
    assert not reported.exists()
    await bench.guard.notified()
    assert reported.exists()
    assert [event.kind for event in bench.events] == ["guard.rule0", "notify_failed"]


async def test_what_is_not_safe_is_reported_with_the_trip(tmp_path: Path, script: Callable[[str], str]):
    reported = tmp_path / "reported"
    bench = Bench("abort", command=(script(f'printf "%s" "$1" > {reported}'),))
    bench.actuator.failure = "no answer"
    bench.objecting = {0}
    assert not bench.guard.look()
    await bench.guard.notified()
    unsafe = "relays did not confirm its safe state: relays: no answer"
    assert reported.read_text().endswith(f"; NOT SAFE: {unsafe}")
    await bench.safety.close()


async def test_a_command_that_hangs_is_killed_and_an_event_while_the_hold_stands(script: Callable[[str], str]):
    bench = Bench("hold", command=(script("exec sleep 600"),), limit_s=0.2)
    bench.objecting = {0}
    assert await bench.run_for(20)
    assert bench.guard.held is not None
    assert [event.kind for event in bench.events] == ["guard.rule0", "notify_failed"]
    assert bench.events[1].text.endswith("end within 0.2 s")


@pytest.mark.parametrize("command", ["/nowhere/tell", "no-such-program-here", "/dev/null"])
async def test_a_command_that_cannot_be_run_is_reported_when_the_watch_begins(command: str):
    bench = Bench("hold", command=(command,))
    assert await bench.run_for(20)
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "notify_failed")]
    assert bench.events[0].text.startswith(f"guard.notify: {command} is no program")


async def test_a_command_that_fails_is_an_event_and_no_more(script: Callable[[str], str]):
    bench = Bench("abort", command=(script("exit 7"),))
    bench.objecting = {0}
    assert not bench.guard.look()
    await bench.guard.notified()
    assert [(event.level, event.kind) for event in bench.events[1:]] == [("warning", "notify_failed")]
    assert bench.events[1].text.endswith("notify ended with status 7")


def test_a_command_that_does_not_exist_or_hangs_gives_a_sentence(tmp_path: Path, script: Callable[[str], str]):
    assert "could not be started (" in run_command((str(tmp_path / "none"), "text"), 5.0)
    assert run_command((script("true"), "text"), 5.0) == ""
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        hanging = script(f"sleep 600 > {pipe} & wait")
        assert run_command((hanging, "text"), 0.3).endswith("did not end within 0.3 s")
        assert select.select([reader], [], [], 10.0)[0]  # nobody has the other end open: its child is gone, too
        assert os.read(reader, 1) == b""
    finally:
        os.close(reader)
