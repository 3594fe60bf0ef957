"""Relays that are held for some seconds at a time by a board in memory, which others switch and which fails, and who
renews that; time is virtual."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

import pytest

from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.errors import DeviceError, DeviceFault, GarbledReply, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Reading
from thermostand.foundation.tasks import cancel_all
from thermostand.stand.chamber.chamber import PermitRenewer
from thermostand.stand.chamber.compressor import CompressorState
from thermostand.stand.chamber.permits import COMPRESSOR, HEATER, Permission, PermitLimits, Permits
from thermostand.stand.config.stand_config import CompressorConfig

HOLD_S, TEST_S = 15.0, 3.0
LIMITS = CompressorConfig(min_off_s=300.0, min_on_s=180.0, start_above_cool_percent=20.0)
COLD, WARM = (0.0, 50.0), (80.0, 0.0)  # outputs of a regulator that wants cold, and one that heats hard


class Board:
    """Drops what it holds when its time is over; `jammed`: takes commands and does nothing."""

    name = "relays"
    has_timer = True

    def __init__(self, clock: VirtualClock) -> None:
        self.until_ns: dict[str, float] = {}
        self.failure: Exception | None = None
        self.is_jammed = False
        self.switched: list[tuple[str, bool]] = []
        self._clock = clock

    def is_on(self, channel: str) -> bool:
        return self.until_ns.get(channel, 0) > self._clock.now_ns()

    def others_switch(self, channel: str, on: bool) -> None:
        self.until_ns[channel] = math.inf if on else 0

    async def read(self) -> tuple[Reading, ...]:
        now_ns = self._clock.now_ns()
        return tuple(Reading(f"relays.{name}", float(self.is_on(name)), "1", now_ns) for name in (HEATER, COMPRESSOR))

    async def hold_on(self, channel: str, duration_s: float) -> None:
        if not self.is_jammed:
            self.until_ns[channel] = self._clock.now_ns() + duration_s * 1e9
        if self.failure is not None:
            raise self.failure

    async def switch(self, channel: str, on: bool) -> None:
        self.switched.append((channel, on))
        self.others_switch(channel, on)

    async def make_safe(self) -> None:
        if self.failure is not None:
            raise self.failure
        self.until_ns.clear()


class Bench:
    """A compressor that has rested, unless `compressor` says something else. kept: what was to be remembered of it."""

    def __init__(self, compressor: CompressorState | None) -> None:
        self.clock, hub = VirtualClock(to_ns(1000)), Hub()
        self.board = Board(self.clock)
        self.kept: list[CompressorState] = []
        self.events: list[Event] = []
        hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        limits = PermitLimits(HOLD_S, TEST_S, LIMITS)
        state = compressor or CompressorState(False, 0)
        relays: Any = self.board
        self.permits = Permits(relays, limits, state, self.kept.append, hub, self.clock)

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns()

    async def wait(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))

    async def keep(self, duration_s: float, outputs: tuple[float, float] = (0.0, 0.0)) -> None:
        """Renew each 5 s, for so long."""
        for _ in range(round(duration_s / 5.0)):
            await self.permits.arm(*outputs)
            await self.wait(5.0)

    def reported(self) -> list[tuple[str, object]]:
        """Kinds of events since the last call, and the relay of each."""
        reported = [(event.kind, event.data.get("relay", event.data.get("running"))) for event in self.events]
        self.events.clear()
        return reported


@asynccontextmanager
async def benches(compressor: CompressorState | None = None) -> AsyncIterator[Bench]:
    bench = Bench(compressor)
    time = asyncio.create_task(bench.clock.run())
    try:
        yield bench
    finally:
        time.cancel()
        await asyncio.gather(time, return_exceptions=True)


async def test_heat_lasts_as_long_as_it_is_renewed_and_its_timer_longer():
    async with benches() as bench:
        permits, board = bench.permits, bench.board
        assert await permits.arm(0.0, 0.0) == {HEATER: False, COMPRESSOR: False}
        assert not board.is_on(HEATER)  # nothing is permitted yet
        permits.grant()
        await bench.keep(60.0)
        assert (board.is_on(HEATER), permits.may_heat, permits.timer_s, permits.ended_ns) == (True, True, HOLD_S, None)
        renewed_ns = bench.now_ns - to_ns(5.0)
        await bench.wait(HOLD_S - 5.0)
        assert not board.is_on(HEATER)
        assert permits.ended_ns == bench.now_ns
        await bench.wait(60.0)
        assert permits.ended_ns == renewed_ns + to_ns(HOLD_S)
        assert await permits.arm(0.0, 0.0) == {HEATER: False, COMPRESSOR: False}
        assert (board.is_on(HEATER), permits.ended_ns) == (True, None)
        await bench.wait(60.0)
        permits.revoke()
        assert permits.ended_ns is None  # heat was not to last
        assert bench.reported() == []


async def test_relays_without_a_timer_end_nothing():
    async with benches() as bench:
        bench.board.has_timer = False
        bench.permits.grant()
        await bench.permits.arm(0.0, 0.0)
        await bench.wait(60.0)
        assert (bench.permits.timer_s, bench.permits.ended_ns) == (None, None)


async def test_while_the_guard_finds_something_nothing_is_renewed():
    async with benches() as bench:
        bench.permits.grant()
        bench.permits.is_allowed = lambda: False
        await bench.keep(20.0, COLD)
        assert bench.permits.is_granted
        assert not bench.permits.may_heat
        assert not bench.board.until_ns
        assert bench.kept == []


@pytest.mark.parametrize(("left_s", "reported"), [(9.0, [("heater_enable_dropped", HEATER)]), (0.5, [])])
async def test_a_relay_that_is_off_before_its_time_was_dropped_unless_its_time_is_all_but_over(
    left_s: float, reported: list[tuple[str, str]]
):
    async with benches() as bench:
        bench.permits.grant()
        await bench.keep(10.0)
        await bench.permits.arm(0.0, 0.0)
        await bench.wait(HOLD_S - left_s)
        bench.board.others_switch(HEATER, False)
        await bench.keep(30.0)
        assert not any("compressor" in event.text for event in bench.events)
        assert all(f"off {left_s:.1f} s before its time" in event.text for event in bench.events)
        assert bench.reported() == reported
        assert bench.board.is_on(HEATER)


async def test_a_relay_that_never_comes_on_is_reported_each_time_also_after_it_was_on():
    async with benches() as bench:
        bench.permits.grant()
        await bench.keep(10.0)
        bench.board.is_jammed = True
        bench.board.others_switch(HEATER, False)
        await bench.keep(15.0)
        assert bench.reported() == [("heater_enable_dropped", HEATER), *[("heater_enable_not_on", HEATER)] * 2]


async def test_the_compressor_is_remembered_before_it_runs_and_when_it_has_stopped():
    async with benches() as bench:
        bench.permits.grant()
        begun_ns = bench.now_ns
        await bench.keep(200.0, COLD)
        assert bench.board.is_on(COMPRESSOR)
        assert bench.kept == [CompressorState(True, begun_ns, (begun_ns,))]
        assert bench.reported() == [("compressor", True)]
        await bench.keep(5.0, WARM)
        ended_ns = bench.now_ns - to_ns(5.0)
        assert not bench.board.is_on(COMPRESSOR)
        assert bench.board.switched == [(COMPRESSOR, False)]
        assert bench.kept[1:] == [CompressorState(False, ended_ns, (begun_ns,))]
        await bench.keep(30.0)
        assert bench.reported() == [("compressor", False)]  # and nothing has dropped


async def test_a_start_that_is_not_confirmed_counts_and_a_relay_that_then_drops_is_a_stop():
    async with benches() as bench:
        bench.permits.grant()
        await bench.keep(5.0)

        async def fails_for_the_compressor(channel: str, duration_s: float) -> None:
            bench.board.until_ns[channel] = bench.now_ns + duration_s * 1e9
            if channel == COMPRESSOR:
                raise Unreachable("relays", "its answer was lost")

        bench.board.hold_on = fails_for_the_compressor
        begun_ns = bench.now_ns
        with pytest.raises(Unreachable):
            await bench.permits.arm(*COLD)
        assert bench.kept == [CompressorState(True, begun_ns, (begun_ns,))]
        await bench.wait(60.0)
        await bench.permits.arm(0.0, 0.0)
        assert bench.kept[1:] == [CompressorState(False, begun_ns + to_ns(HOLD_S), (begun_ns,))]
        assert bench.reported() == []


async def test_a_compressor_that_was_dropped_before_its_time_rests_from_then_on():
    async with benches() as bench:
        bench.permits.grant()
        begun_ns = bench.now_ns
        await bench.keep(60.0, COLD)
        bench.board.others_switch(COMPRESSOR, False)
        dropped_ns = bench.now_ns
        await bench.keep(300.0, COLD)
        assert bench.kept[1:] == [CompressorState(False, dropped_ns, (begun_ns,))]
        assert "counts as a stop" in bench.events[1].text
        assert bench.reported() == [("compressor", True), ("compressor_dropped", COMPRESSOR)]
        await bench.keep(5.0, COLD)
        assert bench.board.is_on(COMPRESSOR)


async def test_what_others_switch_on_while_heat_is_permitted_is_off_again_and_counts_as_a_start():
    async with benches() as bench:
        bench.permits.grant()
        await bench.keep(5.0)
        bench.board.others_switch(COMPRESSOR, True)
        on_ns = bench.now_ns
        await bench.permits.arm(0.0, 0.0)
        assert not bench.board.is_on(COMPRESSOR)
        assert bench.board.is_on(HEATER)
        assert bench.kept == [CompressorState(False, on_ns, (on_ns,))]
        assert bench.reported() == [("switched_off", COMPRESSOR)]
        assert bench.permits.intrusions == 1
        bench.permits.clear_intrusions()
        assert bench.permits.intrusions == 0


async def test_without_permission_what_reads_on_is_switched_off_once_it_was_confirmed_off():
    async with benches() as bench:
        permits, board = bench.permits, bench.board
        board.others_switch(HEATER, True)
        assert await permits.supervise() == {HEATER: True, COMPRESSOR: False}
        assert board.is_on(HEATER)  # making safe is under way
        board.failure = DeviceFault("relays", "no answer")
        with pytest.raises(DeviceFault):
            await permits.make_safe()
        assert permits.permission is Permission.REVOKED
        board.failure = None
        await permits.make_safe()
        assert permits.permission is Permission.WITHDRAWN
        await permits.supervise()
        assert (board.switched, bench.reported()) == ([], [])
        for channel in (HEATER, COMPRESSOR):
            board.others_switch(channel, True)
        on_ns = bench.now_ns
        assert await permits.supervise() == {HEATER: True, COMPRESSOR: True}
        assert board.switched == [(HEATER, False), (COMPRESSOR, False)]
        assert bench.reported() == [("switched_off", HEATER), ("switched_off", COMPRESSOR)]
        assert bench.kept == [CompressorState(False, on_ns, (on_ns,))]
        assert permits.intrusions == 2
        permits.grant()
        assert permits.intrusions == 0


async def test_a_compressor_that_is_made_safe_has_stopped_and_its_relay_was_not_dropped():
    async with benches() as bench:
        bench.permits.grant()
        begun_ns = bench.now_ns
        await bench.keep(60.0, COLD)
        await bench.permits.make_safe()
        stopped = CompressorState(False, bench.now_ns, (begun_ns,))
        assert bench.kept[1:] == [stopped]
        bench.permits.grant()
        await bench.keep(20.0)
        assert bench.reported() == [("compressor", True)]
        assert bench.kept[2:] == []


async def test_what_was_left_on_is_reported_relay_by_relay_and_a_compressor_rests_from_now_on():
    start_ns = to_ns(500)
    async with benches(CompressorState(False, 0, (start_ns,))) as bench:
        for channel in (HEATER, COMPRESSOR):
            bench.board.others_switch(channel, True)
        await bench.wait(10.0)
        await bench.permits.switch_off_left_on()
        assert bench.reported() == [("left_on", COMPRESSOR), ("left_on", HEATER)]
        assert bench.kept == [CompressorState(False, bench.now_ns, (start_ns,))]
        assert bench.permits.permission is Permission.WITHDRAWN
        await bench.permits.switch_off_left_on()
        assert (bench.reported(), bench.kept[1:]) == ([], [])


@pytest.mark.parametrize("is_timed", [False, True])
async def test_a_board_that_drops_in_time_is_suited_and_its_time_is_measured_where_that_is_asked_for(is_timed: bool):
    async with benches() as bench:
        begin_ns = bench.now_ns
        await bench.permits.test_dead_man(is_timed=is_timed)
        (found,) = bench.events
        assert (found.level, found.kind) == ("info", "dead_man_tested")
        held_s = found.data.get("held_s")
        assert found.data == {"device": "relays", "rearmed": True, "dropped": True, "pulse_s": TEST_S} | (
            {"held_s": held_s} if is_timed else {}
        )
        if is_timed:
            assert isinstance(held_s, float)
            assert TEST_S <= held_s <= TEST_S + 0.06
            assert held_s == round(held_s, 2)
        assert bench.board.switched == [(HEATER, False)]
        assert bench.now_ns - begin_ns == to_ns(6.5)


@pytest.mark.parametrize(("lasts", "rearmed", "dropped"), [(True, True, False), (False, False, True)])
async def test_a_board_that_never_drops_or_does_not_begin_its_time_again_is_reported_and_not_trusted(
    lasts: bool, rearmed: bool, dropped: bool
):
    async with benches() as bench:
        hold_on = bench.board.hold_on

        async def held(channel: str, duration_s: float) -> None:
            if not bench.board.is_on(channel):
                await hold_on(channel, math.inf if lasts else duration_s)

        bench.board.hold_on = held
        with pytest.raises(DeviceFault, match="is not suited"):
            await bench.permits.test_dead_man(is_timed=False)
        (found,) = bench.events
        assert (found.level, found.kind) == ("error", "dead_man_tested")
        assert (found.data["rearmed"], found.data["dropped"]) == (rearmed, dropped)
        assert not bench.board.is_on(HEATER)


async def test_a_computer_that_is_held_up_in_each_test_of_the_timer_says_so_and_trusts_no_board():
    async with benches() as bench:
        hold_on = bench.board.hold_on

        async def late(channel: str, duration_s: float) -> None:
            await bench.wait(2.0)
            await hold_on(channel, duration_s)

        bench.board.hold_on = late
        with pytest.raises(DeviceFault, match="held up in each"):
            await bench.permits.test_dead_man(is_timed=False)
        assert [(event.kind, event.data["test"]) for event in bench.events] == [
            ("dead_man_late", number) for number in range(1, 6)
        ]


class Regulator:
    """Gives what `values` says; safe_at_s: when it was made safe."""

    name = "regulator"

    def __init__(self, clock: VirtualClock) -> None:
        self.values = {"running": 0.0, "mv_heat": 0.0, "mv_cool": 0.0}
        self.safe_at_s: list[float] = []
        self.reads = 0
        self._clock = clock

    async def read(self) -> tuple[Reading, ...]:
        self.reads += 1
        now_ns = self._clock.now_ns()
        return tuple(Reading(f"{self.name}.{name}", value, "1", now_ns) for name, value in self.values.items())

    async def make_safe(self) -> None:
        self.safe_at_s.append(self._clock.now_ns() / 1e9)
        self.values = dict.fromkeys(self.values, 0.0)


class Kept(Bench):
    """With a regulator and a keeper that renews each 5 s; seen: what it said of the coils, and when (s)."""

    def __init__(self) -> None:
        super().__init__(None)
        self.regulator: Any = Regulator(self.clock)
        self.seen: list[tuple[float, Mapping[str, bool]]] = []
        hub = Hub()
        hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        self.keeper = PermitRenewer(self.permits, self.regulator, hub, self.clock, 5.0, self._see)

    def _see(self, coils: Mapping[str, bool]) -> None:
        self.seen.append((self.clock.now_ns() / 1e9, coils))

    async def run(self, duration_s: float) -> None:
        keeping = asyncio.create_task(self.keeper.run())
        await self.wait(duration_s)
        await cancel_all([keeping])


@asynccontextmanager
async def keepers() -> AsyncIterator[Kept]:
    kept = Kept()
    time = asyncio.create_task(kept.clock.run())
    try:
        yield kept
    finally:
        time.cancel()
        await asyncio.gather(time, return_exceptions=True)


async def test_permits_are_renewed_each_5_s_and_looked_at_each_2_5_s_once_they_are_withdrawn():
    async with keepers() as kept:
        kept.permits.grant()
        await kept.run(12.0)
        assert kept.seen == [
            (1000.0, {HEATER: False, COMPRESSOR: False}),
            (1005.0, {HEATER: True, COMPRESSOR: False}),
            (1010.0, {HEATER: True, COMPRESSOR: False}),
        ]
        assert kept.regulator.reads == 0
        await kept.permits.make_safe()
        kept.seen.clear()
        await kept.run(6.0)
        assert [time_s for time_s, _ in kept.seen] == [1012.0, 1014.5, 1017.0]
        assert kept.regulator.reads == 3
        assert kept.reported() == []


@pytest.mark.parametrize("name", ["running", "mv_heat", "mv_cool"])
async def test_a_regulator_that_runs_or_heats_without_permission_is_stopped_and_reported(name: str):
    async with keepers() as kept:
        kept.regulator.values[name] = 1.0
        await kept.run(3.0)
        assert kept.regulator.reads == 0  # it may be being stopped by who has taken the permission back
        await kept.permits.make_safe()
        await kept.run(6.0)
        assert kept.regulator.safe_at_s == [1003.0]
        (event,) = kept.events
        assert (event.kind, event.data) == ("switched_off", {"device": "regulator", "times": 1})
        assert kept.permits.intrusions == 1


async def test_a_regulator_that_was_permitted_to_run_while_it_was_asked_is_left_alone():
    async with keepers() as kept:
        await kept.permits.make_safe()
        kept.regulator.values["running"] = 1.0
        read = kept.regulator.read

        async def slow() -> tuple[Reading, ...]:
            kept.permits.grant()
            return await read()

        kept.regulator.read = slow
        await kept.run(1.0)
        assert kept.regulator.safe_at_s == []
        assert kept.permits.intrusions == 0


async def test_what_keeps_permits_from_being_renewed_is_reported_when_it_begins_and_when_it_is_another():
    async with keepers() as kept:
        kept.permits.grant()
        failures: list[DeviceError | None] = [
            *[Unreachable("relays", f"no answer {number}") for number in range(3)],
            *[GarbledReply("relays", "noise")] * 2,
            GarbledReply("gateway", "noise"),
            None,
            GarbledReply("gateway", "noise"),
        ]
        keeping = asyncio.create_task(kept.keeper.run())
        reported: list[int] = []
        for failure in failures:
            kept.board.failure = failure
            await kept.wait(5.0)
            reported.append(len(kept.reported()))
        await cancel_all([keeping])
        assert reported == [1, 0, 0, 1, 0, 1, 0, 1]
