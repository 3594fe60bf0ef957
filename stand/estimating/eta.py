"""The time left of a running plan, from its estimate and from what its steps have taken so far."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from statistics import median_low
from types import MappingProxyType

from foundation.clock import NS_PER_S
from foundation.items import Event, StepMark, StepState
from stand.estimating.estimate import PricedStep

_REMEMBERED = 9  # the last measurements of a kind of work count


class Eta:
    """Follows a run by its step marks and says how long it will still take on the stand's clock.

    What work of a kind takes beyond what is stated is the lower median of the estimate and what the run has measured:
    a single delay, such as a pause that nobody told of, changes nothing. Steps before the running one are never waited
    for.

    Of a run that goes on after an interruption, `done` are the ids of steps that are done, `earned_s` what others have
    earned of what is stated, by their ids.
    """

    def __init__(
        self,
        steps: Sequence[PricedStep],
        done: Collection[str] = (),
        earned_s: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self._steps = [_owed(step, earned_s.get(step.planned.step_id, 0.0)) for step in steps]
        self._waiting = {step.planned.index: step for step in self._steps if step.planned.step_id not in done}
        self._first = min(self._waiting, default=0)
        self._stated_s = sum(step.stated_s for step in self._waiting.values())
        self._count = Counter(step.work for step in self._waiting.values())
        self._overhead_s = {step.work: step.duration_s - step.stated_s for step in steps}
        self._seen_s = {work: deque([usual_s], _REMEMBERED) for work, usual_s in self._overhead_s.items()}
        self._running: PricedStep | None = None
        self._begun_ns = 0
        self._reasons: set[object] = set()
        self._held_since_ns: int | None = None
        self._held_ns = 0  # of the running step

    def mark(self, mark: StepMark) -> None:
        """A step began or ended."""
        if not 0 <= mark.index < len(self._steps):
            return
        if mark.state is StepState.STARTED:
            self._begin(self._steps[mark.index], mark.time_ns)
            return
        running, self._running = self._running, None
        if running is not None and mark.state is StepState.DONE:
            seen_s = self._seen_s[running.work]
            seen_s.append(self._progress_s(mark.time_ns) - running.stated_s)
            self._overhead_s[running.work] = median_low(seen_s)

    def event(self, event: Event) -> None:
        """`held`, `released`: a reason to wait came or went; while there is one, the running step gets no further."""
        if event.kind == "held":
            self._held_since_ns = event.time_ns if self._held_since_ns is None else self._held_since_ns
            self._reasons.add(event.data.get("reason"))
        elif event.kind == "released":
            self._reasons.discard(event.data.get("reason"))
            if self._held_since_ns is not None and not self._reasons:
                self._held_ns += event.time_ns - self._held_since_ns
                self._held_since_ns = None

    def left_s(self, now_ns: int) -> float:
        """From `now_ns` until the plan is done, s; a pause that is under way is taken to end now."""
        left_s = self._stated_s + sum(count * self._overhead_s[work] for work, count in self._count.items())
        if self._running is not None:
            expected_s = self._running.stated_s + self._overhead_s[self._running.work]
            left_s += max(0.0, expected_s - self._progress_s(now_ns))
        return max(0.0, left_s)

    def _begin(self, step: PricedStep, time_ns: int) -> None:
        for index in range(step.planned.index + 1, self._first):  # of a warm-up that begins anew
            self._waiting[index] = again = self._steps[index]
            self._stated_s += again.stated_s
            self._count[again.work] += 1
        self._first = min(self._first, step.planned.index)
        for index in range(self._first, step.planned.index + 1):
            waiting = self._waiting.pop(index, None)
            if waiting is not None:
                self._stated_s -= waiting.stated_s
                self._count[waiting.work] -= 1
        self._first = max(self._first, step.planned.index + 1)
        self._running, self._begun_ns, self._held_ns = step, time_ns, 0
        if self._held_since_ns is not None:
            self._held_since_ns = time_ns

    def _progress_s(self, now_ns: int) -> float:
        held_ns = self._held_ns + (0 if self._held_since_ns is None else now_ns - self._held_since_ns)
        return (now_ns - self._begun_ns - held_ns) / NS_PER_S


def _owed(step: PricedStep, earned_s: float) -> PricedStep:
    earned_s = min(earned_s, step.stated_s)
    return replace(step, stated_s=step.stated_s - earned_s, duration_s=step.duration_s - earned_s)
