"""Where a recording has holes.

A channel is silent when two readings follow each other at more than max(3 x its median spacing, 5 s), or when it
begins that much after the recording or ends that much before it; a failed read is a reading (BAD), not silence.
Channels of a device that were silent together are one silence, and so are devices, within their own spacing.

Frames are missing where the camera or its wire lost some (`dropped` of the frame after them), where the recorder lost
some (its events `frames_dropped` say which), and where a step that is done has fewer than it says.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import FRAMES_DROPPED
from thermostand.foundation.instants import format_duration
from thermostand.foundation.items import Event
from thermostand.recording.format.utc_offsets import UtcOffsets

# At 1 Hz up to four missed polls are no hole. Round numbers; nothing was measured.
SHORTEST_NS = 5 * NS_PER_S
MEDIANS = 3  # round number; nothing was measured
_LAST_BLOCK = 2**62
_RHYTHM = 3  # readings; with fewer there is no spacing to compare with


@dataclass(frozen=True, slots=True)
class Silence:
    """A span without readings between two instants, ns; `names` are devices, or single channels of a device, or
    "everything"."""

    names: tuple[str, ...]
    begin_ns: int
    end_ns: int

    def text(self, utc: UtcOffsets) -> str:
        """The silence as a sentence."""
        verb = "was" if len(self.names) == 1 else "were"
        span = f"from {utc.date_time(self.begin_ns)} to {utc.local_text(self.end_ns)}"
        return f"{', '.join(self.names)} {verb} silent {span} ({format_duration(self.end_ns - self.begin_ns)})"


@dataclass(frozen=True, slots=True)
class _Hole:
    """A hole in one device; `limit_ns` is what its spacing allows."""

    device: str
    channels: frozenset[str]
    begin_ns: int
    end_ns: int
    limit_ns: int


def find_silences(times_ns: Mapping[str, NDArray[np.int64]]) -> list[Silence]:
    """The silences in order of time; `times_ns` are the instants of each channel's readings, shape (n,), ascending."""
    recorded = {channel: times for channel, times in times_ns.items() if len(times) >= _RHYTHM}
    if not recorded:
        return []
    begin_ns = min(int(times[0]) for times in recorded.values())
    end_ns = max(int(times[-1]) for times in recorded.values())
    channels_of: dict[str, frozenset[str]] = {}
    for channel in recorded:
        channels_of[_get_device(channel)] = channels_of.get(_get_device(channel), frozenset()) | {channel}
    together: list[list[_Hole]] = []
    for hole in _find_holes(recorded, begin_ns, end_ns):
        group = next((group for group in reversed(together) if _is_same_gap(group[0], hole)), None)
        if group is None:
            together.append([hole])
        else:
            group.append(hole)
    return [_make_silence(group, channels_of) for group in together]


def _get_device(channel: str) -> str:
    return channel.partition(".")[0]


def _find_holes(recorded: Mapping[str, NDArray[np.int64]], begin_ns: int, end_ns: int) -> list[_Hole]:
    """The holes of every channel, those of a device that are the same as one, in order of time."""
    found: dict[tuple[str, int, int], _Hole] = {}
    for channel, times_ns in recorded.items():
        spacings_ns = np.diff(times_ns)
        limit_ns = max(round(MEDIANS * float(np.median(spacings_ns))), SHORTEST_NS)
        edges_ns = np.concatenate(([begin_ns], times_ns, [end_ns]))
        for index in np.flatnonzero(np.diff(edges_ns) > limit_ns):
            key = _get_device(channel), int(edges_ns[index]), int(edges_ns[index + 1])
            known = found.get(key, _Hole(*key[:1], frozenset(), *key[1:], limit_ns))
            found[key] = replace(known, channels=known.channels | {channel})
    return sorted(found.values(), key=lambda hole: (hole.begin_ns, hole.end_ns, hole.device))


def _is_same_gap(one: _Hole, other: _Hole) -> bool:
    """Return whether two devices stopped and came back together, within their spacing."""
    tolerance_ns = max(one.limit_ns, other.limit_ns)
    return (
        one.device != other.device
        and abs(one.begin_ns - other.begin_ns) <= tolerance_ns
        and abs(one.end_ns - other.end_ns) <= tolerance_ns
    )


def _make_silence(group: Sequence[_Hole], channels_of: Mapping[str, frozenset[str]]) -> Silence:
    """The time all of the group were silent."""
    is_all = all(hole.channels == channels_of[hole.device] for hole in group)
    if is_all and len(channels_of) > 1 and {hole.device for hole in group} == set(channels_of):
        names: tuple[str, ...] = ("everything",)
    else:
        names = tuple(name for hole in group for name in _list_names(hole, channels_of[hole.device]))
    return Silence(names, max(hole.begin_ns for hole in group), min(hole.end_ns for hole in group))


def _list_names(hole: _Hole, channels: frozenset[str]) -> list[str]:
    return [hole.device] if hole.channels == channels else sorted(hole.channels)


def count_lost_frames(step_id: str, events: Iterable[Event]) -> int:
    """Return how many frames the recorder itself reported as lost in events that name this step; 0 when none."""
    of_it: list[Event] = []
    for event in events:
        steps = event.data.get("steps") if event.kind == FRAMES_DROPPED else []
        if steps is None or (isinstance(steps, list) and step_id in steps):
            of_it.append(event)
    return sum(map(len, list_reported_blocks(of_it)))


def list_reported_blocks(events: Iterable[Event]) -> list[range]:
    """The block ids of frames that the recorder itself reported as lost: `blocks` of the events' data, pairs of the
    first and the last. What is no such pair is left out: a session may be from anybody."""
    reported = [event.data.get("blocks") for event in events if event.kind == FRAMES_DROPPED]
    pairs = [pair for blocks in reported if isinstance(blocks, list) for pair in cast("list[object]", blocks)]
    return [range(first, last + 1) for first, last in map(_parse_pair, pairs) if 0 <= first <= last <= _LAST_BLOCK]


def _parse_pair(found: object) -> tuple[int, int]:
    """Return two whole numbers; (0, -1) when it is something else."""
    match found:
        case [int(first), int(last)]:
            return first, last
        case _:
            return 0, -1
