"""What the soaks have earned, in memory and in the journal."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from experiments.steps import AnySoak, PlannedStep, longest_s
from foundation.clock import NS_PER_S, Clock, seconds_ns
from stand.running.journal import Dwell, Journal


class Earned:
    """`earned_s`: what an earlier daemon has journaled, by id. A soak in `done` that is not listed has earned all of
    it."""

    def __init__(self, earned_s: Mapping[str, float], done: Collection[str], journal: Journal, clock: Clock) -> None:
        self._earned_ns = {step_id: seconds_ns(each_s) for step_id, each_s in earned_s.items()}
        self._done = done
        self._journal = journal
        self._clock = clock

    def owed_ns(self, soak: PlannedStep) -> int:
        """What the soak has not earned yet."""
        duration_ns = duration_of(soak)
        earned_ns = self._earned_ns.get(soak.step_id, duration_ns if soak.step_id in self._done else 0)
        return max(0, duration_ns - earned_ns)

    def is_begun(self, soak: PlannedStep) -> bool:
        """Whether there is anything to lose."""
        return soak.step_id in self._done or self._earned_ns.get(soak.step_id, 0) > 0

    async def earn(self, soak: PlannedStep, earned_ns: int) -> None:
        """It has earned so much in all."""
        self._earned_ns[soak.step_id] = earned_ns
        await self._journal.write(Dwell(self._clock.now_ns(), soak.step_id, earned_ns / NS_PER_S))

    async def lose(self, soaks: Iterable[PlannedStep]) -> None:
        """They have earned nothing."""
        lost = tuple(soaks)
        self._earned_ns.update((soak.step_id, 0) for soak in lost)
        now_ns = self._clock.now_ns()
        await self._journal.write(*(Dwell(now_ns, soak.step_id, 0.0) for soak in lost))

    def forget(self, step_id: str) -> None:
        """The step is done: it owes nothing."""
        self._earned_ns.pop(step_id, None)


def duration_of(soak: PlannedStep) -> int:
    """What the soak takes when it is not cut short, ns; 0 when it is no soak."""
    return seconds_ns(longest_s(soak.step)) if isinstance(soak.step, AnySoak) else 0
