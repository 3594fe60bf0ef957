"""The one owner of making safe, with actuators that do not answer, hang or are commanded meanwhile."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from thermostand.foundation.clock import VirtualClock, to_ns
from thermostand.foundation.errors import DeviceFault, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.safety.making_safe import TRY_LIMIT_S, Pending, Safety


class Actuator:
    """Confirms after `takes_s`, when it has no `failure`; `calls` are the instants (s) at which each call began."""

    def __init__(self, name: str, clock: VirtualClock, takes_s: float = 0.0) -> None:
        self.name = name
        self.failure: Exception | None = None
        self.takes_s = takes_s
        self.calls: list[float] = []
        self._clock = clock

    async def make_safe(self) -> None:
        self.calls.append(self._clock.now_ns() / 1e9)
        await self._clock.sleep_until(self._clock.now_ns() + to_ns(self.takes_s))
        if self.failure is not None:
            raise self.failure


class Bench:
    def __init__(self) -> None:
        self.clock, hub = VirtualClock(0), Hub()
        self.events: list[Event] = []
        self.revoked = 0
        hub.subscribe(lambda item: self.events.append(item) if isinstance(item, Event) else None)
        self.safety = Safety(self._revoke, hub, self.clock)
        self.relays, self.flap = Actuator("relays", self.clock), Actuator("flap", self.clock)
        self.safety.take(self.relays)
        self.safety.take(self.flap, 60.0)

    def _revoke(self) -> None:
        self.revoked += 1

    async def wait(self, duration_s: float) -> None:
        await self.clock.sleep_until(self.clock.now_ns() + to_ns(duration_s))

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


@asynccontextmanager
async def running() -> AsyncIterator[Bench]:
    bench = Bench()
    time = asyncio.create_task(bench.clock.run())
    try:
        yield bench
    finally:
        await bench.safety.close()
        time.cancel()
        await asyncio.gather(time, return_exceptions=True)


async def test_permissions_are_gone_when_the_demand_returns_and_every_actuator_is_made_safe():
    async with running() as bench:
        bench.safety.demand()
        assert bench.revoked == 1
        assert await bench.safety.wait_until_confirmed(10.0)
        assert (bench.relays.calls, bench.flap.calls) == ([0.0], [0.0])
        assert bench.kinds() == []


async def test_a_link_that_is_gone_is_tried_until_it_is_back_and_reported_at_growing_intervals():
    async with running() as bench:
        bench.relays.failure = Unreachable("relays", "no answer")
        bench.safety.demand()
        confirming = asyncio.create_task(bench.safety.wait_until_confirmed(600.0))
        await bench.wait(200.0)
        assert not confirming.done()
        assert len(bench.relays.calls) >= 190  # about once a second, each a call and another one at once
        assert bench.flap.calls == [0.0]
        assert bench.kinds() == ["not_confirmed_safe"] * 3  # the reason at once, then after one and three minutes
        assert bench.events[1].text.startswith("still trying: relays")
        bench.relays.failure = None
        assert await confirming
        assert bench.clock.now_ns() < to_ns(203.0)
        assert bench.kinds()[-1] == "confirmed_safe"
        assert bench.safety.unconfirmed == ()


async def test_what_is_not_confirmed_is_known_with_since_when_until_it_is():
    async with running() as bench:
        bench.relays.failure = Unreachable("relays", "no answer")
        bench.flap.takes_s = 5.0
        await bench.wait(1.0)
        assert bench.safety.pending == ()
        bench.safety.demand()
        assert bench.safety.pending == tuple(Pending(name, to_ns(1.0), "") for name in ("relays", "flap"))
        await bench.wait(3.0)
        bench.safety.demand()  # once more: it is not safe since the first time
        (relays, flap), failure = bench.safety.pending, "relays did not confirm its safe state: relays: no answer"
        assert relays == Pending("relays", to_ns(1.0), failure)
        assert flap.failure == ""
        await bench.wait(8.0)
        assert bench.safety.pending == (relays,)
        bench.relays.failure = None
        await bench.wait(3.0)
        assert bench.safety.pending == ()
        bench.safety.demand()
        assert bench.safety.pending[0] == Pending("relays", bench.clock.now_ns(), "")


async def test_the_wait_ends_after_its_limit_and_says_what_is_not_safe():
    async with running() as bench:
        bench.relays.failure = Unreachable("relays", "no answer")
        bench.safety.demand()
        assert not await bench.safety.wait_until_confirmed(600.0)
        assert bench.clock.now_ns() >= to_ns(600.0)
        (unconfirmed,) = bench.safety.unconfirmed
    assert unconfirmed.endswith(": relays: no answer")


async def test_a_second_signal_ends_the_wait_from_a_minute_on():
    async with running() as bench:
        await bench.wait(500.0)
        bench.relays.failure = Unreachable("relays", "no answer")
        bench.safety.demand()
        confirming = asyncio.create_task(bench.safety.wait_until_confirmed(600.0))
        await bench.wait(59.0)
        assert not bench.safety.give_up()
        await bench.wait(2.0)
        assert not confirming.done()
        assert bench.safety.give_up()
        assert not await confirming
        assert bench.clock.now_ns() < to_ns(563.0)


async def test_a_demand_is_met_by_a_call_that_begins_after_it():
    """What a verb has commanded while the first call was under way is undone by the second."""
    async with running() as bench:
        bench.flap.takes_s = 5.0
        bench.safety.demand()
        await bench.wait(2.0)
        bench.safety.demand()
        assert await bench.safety.wait_until_confirmed(60.0)
        assert bench.flap.calls == [0.0, 5.0]


async def test_two_demands_at_once_are_one():
    async with running() as bench:
        bench.safety.demand()
        bench.safety.demand()
        assert await bench.safety.wait_until_confirmed(60.0)
        assert bench.flap.calls == [0.0]


def test_a_try_that_hangs_is_given_up_before_the_relays_own_time_is_over():
    assert load_config(find_packaged("", "simulated")).guard.heater_hold_s > TRY_LIMIT_S


async def test_one_that_is_slow_keeps_none_of_the_others():
    async with running() as bench:
        bench.flap.takes_s = 8.0
        bench.safety.demand()
        await bench.wait(0.5)
        assert not bench.safety.is_confirmed
        assert bench.relays.calls == [0.0]
        await bench.safety.wait_until_tried()
        assert bench.clock.now_ns() >= to_ns(8.0)


async def test_a_jammed_flap_is_tried_once_a_minute():
    async with running() as bench:
        bench.flap.failure = DeviceFault("flap", "jammed")
        bench.safety.demand()
        await bench.wait(130.0)
        assert bench.flap.calls == [0.0, 60.0, 120.0]


async def test_what_an_operator_has_cleared_is_tried_no_more_until_it_is_demanded_again():
    async with running() as bench:
        bench.flap.failure = DeviceFault("flap", "jammed")
        bench.safety.demand()
        await bench.wait(10.0)
        bench.safety.cancel_pending()
        assert bench.safety.is_confirmed
        await bench.wait(200.0)
        assert bench.flap.calls == [0.0]
        bench.flap.failure = None
        bench.safety.demand()
        assert await bench.safety.wait_until_confirmed(10.0)
        assert bench.flap.calls == [0.0, 210.0]
