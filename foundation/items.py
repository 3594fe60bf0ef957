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
    """A step of the plan began or ended. `parameters` are the step's own fields as JSON-able values."""

    time_ns: int
    step_id: str
    index: int
    kind: str
    state: StepState
    parameters: dict[str, object] = field(default_factory=dict[str, object])


@dataclass(frozen=True, slots=True)
class Event:
    """Something to be known later: a fault, a gap, a trip, the end of a run. level: info, warning or error.

    `text` is for people, `kind` and `data` (JSON-able fields) are for programs: nothing is read out of a sentence.
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
