"""Heat by time proportioning: its mean is the output, no pulse or pause is too short, the relay is compared."""

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.drivers.devices.regulators.software_regulator import HeatPulses, PulsesSettings, compute_pulse_s
from thermostand.foundation.clock import FollowedClock, to_ns
from thermostand.foundation.errors import DeviceFault, Refused
from thermostand.foundation.readings import Reading

SETTINGS = PulsesSettings(cycle_s=20, min_on_s=1, min_off_s=2)


@given(percent=st.floats(0.1, 100))
def test_over_many_cycles_the_heat_is_the_output(percent: float):
    carried_s, given_s, cycles = 0.0, 0.0, 400
    for _ in range(cycles):
        on_s, carried_s = compute_pulse_s(percent, carried_s, SETTINGS)
        assert on_s == 0 or SETTINGS.min_on_s <= on_s <= SETTINGS.cycle_s - SETTINGS.min_off_s or on_s == 20
        given_s += on_s
    assert abs(given_s / (cycles * SETTINGS.cycle_s) - percent / 100) < 0.001


@dataclass
class Board:
    """Relays that drop by themselves; `forced` is what another master makes the heat's relay be."""

    clock: FollowedClock
    name: str = "relays"
    has_timer: bool = True
    identity: None = None
    until_ns: int = 0
    forced: bool | None = None
    sent: list[float] = field(default_factory=list[float])

    async def open(self) -> None: ...
    async def close(self) -> None: ...
    async def make_safe(self) -> None: ...

    async def read(self) -> tuple[Reading, ...]:
        now_ns = self.clock.now_ns()
        is_on = now_ns < self.until_ns if self.forced is None else self.forced
        return (Reading("relays.heat", float(is_on), "1", now_ns),)

    async def switch(self, channel: str, on: bool) -> None:
        self.sent.append(0.0)
        self.until_ns, self.forced = 0, None

    async def hold_on(self, channel: str, duration_s: float) -> None:
        self.sent.append(round(duration_s, 3))
        self.until_ns = self.clock.now_ns() + to_ns(duration_s)


async def pulses(*percents: float, every_s: float = 20.0) -> list[float]:
    clock = FollowedClock(0)
    board = Board(clock)
    heat = HeatPulses(board, SETTINGS, clock)
    for number, percent in enumerate(percents):
        clock.follow(to_ns(number * every_s))
        await heat.give(percent)
    return board.sent


async def test_a_full_output_is_held_beyond_its_cycle_and_cut_when_nothing_is_wanted():
    assert await pulses(100, 100, 50, 100, 0, 0) == [22, 22, 10, 22, 0]


async def test_between_the_begins_of_cycles_nothing_is_sent():
    assert await pulses(50, 80, 80, 80, 25, every_s=5.0) == [10, 5]


async def test_no_pulse_time_is_carried_over_once_no_heat_is_wanted():
    """A pulse without a wish for it would be heat without permission."""
    assert await pulses(4, 0, 0) == []


async def test_a_pulse_at_once_begins_a_cycle():
    clock = FollowedClock(0)
    board = Board(clock)
    heat = HeatPulses(board, SETTINGS, clock)
    await heat.give(50)
    clock.follow(to_ns(3))
    await heat.give(0, at_once=True)
    clock.follow(to_ns(7))
    await heat.give(40, at_once=True)
    assert board.sent == [10, 0, 8]


@pytest.mark.parametrize(
    ("percent", "forced", "text"),
    [(50, True, "was on 10.0 s after its time"), (100, False, "was off 2.0 s before its time")],
)
async def test_a_relay_that_is_not_as_it_was_left_is_switched_off_and_reported(percent: float, forced: bool, text: str):
    clock = FollowedClock(0)
    board = Board(clock)
    heat = HeatPulses(board, SETTINGS, clock)
    await heat.give(percent)
    board.forced = forced
    clock.follow(to_ns(20))
    with pytest.raises(DeviceFault, match=text):
        await heat.give(percent)
    assert board.sent[-1] == 0
    clock.follow(to_ns(40))
    await heat.give(percent)
    assert board.sent[-1] > 0


def test_pulses_and_pauses_that_fill_the_cycle_are_refused():
    with pytest.raises(ValueError, match="half of cycle_s"):
        PulsesSettings(cycle_s=10, min_on_s=3, min_off_s=3)


async def test_a_relay_that_stays_on_is_reported_as_not_obeying_until_it_is_off():
    class Stuck(Board):
        is_stuck: bool = True

        async def switch(self, channel: str, on: bool) -> None:
            if self.is_stuck:
                raise Refused(self.name, "heat off was acknowledged but reads back otherwise")
            await super().switch(channel, on)

    board = Stuck(FollowedClock(0))
    heat = HeatPulses(board, SETTINGS, board.clock)
    await heat.give(50)
    assert heat.uncontrolled == ""
    with pytest.raises(DeviceFault, match="stays on"):
        await heat.off()
    assert "reads back otherwise" in heat.uncontrolled
    board.is_stuck = False
    await heat.off()
    assert heat.uncontrolled == ""
