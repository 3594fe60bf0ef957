"""What the guard does when a rule objects; the rules and the stand's wires have tests of their own."""

import asyncio
import os
import select
import stat
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from foundation.clock import Clock, VirtualClock, WallClock, block_until, seconds_ns
from foundation.errors import DeviceFault
from foundation.hub import Hub
from foundation.items import Batch, Event
from foundation.readings import Reading
from stand.fault import Fault, Readings
from stand.guarding.guard import Guard
from stand.guarding.interlocks import Rule, Watch
from stand.guarding.notify import Notifier
from stand.guarding.notify_process import run_command
from stand.safety import Safety


class PlainActuator:
    """Writes down that it was made safe, or does not confirm it."""

    name = "relays"

    def __init__(self, log: list[str]) -> None:
        self.log = log
        self.failure = ""

    async def make_safe(self) -> None:
        await asyncio.sleep(0)
        self.log.append("safe")
        if self.failure:
            raise DeviceFault(self.name, self.failure)


NOTIFIERS: list[Notifier] = []  # of the test


@pytest.fixture(autouse=True)
def _ended_notifiers() -> Iterator[None]:
    yield
    while NOTIFIERS:
        NOTIFIERS.pop().close()


class Bench:
    """A guard over rules whose objections a test switches."""

    def __init__(
        self,
        *actions: Any,
        can_hold: bool = True,
        command: tuple[str, ...] = (),
        limit_s: float = 5.0,
        clock: Clock | None = None,
    ) -> None:
        self.log: list[str] = []
        self.events: list[Event] = []
        self.clock = clock or VirtualClock(0)
        self.broken: Exception | None = None  # what the rules raise
        self.objecting: set[int] = set()
        self.actuator = PlainActuator(self.log)
        self.hub = hub = Hub()
        self.safety = Safety(lambda: self.log.append("revoke"), hub, self.clock)
        self.safety.take(self.actuator, 60.0)
        hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        watches = tuple(Watch(self._rule(index), 0.0, action) for index, action in enumerate(actions))
        stop, hold = (lambda fault, name=name: self.log.append(f"{name} {fault.rule}") for name in ("stop", "hold"))
        notifier = Notifier(command, limit_s, self.clock)
        NOTIFIERS.append(notifier)
        self.guard = Guard(
            self.safety,
            watches,
            hub,
            self.clock,
            1.0,
            stop,
            hold if can_hold else None,
            lambda: self.log.append("release"),
            notifier=notifier,
        )

    def _rule(self, index: int) -> Rule:
        def rule(readings: Readings, now_ns: int) -> Fault | None:
            if self.broken is not None:
                raise self.broken
            return Fault(f"rule{index}", "it is so") if index in self.objecting else None

        return rule

    async def run_for(self, duration_s: float) -> bool:
        """Let the guard watch for a while; whether it still does."""
        time = asyncio.create_task(self.clock.run())
        watching = asyncio.create_task(self.guard.run())
        await self.clock.sleep_until(self.clock.now_ns() + seconds_ns(duration_s))
        still = not watching.done()
        await self.guard.notified()
        for task in (watching, time):
            task.cancel()
        await asyncio.gather(watching, time, return_exceptions=True)
        return still


async def test_permits_may_be_renewed_while_every_rule_holds_and_the_guard_looks():
    bench = Bench("abort", "hold", "warn")
    assert not bench.guard.may_permit()
    assert await bench.run_for(11.5)
    assert bench.guard.may_permit()
    bench.clock = VirtualClock(bench.clock.now_ns() + seconds_ns(2.1))
    bench.guard.clock = bench.clock
    assert not bench.guard.may_permit()  # nobody has looked for more than two periods
    assert bench.log == []


async def test_an_abort_latches_then_makes_safe_and_ends_the_watch():
    bench = Bench("hold", "abort")
    bench.objecting = {0, 1}
    assert not await bench.run_for(3)
    assert bench.log == ["stop rule1", "revoke", "safe"]
    assert [(event.level, event.kind, event.text) for event in bench.events] == [("error", "guard.rule1", "it is so")]


async def test_a_hold_latches_then_makes_safe_once_and_renews_nothing():
    bench = Bench("hold", "hold")
    bench.objecting = {1}
    assert await bench.run_for(20)
    assert bench.log == ["hold rule1", "revoke", "safe"]
    assert bench.guard.held == Fault("rule1", "it is so", "hold")


async def test_what_is_still_wrong_when_it_is_cleared_holds_before_anything_can_move():
    bench = Bench("hold")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.guard.clear()
    assert bench.guard.held == Fault("rule0", "it is so", "hold")
    assert bench.log == ["hold rule0", "revoke", "safe", "hold rule0", "revoke"]
    await bench.run_for(2)
    assert bench.log[5:] == ["safe"]


