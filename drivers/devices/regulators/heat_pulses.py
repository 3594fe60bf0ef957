"""Heat by time proportioning: in each cycle a relay, or the SSR behind it, is on for the output's share of it.

Every pulse is a timed-on of the relay board, so that the board itself ends it: whatever stops this program ends the
heat within one cycle. The heater's enable relay in series has a time limit of its own besides.
"""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.protocols import Switches
from thermostand.drivers.devices.relays import HEAT
from thermostand.foundation.clock import NS_PER_S, Now, to_ns
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import DeviceFault, Refused

_OVERLAP_S = 2.0  # that a full output is held beyond its cycle: the next pulse may come late
_TOLERANCE_S = 1.0  # of the board's timer against our clock, and of a reply that was late
_STEP_S = 0.1  # of pulses


class PulsesSettings(Document):
    """A mechanical relay lives for some 100,000 cycles: give it a cycle_s of 60 or more, an SSR one of seconds. A pulse
    shorter than min_on_s, or a pause shorter than min_off_s, is left out and made up for in the cycles after it."""

    cycle_s: float = Field(default=10.0, ge=2, le=120)
    min_on_s: float = Field(default=0.3, ge=0.1, le=60)
    min_off_s: float = Field(default=0.3, ge=0.1, le=60)

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if self.min_on_s + self.min_off_s > self.cycle_s / 2:
            raise ValueError("min_on_s and min_off_s together take more than half of cycle_s; take a longer cycle")
        return self


def compute_pulse_s(percent: float, carry_s: float, settings: PulsesSettings) -> tuple[float, float]:
    """How long the relay is on in the coming cycle (cycle_s: all of it), and what remains to be given (s, less than 0
    when too much was given): what was rounded, or left out, of the output's share."""
    wanted_s = percent / 100 * settings.cycle_s + carry_s
    given_s = round(min(settings.cycle_s, max(0.0, wanted_s)) / _STEP_S) * _STEP_S
    if given_s < settings.min_on_s:
        given_s = 0.0
    elif given_s > settings.cycle_s - settings.min_off_s:
        given_s = settings.cycle_s
    most_s = max(settings.min_on_s, settings.min_off_s)
    return given_s, min(most_s, max(-most_s, wanted_s - given_s))


class HeatPulses:
    """The relay `heat` of the board. What it reads before each pulse is compared with what the last one left.
    uncontrolled: as of HeatOutput."""

    identity = None  # the board has one

    def __init__(self, board: Switches, settings: PulsesSettings, clock: Now) -> None:
        self._board = board
        self._settings = settings
        self._clock = clock
        self._carry_s = 0.0
        self._due_ns = 0
        self._until_ns = 0  # when the relay drops by itself
        self._is_compared = False  # whether what it is left as is known
        self.uncontrolled = ""

    async def open(self) -> None:
        """The board is opened by itself."""

    async def arm(self) -> None:
        """Each pulse ends by itself."""

    async def test_dead_man(self) -> None:
        """The board's timer is tested with the relay `heater_enable`, which is on the same board."""

    async def give(self, percent: float, *, at_once: bool = False) -> None:
        """The output from now on: of the next cycle, or at_once, with a cycle that begins now. DeviceFault when the
        relay is not as the last pulse left it; it is off then."""
        now_ns = self._clock.now_ns()
        if not at_once and now_ns < self._due_ns:
            return
        cycle_ns = to_ns(self._settings.cycle_s)
        late = at_once or now_ns - self._due_ns > cycle_ns
        self._due_ns = (now_ns if late else self._due_ns) + cycle_ns
        await self._compare(now_ns)
        on_s, self._carry_s = compute_pulse_s(percent, self._carry_s, self._settings) if percent > 0 else (0.0, 0.0)
        if on_s <= 0:
            if now_ns < self._until_ns:
                await self._off()
            return
        hold_s = on_s + (_OVERLAP_S if on_s >= self._settings.cycle_s else 0.0)
        self._is_compared = False  # until the command is confirmed
        await self._board.hold_on(HEAT, hold_s)
        self._until_ns, self._is_compared = self._clock.now_ns() + to_ns(hold_s), True

    async def off(self) -> None:
        """No heat, confirmed; DeviceError."""
        self._due_ns, self._carry_s = 0, 0.0
        await self._off()

    async def _off(self) -> None:
        try:
            await self._switch_off()
        except DeviceFault as error:
            self.uncontrolled = error.text
            raise
        self._until_ns, self._is_compared, self.uncontrolled = 0, True, ""

    async def _switch_off(self) -> None:
        """Switch off, with a second try for a relay that reads on; DeviceFault when it stays so."""
        try:
            await self._board.switch(HEAT, on=False)
        except Refused:
            try:
                await self._board.switch(HEAT, on=False)
            except Refused as error:
                raise DeviceFault(f"{self._board.name}.{HEAT}", f"stays on: {error.text}") from error

    async def _compare(self, now_ns: int) -> None:
        """Compare the relay with its command, but not within the tolerance of the instant at which it drops, and not
        while its last command is unconfirmed."""
        left_s = (self._until_ns - now_ns) / NS_PER_S
        if not self._is_compared or (self._until_ns and abs(left_s) < _TOLERANCE_S):
            return
        readings = {reading.channel.partition(".")[2]: reading.value for reading in await self._board.read()}
        is_on, name = readings.get(HEAT) == 1, f"{self._board.name}.{HEAT}"
        if is_on == (left_s > 0):
            return
        await self._off()
        if is_on:
            raise DeviceFault(name, f"was on {-left_s:.1f} s after its time" if left_s > -1e6 else "was on unasked")
        raise DeviceFault(name, f"was off {left_s:.1f} s before its time: something else switched it")
