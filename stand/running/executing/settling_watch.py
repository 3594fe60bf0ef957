"""Watches a soak: keeps what the chamber's and the camera's thermometers say, and looks at the target."""

from __future__ import annotations

import importlib
import math
from array import array
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from thermostand.experiments.steps import PlannedStep, SoakUntilSettled
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.events import NOT_SETTLED, SETTLED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Frame, Reading
from thermostand.foundation.workers import WorkerThread
from thermostand.markers.target import Target
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.config.chamber_section import BAND_K
from thermostand.stand.imaging.settling import (
    Float,
    SettlingData,
    find_digit_K,
    judge_settling,
    measure_movement,
    to_seconds,
)

if TYPE_CHECKING:
    from thermostand.markers.detection import Detection

CHAMBER, CAMERA = "regulator.pv", "camera.temperature"
_UNKNOWN_S = 60.0  # as in imaging/equilibrium.py
# At most 40,000 pairs of numbers, 0.64 MB for each channel.
_KEPT = 20_000  # readings, at least: more than a day at one every 5 s


def preload_for(plan: Iterable[PlannedStep]) -> None:
    """Import what looks need, when the plan has any: in the run that would hold the guard's loop for a second."""
    if any(isinstance(planned.step, SoakUntilSettled) for planned in plan):
        importlib.import_module("thermostand.markers.detection")


