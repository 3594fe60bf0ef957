"""Shows a run while it goes: which step, how much of the night is left, when it will be done, and what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType

from foundation.clock import NS_PER_S, seconds_ns
from foundation.instants import duration
from foundation.items import Event, Item, StepMark
from foundation.progress import Report
from recording.format.utc_offsets import CLOCK_STEP, UtcOffsets, offsets_of
from stand.estimating.estimate import PricedStep
from stand.estimating.eta import Eta

_LEAST_S = 1.0  # of stand time between two reports, or a thousandth of the night: terminals are slow
_SHARE = 1e-3


class Follow:
    """A subscriber of the hub. It reports progress as expected stand seconds of the whole plan, which is what the plan
    takes on the clock of the stand: in virtual time the bar's own time left is wall time, the text's is stand time.

    `report`: of a progress with the total `total_s`. `warn(line)`: gets warnings and errors as they come. `done`,
    `earned_s`: as Eta has them.
    """

    def __init__(
        self,
        steps: Sequence[PricedStep],
        report: Report,
        warn: Callable[[str], None],
        done: Collection[str] = (),
        earned_s: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.eta = Eta(steps, done, earned_s)
        self._total_s = max(sum(step.duration_s for step in steps), 1e-9)
        self._report, self._warn = report, warn
        self._step = ""
        self._begin_ns: int | None = None
        self._utc = UtcOffsets()  # as it is now
        self._next_ns = 0

    def __call__(self, item: Item) -> None:
        """Follow one item; a terminal that is gone is no reason for a run to end."""
        with suppress(OSError):
            self._follow(item)

    def _follow(self, item: Item) -> None:
        if isinstance(item, Event):
            self.eta.event(item)
            self._utc = offsets_of([item]) if item.kind == CLOCK_STEP else self._utc
            if item.level != "info":
                self._warn(f"{item.level}: {self._utc.local_text(item.time_ns)[11:]} {item.text}")
            return
        if isinstance(item, StepMark):
            self.eta.mark(item)
            self._step = f"{item.index + 1}/{self.eta.count} {item.kind} {parameters_text(item.parameters)}".rstrip()
            self._begin_ns = item.time_ns if self._begin_ns is None else self._begin_ns
            self._next_ns = item.time_ns
        if self._begin_ns is not None and item.time_ns >= self._next_ns:
            self._tell(item.time_ns, self._begin_ns)

    def _tell(self, now_ns: int, begin_ns: int) -> None:
        self._next_ns = now_ns + seconds_ns(max(_LEAST_S, _SHARE * self._total_s))
        left_s, gone_s = self.eta.left_s(now_ns), (now_ns - begin_ns) / NS_PER_S
        left_ns = seconds_ns(left_s)
        done_s = self._total_s * gone_s / max(gone_s + left_s, 1e-9)
        end = self._utc.date_time(now_ns + left_ns)[:16]
        self._report(done_s, f"until {end} ({duration(left_ns)} of stand time); {self._step}")


def parameters_text(parameters: Mapping[str, object]) -> str:
    """`frames=2 interval_s=0.5`."""
    return " ".join(f"{name}={value}" for name, value in parameters.items())
