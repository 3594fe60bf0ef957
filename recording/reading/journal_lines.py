"""The lines of a run's journal, `journal.jsonl`: the CRC-32 of the rest in 8 hex digits, a space, a JSON object.

A line that has its end but does not fit its CRC is damaged; the lines after it count all the same. What has no end of
line was never acknowledged.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

from foundation.json_values import json_object

JOURNAL_NAME = "journal.jsonl"
LIMIT_BYTES = 32_000_000  # an entry a minute for 200 days; all of them are in memory


@dataclass(frozen=True, slots=True)
class Lines:
    """sound: the JSON of each sound line. damaged: numbers of the damaged lines, from 1, and `of` how many lines there
    are. size_bytes: up to the end of the last sound line."""

    sound: tuple[bytes, ...]
    damaged: tuple[int, ...]
    of: int
    size_bytes: int


def journal_line(text: bytes) -> bytes:
    """A JSON text as a line."""
    return b"%08x %s\n" % (zlib.crc32(text), text)


def lines_of(data: bytes) -> Lines:
    """What is sound of a journal, and what is not."""
    sound: list[bytes] = []
    damaged: list[int] = []
    number = size_bytes = place = 0
    for number, line in enumerate(data.split(b"\n")[:-1], 1):  # what has no end of line is no line
        place += len(line) + 1
        crc, _, text = line.partition(b" ")
        if crc == b"%08x" % zlib.crc32(text):
            sound.append(text)
            size_bytes = place
        else:
            damaged.append(number)
    return Lines(tuple(sound), tuple(damaged), number, size_bytes)


def damage_text(lines: Lines) -> str:
    """Which lines are damaged, as the part of a sentence."""
    first = f"line {lines.damaged[0]}"
    more = f" and {len(lines.damaged) - 1} more" if len(lines.damaged) > 1 else ""
    return f"{first}{more} of {lines.of} {'are' if more else 'is'} damaged; the lines after it count"


@dataclass(frozen=True, slots=True)
class JournalFacts:
    """What a journal says of its run, to be compared with the recording.

    last_ns: instant of its last entry. status, ended_ns: how and when the run ended, "" and 0 when the last entry does
    not say. done: ids of the steps that are done, which were on the disk then. damage: what is wrong with the file,
    "" when nothing is.
    """

    last_ns: int = 0
    status: str = ""
    ended_ns: int = 0
    resumed_ns: int = 0
    done: frozenset[str] = frozenset()
    damage: str = ""


def journal_facts(directory: Path) -> JournalFacts | None:
    """Of the journal in a session's folder, which is not changed; None when there is none."""
    path = directory / JOURNAL_NAME
    try:
        if not path.is_file():
            return None
        if path.stat().st_size > LIMIT_BYTES:
            return JournalFacts(damage=f"is larger than {LIMIT_BYTES // 1_000_000} MB and was not read")
        lines = lines_of(path.read_bytes())
    except OSError as error:
        return JournalFacts(damage=f"cannot be read ({error.strerror})")
    last = next(
        (entry for text in reversed(lines.sound) if (entry := json_object(text)) is not None), dict[str, object]()
    )
    few = (text for text in lines.sound if b'"done"' in text or b'"Gap"' in text)  # the others take seconds to decode
    entries = [entry for text in few if (entry := json_object(text)) is not None]
    is_end = last.get("entry") == "Ended"
    done = (entry.get("step_id") for entry in entries if entry.get("entry") == "Step" and entry.get("state") == "done")
    last_ns = _instant(last.get("time_ns"))
    return JournalFacts(
        last_ns,
        str(last.get("status")) if is_end else "",
        last_ns if is_end else 0,
        max((_instant(entry.get("time_ns")) for entry in entries if entry.get("entry") == "Gap"), default=0),
        frozenset(step_id for step_id in done if isinstance(step_id, str)),
        damage_text(lines) if lines.damaged else "",
    )


def _instant(value: object) -> int:
    """ns since the epoch; 0 for what is no instant."""
    return value if isinstance(value, int) and 0 <= value < 1 << 63 else 0
