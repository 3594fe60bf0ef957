"""What the guard does when a rule objects; the rules and the stand's wires have tests of their own."""

import asyncio
import os
import select
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.clock import Clock, VirtualClock, WallClock, seconds_ns
from drivers.interface import Unreachable
from stand.guard import Guard
from stand.hub import Event, Hub
from stand.interlocks import Fault, Rule, Watch
from stand.notify import Notifier, run_command


class PlainStand:
    """Only what a guard asks of a stand: it writes down what it was told, and when."""

    def __init__(self, log: list[str]) -> None:
        self.log = log
        self.renews = True

    async def make_safe(self) -> None:
        await asyncio.sleep(0)
        self.log.append("safe")

    async def renew_permits(self) -> None:
        self.log.append("renew")
        if not self.renews:
            raise Unreachable("relays", "no answer")


class Bench:
    """A guard over rules whose objections a test switches."""

    def __init__(
        self, *actions: str, can_hold: bool = True, command: tuple[str, ...] = (), clock: Clock | None = None
    ) -> None:
        self.log: list[str] = []
        self.events: list[Event] = []
        self.clock = clock or VirtualClock(0)
        self.objecting: set[int] = set()
        self.stand = PlainStand(self.log)
        hub = Hub()
        hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        watches = tuple(Watch(self._rule(index), 0.0, action) for index, action in enumerate(actions))
        stop, hold = (lambda fault, name=name: self.log.append(f"{name} {fault.rule}") for name in ("stop", "hold"))
        notifier = Notifier(command, 5.0, self.clock)
        self.guard = Guard(self.stand, watches, hub, self.clock, 1.0, 5.0, stop, hold if can_hold else None, notifier)

    def _rule(self, index: int) -> Rule:
        return lambda readings, now_ns: Fault(f"rule{index}", "it is so") if index in self.objecting else None

    async def run_for(self, duration_s: float) -> bool:
        """Let the guard watch for a while; whether it still does."""
        time = asyncio.create_task(self.clock.run())
        watching = asyncio.create_task(self.guard.run())
        await self.clock.sleep_until(self.clock.now_ns() + seconds_ns(duration_s))
        still = not watching.done()
        for task in (watching, time):
            task.cancel()
        await asyncio.gather(watching, time, return_exceptions=True)
        return still


async def test_permits_are_renewed_while_every_rule_holds():
    bench = Bench("abort", "hold", "warn")
    assert await bench.run_for(11.5)
    assert bench.log == ["renew"] * 3


async def test_an_abort_latches_then_makes_safe_and_ends_the_watch():
    bench = Bench("hold", "abort")
    bench.objecting = {0, 1}
    assert not await bench.run_for(3)
    assert bench.log == ["stop rule1", "safe"]
    assert [(event.level, event.kind, event.text) for event in bench.events] == [("error", "guard.rule1", "it is so")]


async def test_a_hold_latches_then_makes_safe_once_and_renews_nothing():
    bench = Bench("hold", "hold")
    bench.objecting = {1}
    assert await bench.run_for(20)
    assert bench.log == ["hold rule1", "safe"]
    assert bench.guard.held == Fault("rule1", "it is so", "hold")


async def test_only_an_operator_clears_a_hold_and_what_is_still_wrong_trips_again():
    bench = Bench("hold")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.guard.held is not None
    assert bench.log == ["hold rule0", "safe"]
    assert bench.guard.clear() == Fault("rule0", "it is so", "hold")
    await bench.run_for(1)
    assert bench.log == ["hold rule0", "safe", "renew"]
    bench.objecting = {0}
    await bench.run_for(2)
    bench.guard.clear()
    await bench.run_for(2)
    assert bench.log[3:] == ["hold rule0", "safe"] * 2
    assert [event.kind for event in bench.events] == ["guard.rule0"] * 3


async def test_clearing_gives_every_rule_its_grace_time_anew():
    bench = Bench("hold")
    watch = bench.guard.watches[0]
    watch.grace_s = 10.0
    bench.objecting = {0}
    await bench.run_for(8)
    assert bench.guard.clear() is None
    await bench.run_for(8)
    assert bench.guard.held is None
    await bench.run_for(4)
    assert bench.guard.held is not None


async def test_a_fault_that_aborts_does_so_during_a_hold():
    bench = Bench("hold", "abort")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = {0, 1}
    assert not await bench.run_for(2)
    assert bench.log == ["hold rule0", "safe", "stop rule1", "safe"]


async def test_without_a_way_to_hold_every_trip_aborts():
    bench = Bench("hold", can_hold=False)
    bench.objecting = {0}
    assert not await bench.run_for(2)
    assert bench.log == ["stop rule0", "safe"]


async def test_a_warning_is_told_when_it_begins_and_changes_nothing():
    bench = Bench("warn")
    for objecting in ({0}, {0}, set[int](), {0}):
        bench.objecting = objecting
        assert await bench.guard.check()
    assert bench.log == []
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "guard.rule0")] * 2


async def test_a_permit_that_cannot_be_renewed_is_told():
    bench = Bench("abort")
    bench.stand.renews = False
    assert await bench.run_for(2)
    assert [event.kind for event in bench.events] == ["permit_not_renewed"]


@pytest.fixture
def script(tmp_path: Path) -> Callable[[str], str]:
    """An executable shell script; what it is told is "$@"."""

    def make(body: str) -> str:
        path = tmp_path / "notify"
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return str(path)

    return make


async def test_a_trip_is_told_to_a_command_as_one_argument(tmp_path: Path, script: Callable[[str], str]):
    told = tmp_path / "told"
    bench = Bench("hold", command=(script(f'printf "%s|" "$@" > {told}'), "--to", "a b"))
    bench.objecting = {0}
    await bench.run_for(2)
    assert told.read_text() == "--to|a b|it is so|"
    assert [event.kind for event in bench.events] == ["guard.rule0"]


async def test_a_run_that_is_taken_down_waits_until_somebody_was_told(tmp_path: Path, script: Callable[[str], str]):
    """The guard is cancelled as soon as the stand is safe, while the command still runs: it only can in real time."""
    told = tmp_path / "told"
    bench = Bench("abort", command=(script(f"sleep 0.3; touch {told}; exit 3"),), clock=WallClock())
    bench.objecting = {0}
    watching = asyncio.create_task(bench.guard.run())
    while bench.log[-1:] != ["safe"]:
        await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert not told.exists()
    watching.cancel()
    await asyncio.wait([watching])
    assert watching.cancelled()
    assert told.exists()
    assert [event.kind for event in bench.events] == ["guard.rule0", "notify_failed"]


async def test_a_command_that_fails_is_an_event_and_no_more(script: Callable[[str], str]):
    bench = Bench("abort", command=(script("exit 7"),))
    bench.objecting = {0}
    assert not await bench.guard.check()
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
