"""What of a session is not there: by the numbers of its segments, by images and descriptions that lack each other, by
its journal, and by its own record when it is a copy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby

from thermostand.recording.format.chain import missing_segments
from thermostand.recording.format.holes import Hole
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.utc_offsets import offsets_of
from thermostand.recording.reading.contents import Contents, FrameKey
from thermostand.recording.reading.coverage import Coverage
from thermostand.recording.reading.ends import lost_end
from thermostand.recording.reading.frame_account import FrameAccount, frame_account
from thermostand.recording.reading.gaps import reported_blocks
from thermostand.recording.reading.journal_lines import JournalFacts


def find_holes(
    coverage: Coverage,
    contents: Contents,
    image_times_ns: Iterable[int],
    journal: JournalFacts | None,
    *,
    is_part: bool,
) -> tuple[Hole, ...]:
    """The holes of the telemetry, then of the frames. `contents`: descriptions, events and step marks. `is_part`: the
    session was cut out of another one, whose journal and end it has not."""
    images = Counter((time_ns, 0) for time_ns in image_times_ns)
    described = Counter((key[0], 0) for key, _ in contents.metas)
    block_ids = {(key[0], 0): meta.block_id for key, meta in contents.metas}
    account = frame_account(images, block_ids, described, reported_blocks(contents.events), coverage)
    gaps = {series: tuple(_gaps(series, coverage)) for series in (TELEMETRY, FRAMES)}
    if not is_part:
        has_gap = gaps[TELEMETRY] or any(hole.series == TELEMETRY for hole in coverage.holes)
        marks = () if has_gap else contents.marks
        lost = lost_end(coverage, contents.events, marks, journal, offsets_of(contents.events))
        gaps[TELEMETRY] += () if lost is None else (replace(lost.hole, end_ns=None),)
    every = sorted(set(images) | set(described))
    return (
        *coverage.holes,
        *_with_frames(TELEMETRY, gaps[TELEMETRY], account.bare, coverage, every),
        *_with_frames(FRAMES, gaps[FRAMES], account.gone, coverage, every),
        *_excused(account, every),
    )


def _gaps(series: str, coverage: Coverage) -> Iterator[Hole]:
    numbers = (link.number for link in coverage.links.values() if link.series == series)
    return missing_segments(series, numbers, coverage.links.values())


def _with_frames(
    series: str, gaps: Sequence[Hole], keys: Iterable[FrameKey], coverage: Coverage, every: Sequence[FrameKey]
) -> Iterator[Hole]:
    """The gaps with the number of frames that went with them, then what is missing without a missing number: behind the
    last segment, or in between."""
    counts: Counter[Hole] = Counter()
    loose: set[FrameKey] = set()
    links = [link for link in coverage.links.values() if link.series == series]
    ends_ns = [int(link.last_ns) for link in links if link.count]
    tail = Hole(series, max((link.number for link in links), default=-1) + 1, None, max(ends_ns, default=None), None)
    candidates = gaps if any(gap.last is None for gap in gaps) else (*gaps, tail)
    for key in keys:
        hole = next((hole for hole in candidates if hole.covers(key[0])), None)
        if hole is None:
            loose.add(key)
        else:
            counts[hole] += 1
    yield from (replace(hole, frames=counts[hole]) for hole in candidates if hole in gaps or counts[hole])
    yield from _stretches(series, loose, every)


def _stretches(series: str, keys: set[FrameKey], every: Sequence[FrameKey], *, excused: bool = False) -> Iterator[Hole]:
    """Frames that follow each other without a sound one between them are one stretch."""
    for is_lost, group in groupby(every, key=keys.__contains__):
        if is_lost:
            times_ns = [time_ns for time_ns, _ in group]
            yield Hole(series, None, None, times_ns[0] - 1, times_ns[-1] + 1, len(times_ns), excused)


def _excused(account: FrameAccount, every: Sequence[FrameKey]) -> Iterator[Hole]:
    yield from _stretches(TELEMETRY, set(account.bare_torn), every, excused=True)
    yield from _stretches(FRAMES, {*account.gone_reported, *account.gone_torn}, every, excused=True)
