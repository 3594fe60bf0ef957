"""Follows a run from its own hub: which step, what is measured, when it will be done, and what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from thermostand.experiments.steps import words_of
from thermostand.foundation.clock import NS_PER_S, seconds_ns
from thermostand.foundation.events import (
    CAMERA_EQUILIBRIUM,
    CAMERA_EQUILIBRIUM_LOST,
    CLOCK_STEP,
    RUN_BEGINS,
    TO_AMBIENT,
)
from thermostand.foundation.items import Batch, Event, Item, Original, StepMark
from thermostand.foundation.readings import Frame, Quality
from thermostand.recording.format.utc_offsets import UtcOffsets, offsets_of
from thermostand.stand.estimating.eta import Eta
from thermostand.stand.estimating.run_estimate import Night
from thermostand.stand.gate import HELD, RELEASED
from thermostand.stand.running.status import doing_in_words
from thermostand.stand.watching.moment import AIR, CAMERA, SET_POINT, Moment, held_by
from thermostand.stand.watching.remedies import next_command

_LEAST_S = 1.0  # of stand time between two reports, or a thousandth of the night: terminals are slow
_SHARE = 1e-3
_SHOWN = {SET_POINT: "setpoint_degC", AIR: "air_degC", CAMERA: "camera_degC"}


class Follow:
    """A subscriber of the hub.

    `show(moment)`: gets how the run stands, from its first step on, without what the hub does not tell (drift, disk).
    `tell(line)`: gets warnings and errors as they come, with what to type then. `done`, `earned_s`: as Eta has them.
    `tell_all`: events of no importance, too. `directory`: where sessions are.
    """

    def __init__(
        self,
        title: str,
        night: Night,
        show: Callable[[Moment], None],
        tell: Callable[[str], None],
        done: Collection[str] = (),
        earned_s: Mapping[str, float] = MappingProxyType({}),
        *,
        tell_all: bool = False,
        directory: Path = Path(),
    ) -> None:
        self.eta = Eta(night.steps, done, earned_s, night.after_s)
        self._least_ns = seconds_ns(max(_LEAST_S, _SHARE * night.duration_s))
        self._show, self._tell, self._tells_all = show, tell, tell_all
        frames = sum(step.frames for step in night.steps if step.planned.step_id in done)
        self._moment = Moment(0, title, frames=frames, frames_planned=self.eta.frames)
        self._reasons: set[str] = set()
        self._directory, self._session = directory, ""
        self._begin_ns: int | None = None
        self._doing = ""
        self._soaks_since_ns: int | None = None  # a camera that was off
        self._utc = UtcOffsets()  # as it is now
        self._next_ns = 0

    def __call__(self, item: Item) -> None:
        """Follow one item; a terminal that is gone is no reason for a run to end."""
        with suppress(OSError):
            self._follow(item)

    def _follow(self, item: Item) -> None:
        match item:
            case Event():
                self._event(item)
                return
            case Frame():
                self._moment = replace(self._moment, frames=self._moment.frames + 1)
            case Batch():
                self._readings(item)
            case StepMark():
                self.eta.mark(item)
                self._doing = words_of(item.kind, item.parameters)
                self._moment = replace(self._moment, step=item.index + 1, steps=self.eta.count)
                self._begin_ns = item.time_ns if self._begin_ns is None else self._begin_ns
                self._next_ns = item.time_ns
            case Original():
                return
        if self._begin_ns is not None and item.time_ns >= self._next_ns:
            self._show_at(item.time_ns, self._begin_ns)

    def _event(self, event: Event) -> None:
        self.eta.event(event)
        self._utc = offsets_of([event]) if event.kind == CLOCK_STEP else self._utc
        if name := event.data.get("session") if event.kind in RUN_BEGINS else "":
            self._session = str(self._directory / str(name))
        if event.kind == TO_AMBIENT:
            self._doing, self._soaks_since_ns = "back to the laboratory's temperature", None
        if event.kind in (CAMERA_EQUILIBRIUM_LOST, CAMERA_EQUILIBRIUM):
            self._soaks_since_ns = event.time_ns if event.kind == CAMERA_EQUILIBRIUM_LOST else None
        if event.kind in (HELD, RELEASED):
            reason = str(event.data.get("reason"))
            (self._reasons.add if event.kind == HELD else self._reasons.discard)(reason)
            self._moment = replace(self._moment, held=held_by(sorted(self._reasons)))
            self._next_ns = event.time_ns
        if event.level != "info":
            line = f"{event.level}: {self._utc.local_text(event.time_ns)[11:]} {event.text}"
            self._tell(f"{line}; {next_command(event.kind, event.data, self._session)}")
        elif self._tells_all:
            self._tell(f"{self._utc.local_text(event.time_ns)[11:]} {event.text}")

    def _readings(self, batch: Batch) -> None:
        shown = {
            _SHOWN[reading.channel]: None if reading.quality is Quality.BAD else reading.value
            for reading in batch.readings
            if reading.channel in _SHOWN
        }
        if shown:
            self._moment = replace(self._moment, **shown)

    def _show_at(self, now_ns: int, begin_ns: int) -> None:
        self._next_ns = now_ns + self._least_ns
        left_s, gone_s = self.eta.left_s(now_ns), (now_ns - begin_ns) / NS_PER_S
        again_s = None if self._soaks_since_ns is None else (now_ns - self._soaks_since_ns) / NS_PER_S
        moment = replace(
            self._moment,
            doing=doing_in_words(self._doing, again_s, goes_on=self.eta.goes_on),
            now_ns=self._utc.utc_ns(now_ns),
            share=gone_s / max(gone_s + left_s, 1e-9),
            end_ns=self._utc.utc_ns(now_ns + seconds_ns(left_s)),
            end_within_s=self.eta.within_s(),
        )
        self._show(moment)
