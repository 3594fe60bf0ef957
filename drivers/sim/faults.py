"""How to break a link: byte-level faults between a fake's protocol engine and its descriptor."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass, field


@dataclass
class LinkFaults:
    """What happens to replies on one wire. Probabilities are 0..1 per reply; seeded, so that a run repeats.

    silent: no reply leaves. drop, flip, cut, junk: probabilities of losing the reply, flipping one bit, sending only
    its first half, sending 7 random bytes before it; late: of sending it late_by_s late. delay_s: real seconds of
    lateness of every reply (a wire time, not a simulated one); late_s: of the next one alone. garbled: how many of the
    coming replies lose their second half. echo: the request comes back before the reply (a badly wired RS-485
    adapter). byte_by_byte: one write a byte. flow_control: XOFF and XON among the reply. Over TCP: hangs_up: each
    connection is closed after one reply; swallows_first: the first request over each is lost. `injected` counts what
    was done, by name.
    """

    seed: int = 0
    silent: bool = False
    drop: float = 0.0
    flip: float = 0.0
    cut: float = 0.0
    junk: float = 0.0
    delay_s: float = 0.0
    late_s: float = 0.0
    late: float = 0.0
    late_by_s: float = 0.5
    garbled: int = 0
    echo: bool = False
    byte_by_byte: bool = False
    flow_control: bool = False
    hangs_up: bool = False
    swallows_first: bool = False
    injected: dict[str, int] = field(default_factory=dict[str, int])

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def apply(self, request: bytes, reply: bytes) -> list[bytes]:
        """The pieces to write instead of `reply`; may wait delay_s first. Nothing when there was no reply."""
        if not reply:
            return []
        if self._is_sound:
            return [reply]
        if self.delay_s > 0:
            self._count("delay")
            time.sleep(self.delay_s)  # noqa: TID251 - a slow line is slow in real seconds
        if self.late_s > 0:
            late_s, self.late_s = self.late_s, 0.0
            self._count("late")
            time.sleep(late_s)  # noqa: TID251 - as above
        if self._chance(self.late, "late"):
            time.sleep(self.late_by_s)  # noqa: TID251 - as above
        if self.garbled > 0:
            self.garbled -= 1
            self._count("garbled")
            return [reply[: max(1, len(reply) // 2)]]
        if self.silent or self._chance(self.drop, "drop"):
            return []
        if self._chance(self.flip, "flip"):
            position = self._random.randrange(len(reply))
            reply = (
                reply[:position] + bytes([reply[position] ^ (1 << self._random.randrange(8))]) + reply[position + 1 :]
            )
        if self._chance(self.cut, "cut"):
            reply = reply[: max(1, len(reply) // 2)]
        if self._chance(self.junk, "junk"):
            reply = self._random.randbytes(7) + reply
        if self.echo:
            self._count("echo")
            reply = request + reply
        if self.flow_control:
            self._count("flow_control")
            reply = b"\x13" + reply[:2] + b"\x11" + reply[2:] + b"\x13\x11"
        return [bytes([byte]) for byte in reply] if self.byte_by_byte else [reply]

    @property
    def _is_sound(self) -> bool:
        probable = self.drop or self.flip or self.cut or self.junk or self.late
        other = self.silent or self.delay_s or self.late_s or self.garbled or self.echo or self.byte_by_byte
        other = other or self.flow_control
        return not (probable or other)

    def _chance(self, probability: float, name: str) -> bool:
        if probability <= 0 or self._random.random() >= probability:
            return False
        self._count(name)
        return True

    def _count(self, name: str) -> None:
        self.injected[name] = self.injected.get(name, 0) + 1
