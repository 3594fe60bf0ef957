"""A regulator of our own, for a stand without a controller: the PID runs here, the heat goes out in pulses of a relay
or as a current.

What keeps it safe does not rely on it: each pulse ends by the relay board's own timer, a current by the module's own
watchdog, the enable relay in series is held by the guard's permission alone, and the compressor's keeper takes our
output as no more than a demand.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Literal, Self, cast

from pydantic import Field, model_validator

from thermostand.drivers.devices.device_check import DeviceCheck
from thermostand.drivers.devices.kinds import (
    CONTROL,
    CONTROLLED,
    Arguments,
    DeviceKind,
    DriverContext,
    ManualActions,
    Verb,
)
from thermostand.drivers.devices.protocols import HeatOutput, InForce, Switches
from thermostand.drivers.devices.regulators import pid, relay_tuning
from thermostand.drivers.devices.regulators.heat_module import HeatModule
from thermostand.drivers.devices.regulators.pid import Law
from thermostand.drivers.devices.regulators.relay_tuning import Tuning, TuningSettings, UltimatePoint
from thermostand.drivers.devices.relays import HEAT
from thermostand.drivers.settings import DeviceName, Identity, Polled
from thermostand.foundation.clock import NS_PER_S, Clock, Now, to_ns
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import DeviceError, DeviceFault, Occupied, Refused
from thermostand.foundation.events import AUTOTUNED
from thermostand.foundation.items import Item
from thermostand.foundation.readings import Channel, Quality, Reading, bad_reading
from thermostand.foundation.tasks import cancel_all, describe_failure

# Heat by time proportioning: in each cycle a relay, or the SSR behind it, is on for the output's share of it.
#
# Every pulse is a timed-on of the relay board, so that the board itself ends it: whatever stops this program ends the
# heat within one cycle. The heater's enable relay in series has a time limit of its own besides.

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
    """Return how long the relay is on in the coming cycle (cycle_s: all of it), and what remains to be given (s, less
    than 0 when too much was given): what was rounded, or left out, of the output's share."""
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
        """Stop all heat and confirm it; DeviceError when that fails."""
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


_REST_K, _REST_S = 0.5, 600.0  # how near, and for how long, the set-point is held before it is tuned about


class SoftwareRegulatorSettings(Polled):
    """Our own regulator. thermometer: the one whose temperature is controlled. sample_s: between its steps, of which
    each needs a new reading. law: `stand device regulator autotune` finds its constants."""

    kind: Literal["software"]
    thermometer: DeviceName = "air"
    sample_s: float = Field(default=2.0, ge=0.2, le=60)
    law: Law = Law()
    pulses: PulsesSettings = PulsesSettings()
    autotune: TuningSettings = TuningSettings()


