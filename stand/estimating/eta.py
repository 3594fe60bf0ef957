"""The time left of a running plan, from its estimate and from what its steps have taken so far."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from statistics import median_low
from types import MappingProxyType
from typing import Any, cast

from thermostand.experiments.steps import KnownStand, Situation, make_step, number_steps
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import AT_AMBIENT, NOT_AT_AMBIENT, PLAN_CHANGED, SOAK_LONGER, TO_AMBIENT
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.stand.estimating.estimate import PricedStep
from thermostand.stand.safety.gate import HELD, RELEASED

# Round numbers; nothing was measured.
_REMEMBERED = 9  # the last measurements of a kind of work count
_LEAST_SEEN = 3  # steps that are done, before the uncertainty of the end is stated
_LEAST_WITHIN_S = 60.0  # nobody plans by less; round number, nothing was measured
_LEAST_SHARE = 0.5  # of what is left must be of known kinds of work; round number, nothing was measured


class Eta:
    """Follows a run by its step marks and says how long it will still take on the stand's clock.

    What work of a kind takes beyond what is stated is the lower median of the estimate and what the run has measured:
    a single delay, such as a pause that was not announced, changes nothing. Steps before the running one are never
    waited for.

    Of a run that is resumed after an interruption, `done` are the ids of steps that are done, `soaked_s` how long
    others have soaked so far, by their ids. `after_s`: what follows the last step, the way back to the laboratory's
    temperature.
    """

    def __init__(
        self,
        steps: Sequence[PricedStep],
        done: Collection[str] = (),
        soaked_s: Mapping[str, float] = MappingProxyType({}),
        after_s: float = 0.0,
    ) -> None:
        self._expected_s = {step.planned.step_id: step.duration_s for step in steps}  # with the soak time so far
        self._steps = [_subtract_soaked(step, soaked_s.get(step.planned.step_id, 0.0)) for step in steps]
        self._waiting = {step.planned.index: step for step in self._steps if step.planned.step_id not in done}
        self._first = min(self._waiting, default=0)
        self._stated_s = sum(step.stated_s for step in self._waiting.values())
        self._count = Counter(step.work for step in self._waiting.values())
        self._overhead_s = {step.work: step.duration_s - step.stated_s for step in steps}
        self._seen_s = {work: deque([usual_s], _REMEMBERED) for work, usual_s in self._overhead_s.items()}
        self._running: PricedStep | None = None
        self.goes_on = False  # the soak under way, beyond its time
        self._begun_ns = 0
        self._reasons: set[object] = set()
        self._held_since_ns: int | None = None
        self._held_ns = 0  # of the running step
        self._off_s: dict[str, list[float]] = {}  # by kind of work, how far each step was from what was expected of it
        self._after_s, self._after_since_ns = after_s, -1

    def mark(self, mark: StepMark) -> None:
        """A step began or ended."""
        self.goes_on = False
        if not 0 <= mark.index < len(self._steps):
            return
        if mark.state is StepState.STARTED:
            self._begin(self._steps[mark.index], mark.time_ns)
            return
        running = self._running
        if running is None or running.planned.index != mark.index:
            return
        self._running = None
        if mark.state is StepState.DONE:
            seen_s, beyond_s = self._seen_s[running.work], self._progress_s(mark.time_ns) - running.stated_s
            self._off_s.setdefault(running.work, []).append(beyond_s - self._overhead_s[running.work])
            seen_s.append(beyond_s)
            self._overhead_s[running.work] = median_low(seen_s)

    @property
    def count(self) -> int:
        """How many steps the plan has now."""
        return len(self._steps)

    @property
    def frames(self) -> int:
        """How many frames the plan is expected to give now."""
        return sum(step.frames for step in self._steps)

    def expected_s(self, step_id: str) -> float:
        """Return what a step of the plan is expected to take, or was, from its beginning to its end, s."""
        return self._expected_s[step_id]

    def ends_s(self, now_ns: int) -> dict[str, float]:
        """Return the time from `now_ns` until each step that is under way or to come is expected to be done, s, by its
        id: what follows the last one is what `left_s` has besides."""
        ends: dict[str, float] = {}
        at_s = 0.0
        if self._running is not None:
            at_s = max(0.0, self._from_now_s(self._running) - self._progress_s(now_ns))
            ends[self._running.planned.step_id] = at_s
        for _, step in sorted(self._waiting.items()):
            at_s += self._from_now_s(step)
            ends[step.planned.step_id] = at_s
        return ends

    def within_s(self) -> float | None:
        """Return how much the plan may end earlier or later, s: twice the deviation of the steps so far from what was
        expected of each, for as many of their kind of work as are to come; no less than a minute. None before three are
        done, while the kinds that are still to take half of the time have not been seen, and when none is left."""
        left = self._count + Counter(() if self._running is None else (self._running.work,))
        if sum(map(len, self._off_s.values())) < _LEAST_SEEN or not left.total():
            return None
        known_s = sum(step.duration_s for step in self._waiting.values() if step.work in self._off_s)
        if known_s < _LEAST_SHARE * sum(step.duration_s for step in self._waiting.values()):
            return None
        variance_s2 = sum(left[work] * sum(off * off for off in seen) / len(seen) for work, seen in self._off_s.items())
        return max(_LEAST_WITHIN_S, 2.0 * math.sqrt(variance_s2))

    def event(self, event: Event) -> None:
        """`held`, `released`: a reason to wait came or went; while there is one, the running step gets no further.
        `plan_changed`: an operator has changed what is still to be done. `soak_longer`: the soak under way goes on
        beyond its time. `to_ambient`, `at_ambient`, `not_at_ambient`: the way back begins or ends."""
        if event.kind == HELD:
            self._held_since_ns = event.time_ns if self._held_since_ns is None else self._held_since_ns
            self._reasons.add(event.data.get("reason"))
        elif event.kind == RELEASED:
            self._reasons.discard(event.data.get("reason"))
            if self._held_since_ns is not None and not self._reasons:
                self._held_ns += event.time_ns - self._held_since_ns
                self._held_since_ns = None
        elif event.kind in (PLAN_CHANGED, SOAK_LONGER):
            self.goes_on |= event.kind == SOAK_LONGER
            self._change(event.data)
        elif event.kind == TO_AMBIENT:
            self._after_since_ns = event.time_ns
        elif event.kind in (AT_AMBIENT, NOT_AT_AMBIENT):
            self._after_s = 0.0

    def left_s(self, now_ns: int) -> float:
        """Return the time from `now_ns` until the plan and what follows it are done, s; a pause under way is taken to
        end now."""
        left_s = self._stated_s + sum(count * self._overhead_s[work] for work, count in self._count.items())
        if self._running is not None:
            left_s += max(0.0, self._from_now_s(self._running) - self._progress_s(now_ns))
        gone_s = 0.0 if self._after_since_ns < 0 else (now_ns - self._after_since_ns) / NS_PER_S
        return max(0.0, left_s) + max(0.0, self._after_s - gone_s)

    def _change(self, data: Mapping[str, object]) -> None:
        """What replaces steps is priced by what it states."""
        by, first = data.get("by"), data.get("from_index")
        if isinstance(by, list) and isinstance(first, int):
            for index in range(first, len(self._steps)):
                self._forget(index)
            steps = (make_step(each["kind"], each["parameters"]) for each in cast("list[dict[str, Any]]", by))
            del self._steps[first:]
            found = Situation()
            for planned in number_steps(steps, first):
                price, step = planned.step.price(found, KnownStand()), planned.step
                found, stated_s, work = step.situation_after(found), price.duration_s, step.kind
                self._overhead_s.setdefault(work, 0.0)
                self._seen_s.setdefault(work, deque([0.0], _REMEMBERED))
                self._steps.append(PricedStep(planned, stated_s, step.frame_count, 0.0, work, stated_s))
                self._expected_s[planned.step_id] = stated_s
                self._wait_for(planned.index)
            return
        found = (step.planned.index for step in self._steps if step.planned.step_id == data.get("step_id"))
        by_s = data.get("by_s")
        for index in found:
            step, is_waiting = self._steps[index], self._forget(index)
            if isinstance(by_s, int | float):
                self._expected_s[step.planned.step_id] += by_s
                self._steps[index] = replace(step, stated_s=step.stated_s + by_s, duration_s=step.duration_s + by_s)
                if is_waiting:
                    self._wait_for(index)
            if self._running is step:
                self._running = self._steps[index] if isinstance(by_s, int | float) else None

    def _from_now_s(self, step: PricedStep) -> float:
        """Return what a step that begins now is expected to take."""
        return step.stated_s + self._overhead_s[step.work]

    def _wait_for(self, index: int) -> None:
        self._waiting[index] = step = self._steps[index]
        self._stated_s += step.stated_s
        self._count[step.work] += 1

    def _forget(self, index: int) -> bool:
        """Return whether the step was waited for."""
        waiting = self._waiting.pop(index, None)
        if waiting is not None:
            self._stated_s -= waiting.stated_s
            self._count[waiting.work] -= 1
        return waiting is not None

    def _begin(self, step: PricedStep, time_ns: int) -> None:
        for index in range(step.planned.index + 1, self._first):  # of a warm-up that is restarted
            self._wait_for(index)
        self._first = min(self._first, step.planned.index)
        for index in range(self._first, step.planned.index + 1):
            self._forget(index)
        self._first = max(self._first, step.planned.index + 1)
        self._running, self._begun_ns, self._held_ns = step, time_ns, 0
        if self._held_since_ns is not None:
            self._held_since_ns = time_ns

    def _progress_s(self, now_ns: int) -> float:
        held_ns = self._held_ns + (0 if self._held_since_ns is None else now_ns - self._held_since_ns)
        return (now_ns - self._begun_ns - held_ns) / NS_PER_S


def _subtract_soaked(step: PricedStep, soaked_s: float) -> PricedStep:
    soaked_s = min(soaked_s, step.stated_s)
    return replace(step, stated_s=step.stated_s - soaked_s, duration_s=step.duration_s - soaked_s)