class SettlingWatch:
    """What is seen since `restart`; one to a run. `target`: what the camera looks at."""

    def __init__(self, stand: Stand, hub: Hub, clock: Clock, target: Target) -> None:
        self._stand = stand
        self._hub = hub
        self._clock = clock
        self._target = target
        self._worker = WorkerThread("settling", clock)
        # Time in s and degC, one after the other: as tuples of objects they were most of the memory that a run took.
        self._readings = {name: array("d") for name in (CHAMBER, CAMERA)}
        self._digit_K = 0.0
        self._looks: list[Float] = []
        self._before: Detection | None = None
        self._unseen = ""
        self._due_ns: int | None = None  # the next look; None until the chamber has arrived
        hub.subscribe(self._receive)

    def close(self) -> None:
        """Listen no more, and end the thread that finds markers."""
        self._hub.unsubscribe(self._receive)
        self._worker.close()

    def restart(self) -> None:
        """A new window: what was seen of the camera before a soak, a pause or a disturbance proves nothing about the
        time after."""
        del self._readings[CAMERA][:]
        self._forget_looks("")
        self._due_ns = None

    def in_band_s(self, chamber_degC: float, band_K: float) -> float:
        """Return how long the chamber has been within `band_K` of its set-point, as far as it is known without a gap,
        s; 0 when it is not, or is not known now."""
        now_s, (time_s, pv_degC) = to_seconds(self._clock.now_ns()), np.array(self._readings[CHAMBER]).reshape(-1, 2).T
        if not time_s.size or now_s - time_s[-1] > _UNKNOWN_S:
            return 0.0
        is_out = ~(np.abs(pv_degC - chamber_degC) <= band_K)  # NaN is out
        is_out[1:] |= np.diff(time_s) > _UNKNOWN_S
        ends = np.flatnonzero(is_out)
        since = 0 if not ends.size else int(ends[-1]) + 1
        return 0.0 if since == time_s.size else now_s - float(time_s[since])

    def outside_degC(self, chamber_degC: float, band_K: float) -> float | None:
        """The chamber's temperature when that is outside the band around its set-point; None when it is inside, or is
        not known (a frame then has no temperature of it either)."""
        chamber = self._readings[CHAMBER]
        if not chamber or to_seconds(self._clock.now_ns()) - chamber[-2] > _UNKNOWN_S:
            return None
        return chamber[-1] if abs(chamber[-1] - chamber_degC) > band_K else None

    async def is_settled(self, soak: SoakUntilSettled, step_id: str, soaked_s: float) -> bool:
        """Return whether the soak, `soaked_s` old, may end now; says so, and also when it has to end without.

        Looks are taken every `soak.look_every_s` from when the chamber is in its band; judged is after each of them.
        """
        if await self._take_look(soak, step_id) and soaked_s >= soak.min_s:
            verdict = judge_settling(self._collect_data(), soak, to_seconds(self._clock.now_ns()))
            if verdict.settled:
                self._hub.publish(SETTLED.at(self._clock.now_ns(), verdict.rates, soaked_s=soaked_s))
                return True
        if soaked_s >= soak.max_s:
            verdict = judge_settling(self._collect_data(), soak, to_seconds(self._clock.now_ns()))
            why = verdict.missing or "the last look came too late"
            seen = f" ({self._unseen})" if self._unseen else ""
            self._hub.publish(NOT_SETTLED.at(self._clock.now_ns(), f"{why}{seen}", soaked_s=soaked_s))
        return False

    async def _take_look(self, soak: SoakUntilSettled, step_id: str) -> bool:
        """Return whether a look was due and has shown the target."""
        now_ns, every_ns = self._clock.now_ns(), to_ns(soak.look_every_s)
        if self._due_ns is None and self._has_arrived(soak.chamber_degC):
            self._due_ns = now_ns
        if self._due_ns is None or now_ns < self._due_ns:
            return False
        self._due_ns += (1 + (now_ns - self._due_ns) // every_ns) * every_ns
        frame = await self._stand.imaging.look(soak.exposure_s, step_id)
        if frame is None:
            self._forget_looks("the camera was lost")
            return False
        await self._worker.call(self._measure_movement, frame)
        return bool(self._looks)

    def _measure_movement(self, frame: Frame) -> None:
        """Measure, in the worker thread, the markers, and how far they have moved since the look before."""
        from thermostand.markers.detection import DetectionError, detect  # see preload_for

        try:
            found = detect(frame.image, self._target, self._before)
        except DetectionError as error:
            return self._forget_looks(f"the target was not found: {error}")
        seen = measure_movement(self._before or found, found)
        if seen is None:
            return self._forget_looks("too few markers are whole")
        moved_px, uncertainty_px = seen
        so_far_px = self._looks[-1][1:5] if self._looks else np.zeros(4)
        self._looks.append(np.array((to_seconds(frame.time_ns), *(so_far_px + moved_px), uncertainty_px)))
        self._before, self._unseen = found, ""

    def _forget_looks(self, why: str) -> None:
        """The next look is the first one again."""
        self._looks.clear()
        self._before, self._unseen = None, why

    def _receive(self, item: Item) -> None:
        """The hub's subscriber."""
        if isinstance(item, Batch):
            for reading in item.readings:
                kept = self._readings.get(reading.channel)
                if kept is not None and not _is_passing(reading, kept):
                    is_suspect = reading.cause == "suspect"
                    kept.extend((to_seconds(reading.time_ns), math.nan if is_suspect else reading.value))
                    if len(kept) > 4 * _KEPT:
                        del kept[: 2 * _KEPT]

    def _has_arrived(self, chamber_degC: float) -> bool:
        chamber = self._readings[CHAMBER]
        return bool(chamber) and abs(chamber[-1] - chamber_degC) <= BAND_K

    def _collect_data(self) -> SettlingData:
        chamber, camera = (np.array(self._readings[name]).reshape(-1, 2).T for name in (CHAMBER, CAMERA))
        # A camera at rest shows one digit only; how wide that is shows while it moves.
        self._digit_K = min(filter(None, (self._digit_K, find_digit_K(camera[1]))), default=0.0)
        return SettlingData(chamber, camera, self._digit_K, np.array(self._looks, np.float64).reshape(-1, 6))


def _is_passing(reading: Reading, kept: array[float]) -> bool:
    """A poll that failed on the wire says nothing, and soon it is asked again; when that lasts, what was meanwhile is
    not known."""
    return reading.cause == "wire" and bool(kept) and to_seconds(reading.time_ns) - kept[-2] < _UNKNOWN_S
