"""Soaks: what they earn, and when the chamber has been in its band for long enough to end one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from thermostand.experiments.steps import AnySoak, PlannedStep, Soak
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import DeviceFault
from thermostand.foundation.events import FRAME_UNSETTLED, SOAK_LONGER, SOAK_UNSETTLED
from thermostand.foundation.readings import UNSETTLED
from thermostand.foundation.tasks import wait_for_first
from thermostand.stand.running.executing.settling_watch import SettlingWatch
from thermostand.stand.running.memory.entries import Soaked
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import RunState, get_duration_ns
from thermostand.stand.safety.gate import Gate

_JOURNAL_NS = 60 * NS_PER_S  # of a soak that a kill costs at most


class SoakRunner:
    """Performs the soaks of one run; `settling` sees the chamber and the camera."""

    def __init__(self, gate: Gate, clock: Clock, log: Logbook, settling: SettlingWatch) -> None:
        self._gate = gate
        self._clock = clock
        self._log = log
        self._settling = settling

    async def soak(self, step_id: str, changes: Callable[[], asyncio.Event]) -> None:
        """Earn what a soak still owes while nothing holds the run; returns early when the set-up was disturbed.
        changes: the event of the plan's next change. DeviceFault of the regulator when it ends unsettled and the recipe
        wants that to hold the run; it then owes everything again."""
        self._settling.restart()
        reported_s = 0.0  # until when it goes on at least, as was reported
        while (soak := self._state.step(step_id)) and (remaining_ns := self._state.remaining_ns(soak)):
            if self._is_interrupted() or not isinstance(soak.step, AnySoak):
                return
            begin_ns, soaked_ns = self._clock.now_ns(), get_duration_ns(soak) - remaining_ns
            wait_ns = min(remaining_ns, _JOURNAL_NS, self._compute_judgement_ns(soak.step, soaked_ns))
            await wait_for_first(
                self._clock.sleep_until(begin_ns + wait_ns), self._gate.wait_until_closed(), changes().wait()
            )
            soak = self._state.step(step_id) or soak  # it may be longer now
            step, has_ended = soak.step, False
            if isinstance(step, AnySoak) and not self._is_interrupted() and self._state.remaining_ns(soak):
                soaked_s = (soaked_ns + self._clock.now_ns() - begin_ns) / NS_PER_S
                has_ended = await self._has_ended(step, step_id, soaked_s)
                if isinstance(step, Soak) and not has_ended and soaked_s >= max(reported_s, step.duration_s):
                    reported_s = soaked_s + self._report_extension(step, soak, soaked_s)
            now_ns, whole_ns = self._clock.now_ns(), get_duration_ns(self._state.step(step_id) or soak)
            soaked_ns = min(soaked_ns + now_ns - begin_ns, whole_ns)
            if step_id not in self._state.skipped:
                await self._save_progress(soak, now_ns, soaked_ns, is_over=has_ended or soaked_ns == whole_ns)

    def flags(self) -> tuple[str, ...]:
        """The flags of a frame that is taken now: whether the last soak has not brought the chamber into its band, or
        the chamber has left it since, as one that overshoots does after a soak that was too short."""
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

    async def _save_progress(self, soak: PlannedStep, now_ns: int, soaked_ns: int, *, is_over: bool) -> None:
        """Record the soak time so far; and when it is over, whether the chamber was in its band at last."""
        step, step_id = soak.step, soak.step_id
        is_settled = True
        if is_over and isinstance(step, AnySoak) and self._measure_missing_s(step):
            is_settled = False
            text = f"{self._describe_chamber(step)} at the end of the longest soak"
            if isinstance(step, Soak) and step.unsettled == "hold":
                await self._log.write(Soaked(now_ns, step_id, 0.0))
                raise DeviceFault("regulator", f"{text}; once that is reset, the soak begins again")
            self._log.tell(SOAK_UNSETTLED, text, step_id=step_id)
        ended = "" if not is_over else "settled" if is_settled else "unsettled"
        await self._log.write(Soaked(now_ns, step_id, soaked_ns / NS_PER_S, ended))

    @property
    def _state(self) -> RunState:
        return self._log.state

    def _is_interrupted(self) -> bool:
        """Whether the soak time stands still."""
        return bool(self._gate.reasons) or self._state.is_setup_invalid

    def _compute_judgement_ns(self, step: AnySoak, soaked_ns: int) -> int:
        """How long until a soak with so much soak time may end, ns."""
        if not isinstance(step, Soak):
            return _JOURNAL_NS
        short_ns = to_ns(step.duration_s) - soaked_ns
        return short_ns if short_ns > 0 else max(NS_PER_S, to_ns(self._measure_missing_s(step)))

    async def _has_ended(self, step: AnySoak, step_id: str, soaked_s: float) -> bool:
        """Whether a soak, so old, may end now."""
        if isinstance(step, Soak):
            return soaked_s >= step.duration_s and not self._measure_missing_s(step)
        return await self._settling.is_settled(step, step_id, soaked_s)

    def _measure_missing_s(self, step: AnySoak) -> float:
        """What the chamber was not in the band in the last part before now, s; 0 also when the soak has no band, or the
        chamber is stopped."""
        band_K, chamber_degC = step.guaranteed_K, self._state.set_up.chamber_degC
        if not band_K or chamber_degC is None:
            return 0.0
        return max(0.0, step.last_part_s - self._settling.in_band_s(chamber_degC, band_K))

    def _report_extension(self, step: Soak, soak: PlannedStep, soaked_s: float) -> float:
        """That it goes on beyond its time; returned is for how long at least, s."""
        by_s = min(self._measure_missing_s(step), get_duration_ns(soak) / NS_PER_S - soaked_s)
        self._log.tell(SOAK_LONGER, self._describe_chamber(step), step_id=soak.step_id, by_s=by_s)
        return by_s

    def _describe_chamber(self, step: AnySoak) -> str:
        """Where the chamber was."""
        chamber_degC, last_s = self._state.set_up.chamber_degC, step.last_part_s
        was_s = last_s - self._measure_missing_s(step)
        place = f"within {step.guaranteed_K:g} K of {chamber_degC} degC"
        return f"the chamber was {place} for {was_s:.0f} s, not {last_s:.0f} s"
