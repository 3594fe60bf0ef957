"""What passes through a stand and into its recording: batches of readings, frames, events, steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from thermostand.foundation.readings import Frame, Reading


class StepState(StrEnum):
    """Where a step of the plan is. skipped: left out, or broken off, by an operator."""

    STARTED = "started"
    DONE = "done"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class StepMark:
    """A step of the plan began or ended.

    Attributes
    ----------
    time_ns
        The instant, ns of the stand's clock.
    step_id, index, kind
        The step's id, its place in the plan from 0, and what it does.
    state
        Whether it began, or how it ended.
    parameters
        The step's own fields as JSON-able values.
    """

    time_ns: int
    step_id: str
    index: int
    kind: str
    state: StepState
    parameters: dict[str, object] = field(default_factory=dict[str, object])


@dataclass(frozen=True, slots=True)
class Event:
    """Something to be known later: a fault, a gap, a trip, the end of a run.

    Attributes
    ----------
    time_ns
        The instant, ns of the stand's clock.
    kind, data
        For programs: a kind of the table of events, and its fields as JSON-able values. Nothing is read out of a
        sentence.
    text
        For people.
    level
        "info", "warning" or "error".
    """

    time_ns: int
    level: str
    kind: str
    text: str
    data: Mapping[str, object] = field(default_factory=dict[str, object])


@dataclass(frozen=True, slots=True)
class Batch:
    """What one poll of one device gave, together."""

    device: str
    time_ns: int
    readings: tuple[Reading, ...]


@dataclass(frozen=True, slots=True)
class Original:
    """A picture file as a device gave it, unchanged: `data` is the whole of it, `name` without a folder."""

    time_ns: int
    device: str
    name: str
    data: bytes


Item = Batch | Frame | Event | StepMark | Original
