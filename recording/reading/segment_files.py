"""The segments of a session by their names alone, whatever is in them (recording/format/inventory.py asks more)."""

from __future__ import annotations

from pathlib import Path

from thermostand.recording.format.layout import FRAMES, TELEMETRY

_NUMBER_DIGITS = 18


def number_of(segment: Path) -> int:
    """Its number by its name; -1 when that has none."""
    digits = segment.name.partition(".")[0]
    return int(digits) if digits.isdecimal() and len(digits) <= _NUMBER_DIGITS else -1


def segments_of(session: Path, suffix: str) -> tuple[Path, ...]:
    """Those of both series that end so, telemetry first."""
    return (*segments_in(session / TELEMETRY, suffix), *segments_in(session / FRAMES, suffix))


def segments_in(folder: Path, suffix: str) -> list[Path]:
    """The files in `folder` that end so, in order of their numbers; none when there is no such folder."""
    try:
        paths = [path for path in folder.iterdir() if path.name.endswith(suffix)]
    except OSError:
        return []
    return sorted(paths, key=lambda path: (len(path.name), path.name))
