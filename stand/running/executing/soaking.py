"""Soaks: what they earn, and when the chamber has been in its band for long enough to end one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from thermostand.experiments.steps import AnySoak, PlannedStep, Soak
from thermostand.foundation.clock import NS_PER_S, Clock, seconds_ns
from thermostand.foundation.errors import DeviceFault
from thermostand.foundation.events import FRAME_UNSETTLED, SOAK_LONGER, SOAK_UNSETTLED
from thermostand.foundation.readings import UNSETTLED
from thermostand.foundation.tasks import first_of
from thermostand.stand.gate import Gate
from thermostand.stand.running.executing.settling_watch import SettlingWatch
from thermostand.stand.running.memory.entries import Soaked
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import RunState, duration_of

_JOURNAL_NS = 60 * NS_PER_S  # of a soak that a kill costs at most


class Soaking:
    """Performs the soaks of one run; `settling` sees the chamber and the camera."""

    def __init__(self, gate: Gate, clock: Clock, log: Logbook, settling: SettlingWatch) -> None:
        self._gate = gate
        self._clock = clock
        self._log = log
        self._settling = settling

    async def earn(self, step_id: str, changes: Callable[[], asyncio.Event]) -> None:
        """Earn what a soak still owes while nothing holds the run; returns early when the set-up was disturbed.
        changes: the event of the plan's next change. DeviceFault of the regulator when it ends unsettled and the recipe
        wants that to hold the run; it then owes everything again."""
        self._settling.restart()
        said_s = 0.0  # until when it goes on at least, as was said
        while (soak := self._state.step(step_id)) and (owed_ns := self._state.owed_ns(soak)):
            if self._is_kept() or not isinstance(soak.step, AnySoak):
                return
            begin_ns, earned_ns = self._clock.now_ns(), duration_of(soak) - owed_ns
            wait_ns = min(owed_ns, _JOURNAL_NS, self._judged_in_ns(soak.step, earned_ns))
            await first_of(self._clock.sleep_until(begin_ns + wait_ns), self._gate.closed(), changes().wait())
            soak = self._state.step(step_id) or soak  # it may be longer now
            step, has_ended = soak.step, False
            if isinstance(step, AnySoak) and not self._is_kept() and self._state.owed_ns(soak):
                soaked_s = (earned_ns + self._clock.now_ns() - begin_ns) / NS_PER_S
                has_ended = await self._has_ended(step, step_id, soaked_s)
                if isinstance(step, Soak) and not has_ended and soaked_s >= max(said_s, step.duration_s):
                    said_s = soaked_s + self._tell_longer(step, soak, soaked_s)
            now_ns, whole_ns = self._clock.now_ns(), duration_of(self._state.step(step_id) or soak)
            earned_ns = min(earned_ns + now_ns - begin_ns, whole_ns)
            if step_id not in self._state.skipped:
                await self._keep(soak, now_ns, earned_ns, is_over=has_ended or earned_ns == whole_ns)

    def flags(self) -> tuple[str, ...]:
        """Of a frame that is taken now: whether the last soak has not brought the chamber into its band, or the chamber
        has left it since, as one that overshoots does after a soak that was too short."""
        chamber_degC, band_K = self._state.set_up.chamber_degC, self._state.band_K
        if self._state.is_unsettled:
            return (UNSETTLED,)
        if chamber_degC is None or band_K is None:
            return ()
        degC = self._settling.outside_degC(chamber_degC, band_K)
        if degC is None:
            return ()
        self._log.tell(FRAME_UNSETTLED, degC=degC, chamber_degC=chamber_degC, band_K=band_K)
        return (UNSETTLED,)

    async def _keep(self, soak: PlannedStep, now_ns: int, earned_ns: int, *, is_over: bool) -> None:
        """What it has earned; and when it is over, whether the chamber was in its band at last."""
        step, step_id = soak.step, soak.step_id
        is_settled = True
        if is_over and isinstance(step, AnySoak) and self._missing_s(step):
            is_settled = False
            text = f"{self._text(step)} at the end of the longest soak"
            if isinstance(step, Soak) and step.unsettled == "hold":
                await self._log.write(Soaked(now_ns, step_id, 0.0))
                raise DeviceFault("regulator", f"{text}; once that is reset, the soak begins again")
            self._log.tell(SOAK_UNSETTLED, text, step_id=step_id)
        ended = "" if not is_over else "settled" if is_settled else "unsettled"
        await self._log.write(Soaked(now_ns, step_id, earned_ns / NS_PER_S, ended))

    @property
    def _state(self) -> RunState:
        return self._log.state

    def _is_kept(self) -> bool:
        """From earning anything."""
        return bool(self._gate.reasons) or self._state.is_disturbed

    def _judged_in_ns(self, step: AnySoak, earned_ns: int) -> int:
        """Until a soak that has earned so much may end."""
        if not isinstance(step, Soak):
            return _JOURNAL_NS
        short_ns = seconds_ns(step.duration_s) - earned_ns
        return short_ns if short_ns > 0 else max(NS_PER_S, seconds_ns(self._missing_s(step)))

    async def _has_ended(self, step: AnySoak, step_id: str, soaked_s: float) -> bool:
        """Whether a soak, so old, may end now."""
        if isinstance(step, Soak):
            return soaked_s >= step.duration_s and not self._missing_s(step)
        return await self._settling.is_settled(step, step_id, soaked_s)

    def _missing_s(self, step: AnySoak) -> float:
        """What the chamber was not in the band in the last part before now, s; 0 also when the soak has no band, or the
        chamber is stopped."""
        band_K, chamber_degC = step.guaranteed_K, self._state.set_up.chamber_degC
        if not band_K or chamber_degC is None:
            return 0.0
        return max(0.0, step.last_part_s - self._settling.in_band_s(chamber_degC, band_K))

    def _tell_longer(self, step: Soak, soak: PlannedStep, soaked_s: float) -> float:
        """That it goes on beyond its time; returned is for how long at least, s."""
        by_s = min(self._missing_s(step), duration_of(soak) / NS_PER_S - soaked_s)
        self._log.tell(SOAK_LONGER, self._text(step), step_id=soak.step_id, by_s=by_s)
        return by_s

    def _text(self, step: AnySoak) -> str:
        """Where the chamber was."""
        chamber_degC, last_s = self._state.set_up.chamber_degC, step.last_part_s
        was_s = last_s - self._missing_s(step)
        place = f"within {step.guaranteed_K:g} K of {chamber_degC} degC"
        return f"the chamber was {place} for {was_s:.0f} s, not {last_s:.0f} s"
