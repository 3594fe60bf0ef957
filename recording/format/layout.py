"""What a session looks like on the disk: a folder with two series of segments, and names inside them."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

FRAMES = "frames"
TELEMETRY = "telemetry"
FINISHED = ".mcap"
UNFINISHED = ".mcap.part"
TEMPORARY = ".mcap.tmp"  # a copy that is being made; one left by a killed process is worthless
DAMAGED = ".mcap.damaged"  # the original of a segment from which a repair could not take everything
SESSION_METADATA = "session"
SEGMENT_METADATA = "segment"
SALVAGE_METADATA = "repair"  # of a segment that a repair has made
FRAME_TABLE = "frames"  # attachment behind the frames of a segment: the descriptions of all of them
SEQUENCE_MASK = 0xFFFF_FFFF  # MCAP has 32 bits for the block id; a frame's description has all 64
SESSION_CRC = "session_crc32"
# Of the files, in the record `session`. From 0.2.0 on formats are kept: each version of the program reads those of all
# before it. What earlier, unreleased versions recorded is not read.
FORMAT = 3
_FORMAT_DIGITS = 4  # a longer number is no format


def explain_unknown_format(session: Mapping[str, str]) -> str:
    """Return what is wrong with the format that the record `session` states, in words; "" for one that this version
    knows, and for a record that is not there."""
    text = session.get("format", "")
    if not session or text == str(FORMAT):
        return ""
    if not text or (text.isdecimal() and len(text) <= _FORMAT_DIGITS and int(text) < FORMAT):
        return (
            "was recorded by an earlier, unreleased version of thermostand; read it with that version, or record again"
        )
    return f"is of format {text[:20]!r}; this version of thermostand reads up to {FORMAT}"


def make_segment_metadata(series: str, number: int, session: Mapping[str, str]) -> dict[str, str]:
    """The record `segment`: its place in the session, and a CRC of `session`, for MCAP gives metadata none."""
    previous = f"{number - 1:04d}" if number else ""
    return {"series": series, "number": f"{number:04d}", "previous": previous, SESSION_CRC: _format_crc(session)}


def is_contradicting(segment: Mapping[str, str], session: Mapping[str, str]) -> bool:
    """Return whether the two records of one segment do not belong together: one of them is damaged."""
    return segment.get(SESSION_CRC, _format_crc(session)) != _format_crc(session)


def _format_crc(session: Mapping[str, str]) -> str:
    text = "".join(f"{key}\0{value}\0" for key, value in sorted(session.items()))
    return f"{zlib.crc32(text.encode()):08x}"
