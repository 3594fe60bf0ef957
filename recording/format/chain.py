"""The segments of a session as a chain: each says of which session it is, of which series, and which number it has.

A segment whose record contradicts its name was doubled, swapped or renamed; one with another session's record is from
elsewhere. Missing numbers are ranges: a file of any number costs nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

from thermostand.recording.format.holes import Hole
from thermostand.recording.format.layout import SESSION_CRC, segment_metadata

MOST_MISSING = 10_000  # segments; a night has hundreds


@dataclass(frozen=True, slots=True)
class Link:
    """A finished segment: its place, between which instants its messages are (`count` of them), and whether a salvage
    has made it of what a killed recorder left."""

    series: str
    number: int
    count: int
    first_ns: float
    last_ns: float
    salvaged: bool


def misplaced(series: str, number: int, place: Mapping[str, str], session: Mapping[str, str]) -> bool:
    """Whether the record `segment` gives another place in the session than the file's name."""
    due = segment_metadata(series, number, session)
    return bool(place.keys() - due.keys()) or any(place.get(key) != due[key] for key in due.keys() - {SESSION_CRC})


def foreign_numbers(numbers: Iterable[int]) -> set[int]:
    """Those that no segment of the session can have: behind more missing ones than any session has segments."""
    known = sorted(set(numbers))
    for place, (before, after) in enumerate(pairwise([-1, *known])):
        if after - before > MOST_MISSING:
            return set(known[place:])
    return set()


def missing_numbers(numbers: Iterable[int]) -> Iterator[tuple[int, int]]:
    """(first, last) of each range of numbers from 0 on that is not there; foreign ones do not count."""
    known = set(numbers)
    for before, after in pairwise([-1, *sorted(known - foreign_numbers(known))]):
        if after > before + 1:
            yield before + 1, after - 1


def missing_segments(series: str, numbers: Iterable[int], links: Iterable[Link]) -> Iterator[Hole]:
    """The ranges of segments that are not there, with the instants around them. `numbers`: of all files of the series,
    links: those that were read."""
    read = sorted((link for link in links if link.series == series and link.count), key=lambda link: link.number)
    for first, last in missing_numbers(numbers):
        before = [link.last_ns for link in read if link.number < first]
        after = [link.first_ns for link in read if link.number > last]
        yield Hole(series, first, last, int(max(before)) if before else None, int(min(after)) if after else None)