async def test_a_hold_that_is_not_confirmed_safe_is_made_safe_again_every_minute_until_it_is():
    bench = Bench("hold")
    bench.actuator.failure = "no answer"
    bench.objecting = {0}
    await bench.run_for(130)
    assert bench.log == ["hold rule0", "revoke"] + ["safe"] * 3
    bench.actuator.failure = ""
    await bench.run_for(130)
    assert bench.log == ["hold rule0", "revoke"] + ["safe"] * 4
    assert [event.kind for event in bench.events] == ["guard.rule0", "not_confirmed_safe", "confirmed_safe"]


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


async def test_a_run_that_cannot_be_ended_does_not_keep_the_stand_from_being_made_safe():
    bench = Bench("abort")

    def fails(fault: Fault) -> None:
        raise KeyError(fault.rule)

    bench.guard.stop = fails
    bench.objecting = {0}
    with pytest.raises(KeyError):
        bench.guard.look()
    await bench.safety.tried()
    assert bench.log == ["revoke", "safe"]


async def test_a_guard_that_was_kept_from_looking_says_so():
    """Real time goes on while somebody computes in the event loop."""
    bench = Bench("hold", clock=WallClock())
    bench.guard.period_s = 0.5
    watching = asyncio.create_task(bench.guard.run())
    while not bench.guard.may_permit():
        await asyncio.sleep(0)
    block_until(bench.clock, bench.clock.now_ns() + seconds_ns(1.2))
    assert not bench.guard.may_permit()
    while not bench.events:
        await asyncio.sleep(0)
    watching.cancel()
    await asyncio.wait([watching])
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "guard_late")]
    assert bench.events[0].text.startswith("the guard has not looked for 1.")
    assert bench.events[0].data["gap_s"] > 1.2


async def test_after_a_late_look_permits_wait_for_readings_taken_since():
    """A reading whose reply lay in a buffer meanwhile does not count either."""
    bench = Bench("hold")
    bench.guard.vital = ("regulator.pv", "thermometers.air")

    def read(*channels: str) -> None:
        now_ns = bench.clock.now_ns()
        for channel in channels:
            bench.hub.publish(Batch("device", now_ns, (Reading(channel, 24.0, "degC", now_ns),)))

    read("regulator.pv", "thermometers.air")
    await bench.run_for(3)
    assert bench.guard.may_permit()
    bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + seconds_ns(13))
    assert bench.guard.look()
    assert [event.kind for event in bench.events] == ["guard_late"]
    read("regulator.pv", "thermometers.air")
    assert not bench.guard.may_permit()
    await bench.run_for(1.5)
    assert not bench.guard.may_permit()
    read("regulator.pv")
    assert not bench.guard.may_permit()
    read("thermometers.air")
    assert bench.guard.may_permit()


async def test_after_a_late_look_what_could_not_be_renewed_has_time_to_be():
    bench = Bench("abort", "hold")
    bench.guard.watches[0].after_gap_s = 5.0
    await bench.run_for(3)
    bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + seconds_ns(60))
    bench.objecting = {0}
    assert bench.guard.look()
    await bench.run_for(4)
    assert bench.log == []
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.log == []
    bench.objecting = {0}
    await bench.run_for(2)
    assert "stop rule0" in bench.log


async def test_after_a_late_look_what_is_not_renewed_in_time_trips_and_other_rules_do_at_once():
    for objecting, within_s, log in (({0}, 4, False), ({0}, 7, True), ({1}, 1, True)):
        bench = Bench("abort", "abort")
        bench.guard.watches[0].after_gap_s = 5.0
        await bench.run_for(3)
        bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + seconds_ns(60))
        bench.objecting = objecting
        bench.guard.look()
        await bench.run_for(within_s)
        assert bool(bench.log) == log


async def test_a_hold_does_not_end_because_its_cause_is_passed_over_after_a_late_look():
    """A disk that hangs, and a process that was stopped meanwhile."""
    bench = Bench("hold")
    bench.guard.watches[0].ends_itself, bench.guard.watches[0].after_gap_s = True, 5.0
    bench.objecting = {0}
    await bench.run_for(3)
    bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + seconds_ns(60))
    await bench.run_for(10)
    assert bench.guard.held is not None
    assert bench.log == ["hold rule0", "revoke", "safe"]
    bench.objecting = set()
    await bench.run_for(2)
    assert bench.log[3:] == ["release"]