class SoftwareRegulator:
    """The calls and channels of a regulator.

    measured: the latest reading of its thermometer. Without one that is GOOD and no older than stale_s, and while
    nothing is `permitted`, the output is 0 and the integral stays. publish: takes events.
    """

    def __init__(
        self,
        name: str,
        settings: SoftwareRegulatorSettings,
        *,
        heat: HeatOutput,
        measured: Callable[[], Reading | None],
        allowed_degC: tuple[float, float],
        stale_s: float,
        clock: Clock,
        publish: Callable[[Item], None],
    ) -> None:
        self.name = name
        self.is_permitted: Callable[[], bool] = lambda: False
        self._settings = settings
        self._heat = heat
        self._get_measurement = measured
        self._allowed_degC = allowed_degC
        self._stale_s = stale_s
        self._clock = clock
        self._publish = publish
        self._task: asyncio.Task[None] | None = None
        self._sp_degC: float | None = None
        self._output_percent = 0.0
        self._state: pid.State | None = None
        self._stepped_ns = 0  # time of the reading that the last step was made with; 0: none since a gap
        self._rests_ns: int | None = None  # since when the set-point is held
        self._tuning: Tuning | None = None
        self._trouble = ""

    @property
    def identity(self) -> Identity | None:
        """The identity of what it heats by, where that is a device of its own."""
        return self._heat.identity

    @property
    def heat_uncontrolled(self) -> str:
        """Why what it heats by may give heat though it was commanded off; "" while it obeys."""
        return self._heat.uncontrolled

    async def open(self) -> None:
        """Open what it heats by; thermometer and relays are devices of their own."""
        await self._heat.open()

    async def close(self) -> None:
        """Give no more heat; what is given ends by itself."""
        await self._end()

    async def read(self) -> tuple[Reading, ...]:
        """pv, sp (degC; BAD before one was given), mv_heat, mv_cool (%), running, fault."""
        now_ns, sp = self._clock.now_ns(), f"{self.name}.sp"
        _, reason = self._get_process_value(now_ns)
        if self._task is not None and self._task.done() and not self._task.cancelled():
            error = self._task.exception()
            self._trouble = f"control has ended: {describe_failure(error)}" if error is not None else self._trouble
        running = self._task is not None and not self._task.done()
        faults = [text for text in (self._trouble, reason if running else "") if text]
        heat, cool = pid.split(self._output_percent if running else 0.0, self._settings.law.dead_band_percent)
        return (
            self._get_shown_value(now_ns),
            bad_reading(sp, "degC", now_ns, "none was given yet")
            if self._sp_degC is None
            else Reading(sp, self._sp_degC, "degC", now_ns),
            Reading(f"{self.name}.mv_heat", heat, "%", now_ns),
            Reading(f"{self.name}.mv_cool", cool, "%", now_ns),
            Reading(f"{self.name}.running", float(running), "1", now_ns),
            Reading(f"{self.name}.fault", float(bool(faults)), "1", now_ns, reason="; ".join(faults)),
        )

    async def in_force(self) -> InForce:
        """Return that the set-point acts: nothing stands between it and the law; what heats by it is read back by its
        own device."""
        return InForce("this program itself controls by it, and reads back the output that it gives")

    async def set_temperature(self, degC: float) -> None:
        """Take a set-point. Refused outside what is allowed, Occupied while it tunes itself."""
        low_degC, high_degC = self._allowed_degC
        if not low_degC <= degC <= high_degC:
            raise Refused(self.name, f"{degC:g} degC is outside {low_degC:g}..{high_degC:g} degC")
        if self._tuning is not None:
            raise Occupied(self.name, "autotuning is active; its set-point stays")
        if degC != self._sp_degC:
            self._sp_degC, self._rests_ns = degC, None

    async def run(self) -> None:
        """Start control; Refused without a set-point."""
        if self._sp_degC is None:
            raise Refused(self.name, "no set-point was given yet")
        if self._task is None or self._task.done():
            await self._heat.arm()
            self._trouble, self._state, self._rests_ns = "", None, None
            self._task = asyncio.create_task(self._control())

    async def stop(self) -> None:
        """Stop control; the heat is off, confirmed."""
        await self._end()
        await self._heat.off()
        self._trouble = ""

    async def make_safe(self) -> None:
        """Stopped, confirmed."""
        await self.stop()

    async def test_dead_man(self) -> None:
        """Test, while it is stopped, whether what it heats by ends without us. DeviceFault when not."""
        await self._heat.test_dead_man()

    async def autotune(self) -> Law:
        """Wait until the set-point is held, find the ultimate point about it, and go on with the law as it is. The law
        that was found is event `autotuned`; DeviceFault when none was."""
        if self._tuning is not None:
            raise Occupied(self.name, "autotuning is active already")
        await self._wait_for_rest()
        sp_degC, output_percent = self._sp_degC or 0.0, self._output_percent
        try:
            point = await self._run_limit_cycle(relay_tuning.begin(sp_degC, output_percent, self._clock.now_ns()))
        finally:
            self._tuning = None
            pv, _ = self._get_process_value(self._clock.now_ns())
            self._state = None if pv is None else pid.start(self._settings.law, pv.value, output_percent)
        law = relay_tuning.tune(self._settings.law, point)
        data = {"device": self.name, "set_point_degC": sp_degC, **asdict(point), "law": law.model_dump(mode="json")}
        self._publish(AUTOTUNED.at(self._clock.now_ns(), relay_tuning.format_yaml(law), **data))
        return law

    async def _wait_for_rest(self) -> None:
        """Wait until the set-point has been held for a while."""
        since_ns = self._clock.now_ns()
        while self._rests_ns is None or self._clock.now_ns() - self._rests_ns < to_ns(_REST_S):
            self._check_controls()
            if self._clock.now_ns() - since_ns > to_ns(self._settings.autotune.limit_s):
                text = f"not tuned: its set-point was not held within {_REST_K:g} K for {_REST_S:g} s"
                raise DeviceFault(self.name, text)
            await self._pause()

    async def _run_limit_cycle(self, tuning: Tuning) -> UltimatePoint:
        """Return what the limit cycle shows, once it is even."""
        while (point := relay_tuning.find_ultimate_point(tuning, self._settings.autotune)) is None:
            self._check_controls()
            if tuning.failure:
                raise DeviceFault(self.name, f"not tuned: {tuning.failure}")
            self._tuning = tuning
            await self._pause()
            tuning = self._tuning
        return point

    # The task of control.

    async def _control(self) -> None:
        due_ns = self._clock.now_ns()
        try:
            while True:
                try:
                    await self._tick()
                    self._trouble = ""
                except DeviceError as error:
                    self._trouble = str(error)
                due_ns = max(due_ns + to_ns(self._settings.sample_s), self._clock.now_ns())
                await self._clock.sleep_until(due_ns)
        finally:
            self._output_percent, self._stepped_ns = 0.0, 0

    async def _tick(self) -> None:
        now_ns = self._clock.now_ns()
        pv, _ = self._get_process_value(now_ns)
        was_high = self._tuning is not None and self._tuning.is_high
        if pv is None or not self.is_permitted():
            self._output_percent, self._stepped_ns, self._rests_ns = 0.0, 0, None
        elif pv.time_ns != self._stepped_ns:
            self._output_percent = self._step(pv, now_ns)
        heat, _ = pid.split(self._output_percent, self._settings.law.dead_band_percent)
        turned = self._tuning is not None and self._tuning.is_high != was_high
        await self._heat.give(heat, at_once=turned or pv is None or self._stepped_ns == 0)

    def _step(self, pv: Reading, now_ns: int) -> float:
        """The output after this reading."""
        law, sp_degC = self._settings.law, self._sp_degC or 0.0
        if self._tuning is not None:
            self._stepped_ns = pv.time_ns
            self._tuning = relay_tuning.step(self._tuning, pv.value, now_ns, self._settings.autotune, law)
            return relay_tuning.output_percent(self._tuning, self._settings.autotune, law)
        if abs(pv.value - sp_degC) > _REST_K:
            self._rests_ns = None
        else:
            self._rests_ns = self._rests_ns or now_ns
        h_s = (pv.time_ns - self._stepped_ns) / NS_PER_S if self._stepped_ns else self._settings.sample_s
        if self._state is None:
            self._state = pid.start(law, pv.value, 0.0)
        elif not self._stepped_ns:
            self._state = pid.continue_after_gap(law, self._state, pv.value)
        self._stepped_ns = pv.time_ns
        output_percent, self._state = pid.step(law, self._state, sp_degC, pv.value, h_s)
        return output_percent

    async def _end(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            await cancel_all([task])

    def _get_process_value(self, now_ns: int) -> tuple[Reading | None, str]:
        """A reading that may be acted upon, or why there is none."""
        reading, channel = self._get_measurement(), f"thermometers.{self._settings.thermometer}"
        if reading is None:
            return None, f"{channel} was not read yet"
        if reading.quality is not Quality.GOOD:
            return None, f"{channel} is {reading.quality}: {reading.reason}"
        if now_ns - reading.time_ns > to_ns(self._stale_s):
            return None, f"{channel} is {(now_ns - reading.time_ns) / NS_PER_S:.0f} s old"
        return reading, ""

    def _check_controls(self) -> None:
        """DeviceFault when there is nothing to be tuned any more."""
        if self._task is None or self._task.done() or not self.is_permitted():
            raise DeviceFault(self.name, "not tuned: control was stopped")

    async def _pause(self) -> None:
        await self._clock.sleep_until(self._clock.now_ns() + to_ns(self._settings.sample_s))

    def _get_shown_value(self, now_ns: int) -> Reading:
        """pv: what the thermometer has given, as it was given, old or not."""
        reading, channel = self._get_measurement(), f"{self.name}.pv"
        if reading is None:
            return bad_reading(channel, "degC", now_ns, f"thermometers.{self._settings.thermometer} was not read yet")
        return replace(reading, channel=channel)


def _make(name: str, settings: SoftwareRegulatorSettings, around: DriverContext) -> SoftwareRegulator:
    module, relays = around.made.get("heat_module"), cast("Switches", around.made["relays"])
    return SoftwareRegulator(
        name,
        settings,
        heat=module if isinstance(module, HeatModule) else HeatPulses(relays, settings.pulses, around.clock),
        measured=lambda: around.known(f"thermometers.{settings.thermometer}"),
        allowed_degC=around.of_section("limits").chamber_degC,
        stale_s=around.of_section("guard").stale_after_s,
        clock=around.clock,
        publish=around.publish,
    )


async def _autotune(stand: ManualActions, name: str, given: Arguments) -> None:
    await stand.heat(given["setpoint_degC"])
    await stand.device(name).autotune()


async def _check(look: DeviceCheck) -> None:
    """Open nothing: what it measures and heats by is checked as a device of its own."""
    look.opened.add(look.name)
    by = "heat_module" if "heat_module" in look.made else f"relays.{HEAT}"
    text = f"this program itself: it measures thermometers.{look.settings.thermometer} and heats by {by}"
    look.found("link", "ok", text, data=look.settings.model_dump(mode="json"))


_AUTOTUNE = "find the constants of its law about a set-point, once that is held"
KIND = DeviceKind(
    name="regulator",
    settings=SoftwareRegulatorSettings,
    make=_make,
    channels=(*CONTROLLED, Channel("mv_heat", "%", "output"), Channel("mv_cool", "%", "output")),
    section="regulator",
    device="regulator",
    rank=35,  # after the thermometers, of which it shows what was read
    address_key="",
    check=_check,
    fakes=(),
    verbs=(*CONTROL, Verb("autotune", _AUTOTUNE, _autotune, CONTROL[0].arguments)),
)
