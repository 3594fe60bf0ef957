"""What a recorded session is, from all of its telemetry, as far as it can be read. Damage and unfinished segments are
part of the answer, not a reason to give none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import RUN_END, TELL_PLAN
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format.inventory import SegmentFile, State
from thermostand.recording.format.layout import FRAMES
from thermostand.recording.format.messages import FrameMeta
from thermostand.recording.format.records import frame_places, telemetry_messages
from thermostand.recording.format.utc_offsets import UtcOffsets, offsets_of
from thermostand.recording.reading.contents import Channel, Contents
from thermostand.recording.reading.gaps import Silence, reported_blocks, silences
from thermostand.recording.reading.glance import Glance, glance, within
from thermostand.recording.reading.run_word import Files


@dataclass(frozen=True, slots=True)
class Step:
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
class Temperature:
    """One channel in degC; min, mean and max are NaN when every reading was BAD."""

    channel: str
    count: int
    bad: int
    min_degC: float
    mean_degC: float
    max_degC: float


@dataclass(frozen=True, slots=True)
class Frames:
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
    """All that `stand session info` shows. `troubles` are the glance's and what reading the telemetry added."""

    glance: Glance
    troubles: tuple[str, ...]
    steps: tuple[Step, ...]
    frames: Frames
    temperatures: tuple[Temperature, ...]
    gaps: tuple[Silence, ...]
    events: tuple[Event, ...]

    @property
    def state(self) -> Files:
        """Whether the files are sound, by what was read."""
        return Files.DAMAGED if self.troubles else self.glance.state

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

    @property
    def utc(self) -> UtcOffsets:
        """From its instants to UTC as the host's system clock had it."""
        return offsets_of(self.events)


@dataclass
class _Reading:
    """What has been read of the segments so far."""

    directory: Path
    contents: Contents = field(default_factory=Contents)
    metas: list[FrameMeta] = field(default_factory=list[FrameMeta])
    troubles: list[str] = field(default_factory=list[str])

    def read(self, file: SegmentFile) -> None:
        """A finished segment, as far as it goes."""
        try:
            if file.series == FRAMES:
                self.metas.extend(place.meta for place in frame_places(file.path))
                return
            for message in telemetry_messages(file.path, lambda channel: True):
                self.contents.receive(message)
        except SessionError as error:
            self.troubles.append(within(self.directory, error))


def overview(path: Path) -> Overview:
    """The session in `path`, all its telemetry read; SessionError when there is none."""
    seen = glance(path)
    read = _Reading(path)
    for file in seen.files:
        if file.state is State.FINISHED:
            read.read(file)
    contents = read.contents
    frames = _frames(seen, read)  # before the troubles are listed, which it may add to
    times_ns = {name: channel.sorted_times_ns() for name, channel in contents.channels.items()}
    return Overview(
        seen,
        tuple(dict.fromkeys((*seen.troubles, *read.troubles))),
        tuple(_steps(contents, read.metas)),
        frames,
        tuple(_temperature(name, channel) for name, channel in sorted(contents.channels.items()) if channel.is_degC),
        tuple(silences(times_ns)),
        tuple(sorted(contents.events, key=lambda event: event.time_ns)),
    )


def _steps(contents: Contents, metas: Sequence[FrameMeta]) -> Iterator[Step]:
    """The steps in order of their index; of one that was begun again the last time counts."""
    by_camera = Counter((meta.step_id, meta.channel) for meta in metas)
    frames = Counter[str]()
    for (of_step, _), count in by_camera.items():
        frames[of_step] = max(frames[of_step], count)
    last: dict[str, list[StepMark]] = {}
    for mark in sorted(contents.marks, key=lambda mark: mark.time_ns):
        if mark.state is StepState.STARTED or mark.step_id not in last:
            last[mark.step_id] = []
        last[mark.step_id].append(mark)
    for step_id, marks in sorted(last.items(), key=lambda item: item[1][0].index):
        first, end = marks[0], marks[-1]
        end_ns = None if end.state is StepState.STARTED else end.time_ns
        yield Step(
            first.index, step_id, first.kind, first.parameters, end.state, first.time_ns, end_ns, frames[step_id]
        )


def _frames(seen: Glance, read: _Reading) -> Frames:
    size_bytes = sum(file.size_bytes for file in seen.files if file.series == FRAMES)
    metas = read.metas
    times_ns = [meta.time_ns for meta in metas]
    return Frames(
        len(metas),
        size_bytes,
        f"{metas[0].width} x {metas[0].height} px, {metas[0].significant_bits} bit" if metas else "",
        min(times_ns, default=None),
        max(times_ns, default=None),
        sum(meta.dropped for meta in metas),
        sum(map(len, reported_blocks(read.contents.events))),
        Counter(flag for meta in metas for flag in meta.flags),
    )


def _temperature(name: str, channel: Channel) -> Temperature:
    values = np.array(channel.values, np.float64)
    good = values[~np.isnan(values)]
    bad = len(values) - len(good)
    if not len(good):
        return Temperature(name, len(values), bad, np.nan, np.nan, np.nan)
    return Temperature(name, len(values), bad, float(good.min()), float(good.mean()), float(good.max()))
