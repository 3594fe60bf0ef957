"""Sound chunks that are not of their place: a disk has written a sector to the wrong one, with whole chunks in it.

Such a sector begins and ends somewhere in other chunks, so it stands between two damages. What it holds stands in the
file once more, or is of another session, and so of another time than what is around it.
"""

from __future__ import annotations

from bisect import bisect
from collections import Counter
from collections.abc import Sequence
from itertools import accumulate, pairwise
from math import inf
from typing import NamedTuple

from thermostand.foundation.clock import NS_PER_S
from thermostand.recording.format.mcap_bytes import ChunkHead

SECTOR_BYTES = 4096  # the largest of today's disks
APART_NS = 10 * NS_PER_S
"""Chunks are in the order in which they were published, but for what was seconds late. Sessions that lie closer
together than this, as those in virtual time may, are not told apart."""


class Span(NamedTuple):
    """Bytes [begin, end) of a file."""

    begin: int
    end: int


class PlacedChunk(NamedTuple):
    """A sound chunk, where it begins, and how many messages of each channel it has."""

    begin: int
    head: ChunkHead
    messages: Counter[int]


def find_misplaced_chunks(chunks: Sequence[PlacedChunk], damages: Sequence[Span]) -> list[Span]:
    """Where such sectors are: from the begin of the damage before to the end of the one behind."""
    near = [pair for pair in pairwise(damages) if pair[1].begin - pair[0].end <= SECTOR_BYTES]
    if not near:
        return []
    ends = [before.end for before, _ in near]
    inside: list[list[PlacedChunk]] = [[] for _ in near]
    trusted: list[PlacedChunk] = []
    for chunk in chunks:
        index = bisect(ends, chunk.begin) - 1
        is_between = index >= 0 and chunk.begin < near[index][1].begin
        (inside[index] if is_between else trusted).append(chunk)
    begins = [chunk.begin for chunk in trusted]
    since_ns = [-inf, *accumulate((chunk.head.first_ns for chunk in trusted), max)]
    until_ns = [inf, *accumulate((chunk.head.last_ns for chunk in reversed(trusted)), min)][::-1]
    copies = Counter(chunk.head for chunk in chunks)

    def is_misplaced(chunk: PlacedChunk) -> bool:
        place, head = bisect(begins, chunk.begin), chunk.head
        is_late, is_early = head.first_ns > until_ns[place] + APART_NS, head.last_ns < since_ns[place] - APART_NS
        return copies[head] > 1 or is_late or is_early

    return [
        Span(before.begin, after.end)
        for (before, after), found in zip(near, inside, strict=True)
        if any(map(is_misplaced, found))
    ]
