"""What a recorded session is, from all of its telemetry, as far as it can be read. Damage and unfinished segments are
part of the answer, not a reason to give none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from thermostand.foundation.events import RUN_END, TELL_PLAN
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format.layout import FRAMES
from thermostand.recording.reading.gaps import Silence, find_silences, list_reported_blocks
from thermostand.recording.reading.scan import ChannelReadings, Depth, Recorded, Scan, scan


@dataclass(frozen=True, slots=True)
class RunStep:
    """A step of the plan as it went; end_ns None and state STARTED: the recording has no end of it."""

    index: int
    step_id: str
    kind: str
    parameters: dict[str, object]
    state: StepState
    begin_ns: int
    end_ns: int | None
    frames: int


@dataclass(frozen=True, slots=True)
class ChannelRange:
    """One channel, in its unit; min, mean and max are NaN when every reading was BAD."""

    channel: str
    unit: str
    count: int
    bad: int
    min: float
    mean: float
    max: float


@dataclass(frozen=True, slots=True)
class FramesSummary:
    """The images. `pixels`: those of the first, as in `2448 x 2048 px, 12 bit`, "" without any. dropped: frames that
    the camera or its wire lost, as the descriptions say.
    lost_by_recorder: frames of which its events say so. flagged: how many have each flag."""

    count: int
    size_bytes: int
    pixels: str
    first_ns: int | None
    last_ns: int | None
    dropped: int
    lost_by_recorder: int
    flagged: Mapping[str, int] = field(default_factory=dict[str, int])


@dataclass(frozen=True, slots=True)
class Overview:
    """All that `stand session info` shows."""

    scanned: Scan
    steps: tuple[RunStep, ...]
    frames: FramesSummary
    channels: tuple[ChannelRange, ...]
    gaps: tuple[Silence, ...]
    events: tuple[Event, ...]

    @property
    def planned_steps(self) -> int | None:
        """How many steps the plan of the run has, None when that is not recorded."""
        begins = [event.data.get("steps") for event in self.events if event.kind in TELL_PLAN]
        planned = begins[-1] if begins else None
        return planned if isinstance(planned, int) else None

    @property
    def ending(self) -> Event | None:
        """How the run ended, None when that is not recorded."""
        return next((event for event in reversed(self.events) if event.kind == RUN_END), None)


def summarise_session(path: Path) -> Overview:
    """The session in `path`, all its telemetry read; SessionError when there is none."""
    found = scan(path, Depth.TELEMETRY)
    recorded = found.recorded
    times_ns = {name: channel.sorted_times_ns() for name, channel in recorded.channels.items()}
    return Overview(
        found,
        tuple(_list_steps(recorded)),
        _summarise_frames(found),
        tuple(_range(name, channel) for name, channel in sorted(recorded.channels.items())),
        tuple(find_silences(times_ns)),
        tuple(sorted(recorded.events, key=lambda event: event.time_ns)),
    )


def _list_steps(recorded: Recorded) -> Iterator[RunStep]:
    """The steps in order of their index; of one that was begun again the last time counts."""
    by_camera = Counter((meta.step_id, meta.channel) for meta in recorded.metas)
    frames = Counter[str]()
    for (of_step, _), count in by_camera.items():
        frames[of_step] = max(frames[of_step], count)
    last: dict[str, list[StepMark]] = {}
    for mark in sorted(recorded.marks, key=lambda mark: mark.time_ns):
        if mark.state is StepState.STARTED or mark.step_id not in last:
            last[mark.step_id] = []
        last[mark.step_id].append(mark)
    for step_id, marks in sorted(last.items(), key=lambda item: item[1][0].index):
        first, end = marks[0], marks[-1]
        end_ns = None if end.state is StepState.STARTED else end.time_ns
        yield RunStep(
            index=first.index,
            step_id=step_id,
            kind=first.kind,
            parameters=first.parameters,
            state=end.state,
            begin_ns=first.time_ns,
            end_ns=end_ns,
            frames=frames[step_id],
        )


def _summarise_frames(found: Scan) -> FramesSummary:
    size_bytes = sum(file.size_bytes for file in found.inventory if file.series == FRAMES)
    recorded = found.recorded
    metas = recorded.metas
    times_ns = [meta.time_ns for meta in metas]
    return FramesSummary(
        count=len(metas),
        size_bytes=size_bytes,
        pixels=f"{metas[0].width} x {metas[0].height} px, {metas[0].significant_bits} bit" if metas else "",
        first_ns=min(times_ns, default=None),
        last_ns=max(times_ns, default=None),
        dropped=sum(meta.dropped for meta in metas),
        lost_by_recorder=sum(map(len, list_reported_blocks(recorded.events))),
        flagged=Counter(flag for meta in metas for flag in meta.flags),
    )


def _range(name: str, channel: ChannelReadings) -> ChannelRange:
    values = np.array(channel.values, np.float64)
    good = values[~np.isnan(values)]
    ends = (float(good.min()), float(good.mean()), float(good.max())) if len(good) else (np.nan, np.nan, np.nan)
    return ChannelRange(name, channel.unit, len(values), len(values) - len(good), *ends)
