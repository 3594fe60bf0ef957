"""The originals of damaged segments that a salvage has kept, compared with what it recovered of them."""

from __future__ import annotations

from collections.abc import Mapping

from mcap.records import DataEnd, Message
from mcap.stream_reader import StreamReader

from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.inventory import SegmentFile


def is_recovered(kept: SegmentFile, salvage: Mapping[str, str], recovered: int) -> bool:
    """Whether the salvaged segment (its record `salvage`, its number of messages) has every message of the original:
    its salvage lost no byte, and both have as many. The original must reach the end of its data; of one that was cut
    short the number of messages is unknown."""
    if salvage.get("lost_bytes") != "0":
        return False
    messages = 0
    try:
        with kept.path.open("rb") as file:
            for record in StreamReader(file, validate_crcs=True, record_size_limit=kept.size_bytes).records:
                if isinstance(record, DataEnd):
                    return messages == recovered
                messages += isinstance(record, Message)
    except DAMAGE:
        pass
    return False
