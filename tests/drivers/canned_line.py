"""A wire with an answer of ours on it, and what may come of a damaged frame.

A parser takes the number of a recorded frame and the bytes that came in its place. It accepts them, and then what it
gave is compared with what an own, slower reading of the same bytes finds in them, or it refuses them by its typed
errors; anything else fails. How often it asks for more is bounded, so one that never ends fails, too.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_READS = 200  # more from one damaged reply is a loop

Feed = Callable[[int, bytes], bool]


@dataclass(frozen=True)
class Parser:
    """`make` gives a fresh one, which tells whether it took what it was fed; `frames`: as they came; `refusals`: those
    of them that say no."""

    frames: Sequence[bytes]
    make: Callable[[], Feed]
    refusals: frozenset[int] = frozenset()


def mutated(chance: random.Random, frames: Sequence[bytes], number: int) -> bytes:
    """Frame `number` damaged once to three times: as a line does it (bits, lost, doubled and foreign bytes, an end that
    is missing, a late reply in front) and as nobody expects it (extreme bytes)."""
    wire = bytearray(frames[number])
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        at = chance.randrange(len(wire) + 1)
        end = min(len(wire), at + chance.randint(1, 8))
        match chance.randrange(8):
            case 0 if at < len(wire):
                wire[at] ^= 1 << chance.randrange(8)
            case 1:
                del wire[at:]
            case 2:
                del wire[at:end]
            case 3:
                wire[at:at] = chance.randbytes(chance.randint(1, 8))
            case 4:
                wire[at:end] = chance.randbytes(end - at)
            case 5:
                wire[at:at] = wire[at:end]
            case 6:
                wire[:0] = chance.choice(frames)
            case _:
                wire[at:end] = bytes([chance.choice((0x00, 0x7F, 0x80, 0xFF))]) * (end - at)
    return bytes(wire)


class Line:
    """A wire whose other end answers every request with `reply`, in two pieces, and a burst of zeros with zeros."""

    def __init__(self) -> None:
        self.reply = b""
        self._left: list[bytes] = []
        self._reads = 0

    def write(self, data: bytes) -> None:
        if data.strip(b"\0"):
            half = len(self.reply) // 2
            self._left = [piece for piece in (self.reply[:half], self.reply[half:]) if piece]
        else:
            self._left = [data]

    def read(self, timeout_s: float) -> bytes:
        self._reads += 1
        assert self._reads < _READS, "it reads without end"
        return self._left.pop(0) if self._left and timeout_s else b""

    def close(self) -> None:
        self._left = []

    def begin(self, reply: bytes) -> None:
        self.reply, self._left, self._reads = reply, [], 0
