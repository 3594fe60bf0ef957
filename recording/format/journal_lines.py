"""The lines of a run's journal, `journal.jsonl`: a CRC-32 and the file's mark in 8 hex digits each, then a JSON object.

The CRC is of the line's place in the file, the mark and the JSON: a line that the disk has put into another place, or
into another session's journal, does not fit. A line that has its end but does not fit its CRC, or has another mark than
most, is damaged; the lines after it count all the same. What has no end of line was never acknowledged, or is lost.
"""

from __future__ import annotations

import hashlib
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from thermostand.foundation.json_values import parse_json_object

JOURNAL_NAME = "journal.jsonl"
LIMIT_BYTES = 32_000_000  # an entry a minute for 200 days; all of them are in memory


@dataclass(frozen=True, slots=True)
class CheckedLines:
    """sound: the JSON of each sound line. damaged: numbers of the damaged lines, from 1, and `of` how many lines there
    are. size_bytes: up to the end of the last sound line. mark: the file's, b"" when no line has one. unended_bytes:
    behind the last end of a line."""

    sound: tuple[bytes, ...]
    damaged: tuple[int, ...]
    of: int
    size_bytes: int
    mark: bytes
    unended_bytes: int


def make_mark(name: str) -> bytes:
    """Make the mark of a new file in the session of that name; copies and renamed sessions keep what they have."""
    return b"%08x" % zlib.crc32(name.encode(errors="surrogateescape"))


def format_lines(texts: Iterable[bytes], mark: bytes, place: int = 0) -> bytes:
    """JSON texts as lines, of which the first begins at that place of the file."""
    found = bytearray()
    for text in texts:
        marked = b"%s %s" % (mark, text)
        found += b"%s%s\n" % (_format_crc(marked, place + len(found)), marked)
    return bytes(found)


def parse_lines(data: bytes) -> CheckedLines:
    """Return what is sound of a journal, and what is not."""
    *lines, unended = data.split(b"\n")  # what has no end of line is no line
    found = [b""] * len(lines)  # of each line, mark and JSON where it fits its CRC
    ends: list[int] = []
    place = 0
    for number, line in enumerate(lines):
        if line[:9] == _format_crc(line[9:], place):
            found[number] = line[9:]
        place += len(line) + 1
        ends.append(place)
    marks = Counter(marked[:8] for marked in found if marked)
    mark = marks.most_common(1)[0][0] if marks else b""
    texts = [marked[9:] if marked[:8] == mark else b"" for marked in found]
    size_bytes = max((end for end, text in zip(ends, texts, strict=True) if text), default=0)
    damaged = tuple(number for number, text in enumerate(texts, 1) if not text)
    return CheckedLines(tuple(filter(None, texts)), damaged, len(lines), size_bytes, mark, len(unended))


def _format_crc(marked: bytes, place: int) -> bytes:
    """Write the CRC of a line, with the space behind it."""
    return b"%08x " % zlib.crc32(marked, place)


def format_damage(lines: CheckedLines) -> str:
    """Write which lines are damaged, as the part of a sentence."""
    first = f"line {lines.damaged[0]}"
    more = f" and {len(lines.damaged) - 1} more" if len(lines.damaged) > 1 else ""
    return f"{first}{more} of {lines.of} {'are' if more else 'is'} damaged; the lines after it count"


def format_unended(unended_bytes: int) -> str:
    """Return what is behind the last end of a line, as the part of a sentence."""
    return f"the last {unended_bytes} bytes are no line: one was being written, or is lost"


@dataclass(frozen=True, slots=True)
class JournalFacts:
    """What a journal says of its run, to be compared with the recording.

    last_ns: instant of its last entry. status, ended_ns: how and when the run ended, "" and 0 when the last entry does
    not say. done: ids of the steps that are done, which were on the disk then. damage: what is wrong with the file, ""
    when nothing is. unended: what is no line at its end, "" when nothing is. texts: name -> hash (`hash_text`) of each
    text the run began with, None when the journal does not say.
    """

    last_ns: int = 0
    status: str = ""
    ended_ns: int = 0
    resumed_ns: int = 0
    done: frozenset[str] = frozenset()
    damage: str = ""
    unended: str = ""
    texts: Mapping[str, str] | None = None


def hash_text(text: str | None) -> str:
    """Return the hash of an attached text; "" for none."""
    return "" if text is None else hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:16]


def read_journal_facts(directory: Path) -> JournalFacts | None:
    """Read the facts of the journal in a session's folder, which is not changed; None when it has none."""
    path = directory / JOURNAL_NAME
    try:
        if not path.is_file():
            return None
        if path.stat().st_size > LIMIT_BYTES:
            return JournalFacts(damage=f"is larger than {LIMIT_BYTES // 1_000_000} MB and was not read")
        lines = parse_lines(path.read_bytes())
    except OSError as error:
        return JournalFacts(damage=f"cannot be read ({error.strerror})")
    last = next(
        (entry for text in reversed(lines.sound) if (entry := parse_json_object(text)) is not None), dict[str, object]()
    )
    few = (text for text in lines.sound if b'"done"' in text or b'"Gap"' in text)  # the others take seconds to decode
    entries = [entry for text in few if (entry := parse_json_object(text)) is not None]
    is_end = last.get("entry") == "Ended"
    done = (entry.get("step_id") for entry in entries if entry.get("entry") == "Step" and entry.get("state") == "done")
    last_ns = _check_instant(last.get("time_ns"))
    return JournalFacts(
        last_ns=last_ns,
        status=str(last.get("status")) if is_end else "",
        ended_ns=last_ns if is_end else 0,
        resumed_ns=max(
            (_check_instant(entry.get("time_ns")) for entry in entries if entry.get("entry") == "Gap"), default=0
        ),
        done=frozenset(step_id for step_id in done if isinstance(step_id, str)),
        damage=format_damage(lines) if lines.damaged else "",
        unended=format_unended(lines.unended_bytes) if lines.unended_bytes else "",
        texts=_read_texts(parse_json_object(lines.sound[0]) if lines.sound else None),
    )


def _read_texts(first: Mapping[str, object] | None) -> dict[str, str] | None:
    """Return the texts of a journal's first entry."""
    found = None if first is None or first.get("entry") != "Begun" else first.get("texts")
    if not isinstance(found, dict):
        return None
    return {str(name): str(known) for name, known in cast("dict[object, object]", found).items()}


def _check_instant(value: object) -> int:
    """ns since the epoch; 0 for what is no instant."""
    return value if isinstance(value, int) and 0 <= value < 1 << 63 else 0
