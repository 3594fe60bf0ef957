"""What a rule of the guard is: what it may look at, what it objects to, and how long it must to be believed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from pydantic import JsonValue

from thermostand.foundation.clock import to_ns
from thermostand.foundation.events import get_guard_kind
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Reading


class Readings(Protocol):
    """What a rule may look at; the hub is one."""

    def latest(self, channel: str) -> Reading | None:
        """The last reading, of any quality."""
        ...

    def known(self, channel: str) -> Reading | None:
        """The last reading that is not BAD by the wire."""
        ...

    def last_good_ns(self, channel: str) -> int | None:
        """Return when the channel was last measured, GOOD or with a suspect value."""
        ...


# abort: make safe and end the run. hold: make safe and wait for an operator. warn: say so.
Action = Literal["abort", "hold", "warn"]
DONE: dict[str, Action] = {"trip": "abort", "hold": "hold", "warn": "warn"}
"""What a stand's file calls them."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What a rule objects to, and what has to be done about it.

    ends_itself: the hold is over when the rule objects no more; else an operator has to reset it. cuts_camera: the
    camera's supply is switched off as well. channels: the two that contradict each other, where a rule compares them;
    suspect: which of them moved unlike the rest, "" where that cannot be determined.
    """

    rule: str
    text: str
    action: Action = "abort"
    ends_itself: bool = False
    cuts_camera: bool = False
    channels: tuple[str, ...] = ()
    suspect: str = ""

    @property
    def data(self) -> dict[str, JsonValue]:
        """What a program needs to know of it besides its words."""
        compared: dict[str, JsonValue] = {"channels": list(self.channels), "suspect": self.suspect}
        return {"action": self.action, "ends_itself": self.ends_itself, **(compared if self.channels else {})}

    def make_event(self, time_ns: int) -> Event:
        """Make the event that the rule objects."""
        return get_guard_kind(self.rule).at(time_ns, self.text, rule=self.rule, **self.data)


Rule = Callable[[Readings, int], Fault | None]


@dataclass(slots=True)
class Watch:
    """A rule, how long it must object without a break before it counts (s), and what is then done.

    objection: the rule's at the last check, within its grace time, too. after_gap_s: for so long after a look that came
    late its objection does not count, because it judges by how old something is that could not be renewed meanwhile.
    Permits wait for fresh readings all that time.
    """

    rule: Rule
    grace_s: float = 0.0
    action: Action = "abort"
    since_ns: int | None = None
    objection: Fault | None = None
    ends_itself: bool = False
    after_gap_s: float = 0.0

    def check(self, readings: Readings, now_ns: int) -> Fault | None:
        """The rule's fault once it has stood for the grace time."""
        fault = self.objection = self.rule(readings, now_ns)
        if fault is None:
            self.since_ns = None
            return None
        if self.since_ns is None:
            self.since_ns = now_ns
        if now_ns - self.since_ns < to_ns(self.grace_s):
            return None
        lasting = f", for {self.grace_s:g} s" if self.grace_s > 0 else ""
        return replace(fault, text=fault.text + lasting, action=self.action, ends_itself=self.ends_itself)


def get_value(readings: Readings, channel: str) -> float:
    """The last known value, over polls that failed on the wire: whether it is too old, `require_fresh_reading` judges.
    NaN when the device says itself that it has none, or it was never read, and every comparison with that is false."""
    reading = readings.known(channel)
    return math.nan if reading is None else reading.value


def is_suspect(readings: Readings, channel: str) -> bool:
    """Return whether its last value is not to be believed."""
    reading = readings.known(channel)
    return reading is not None and reading.cause == "suspect"