async def test_a_hold_that_ends_by_itself_ends_when_the_stand_is_safe_and_nothing_is_wrong_three_times_an_hour():
    bench = Bench("hold")
    bench.guard.watches[0].ends_itself = True
    bench.actuator.failure = "no answer"
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(30)
    assert bench.guard.held is not None  # not confirmed safe
    bench.actuator.failure = ""
    await bench.run_for(60)
    assert bench.log == ["hold rule0", "revoke", "safe", "safe", "release"]
    for _ in range(3):
        bench.objecting = {0}
        await bench.run_for(2)
        bench.objecting = set()
        await bench.run_for(2)
    assert bench.log.count("release") == 3
    assert bench.guard.held is not None
    assert bench.events[-1].kind == "hold_stays"
    assert bench.events[-1].text == bench.guard.held.text
    assert bench.guard.held.text.startswith("it is so; this has held the stand more than 3 times in an hour")
    await bench.run_for(7200)
    assert bench.log.count("release") == 3
    bench.guard.clear()
    assert bench.guard.held is None


async def test_a_hold_for_the_disk_ends_with_the_recording_and_is_not_reported_as_over():
    bench = Bench("hold")
    bench.guard.recording_ended()  # nothing is held
    bench.guard.held = Fault("not_recorded", "3 s are not on the disk", "hold")
    bench.guard.recording_ended()
    assert bench.guard.held is not None  # for an operator
    bench.guard.held = replace(bench.guard.held, ends_itself=True)
    bench.guard.recording_ended()
    assert (bench.guard.held, bench.log) == (None, ["release"])
    (ended,) = bench.events
    assert ended.kind == "hold_ended"
    assert ended.text.startswith("the recording ended while the disk held it up; nothing is heated before")


async def test_a_fault_that_needs_an_operator_replaces_a_hold_that_would_end_by_itself():
    bench = Bench("hold", "hold")
    bench.guard.watches[0].ends_itself = True
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = {1}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.guard.held == Fault("rule1", "it is so", "hold")


async def test_only_an_operator_clears_a_hold_and_what_is_still_wrong_trips_again():
    bench = Bench("hold")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.guard.held is not None
    assert not bench.guard.may_permit()
    assert bench.log == ["hold rule0", "revoke", "safe"]
    assert bench.guard.clear() == Fault("rule0", "it is so", "hold")
    await bench.run_for(1)
    assert bench.guard.may_permit()
    bench.objecting = {0}
    await bench.run_for(2)
    bench.guard.clear()
    await bench.run_for(2)
    assert bench.log == ["hold rule0", "revoke", "safe"] * 3
    assert [event.kind for event in bench.events] == ["guard.rule0"] * 3


async def test_clearing_restarts_the_grace_time_of_every_rule():
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
    assert bench.log == ["hold rule0", "revoke", "safe", "stop rule1", "revoke", "safe"]


async def test_a_guard_that_keeps_on_looks_after_an_abort_which_stays_until_it_is_cleared():
    bench = Bench("hold", "abort")
    bench.guard.keeps_on = True
    bench.objecting = {1}
    assert await bench.run_for(5)
    assert bench.log == ["stop rule1", "revoke", "safe"]  # once, though it still objects
    bench.objecting = {0, 1}
    assert await bench.run_for(2)
    assert bench.log == ["stop rule1", "revoke", "safe"]
    assert not bench.guard.may_permit()
    assert bench.guard.is_on_time
    bench.guard.clear()
    assert bench.guard.held == Fault("rule0", "it is so", "hold")  # still wrong: held again, before anything moves
    bench.objecting = set()
    bench.guard.clear()
    assert await bench.run_for(2)
    assert bench.guard.may_permit()


async def test_without_a_way_to_hold_every_trip_aborts():
    bench = Bench("hold", can_hold=False)
    bench.objecting = {0}
    assert not await bench.run_for(2)
    assert bench.log == ["stop rule0", "revoke", "safe"]


async def test_a_warning_is_reported_when_it_begins_and_changes_nothing():
    bench = Bench("warn")
    for objecting in ({0}, {0}, set[int](), {0}):
        bench.objecting = objecting
        assert bench.guard.look()
    assert bench.log == []
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "guard.rule0")] * 2


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
    assert reported.read_text() == f"it is so; NOT SAFE: {unsafe}"
    await bench.safety.close()


async def test_a_command_that_hangs_is_killed_and_an_event_while_the_hold_stands(script: Callable[[str], str]):
    bench = Bench("hold", command=(script("exec sleep 600"),), limit_s=0.2)
    bench.objecting = {0}
    assert await bench.run_for(20)
    assert bench.guard.held is not None
    assert [event.kind for event in bench.events] == ["guard.rule0", "notify_failed"]
    assert bench.events[1].text.endswith("notify did not end within 0.2 s")


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
