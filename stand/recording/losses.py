"""Frames that will not be in the session: counted, and told by reason, step and block."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from drivers.interface import Frame


class Losses:
    """What is lost; `count` is called from any thread, `take` from one."""

    def __init__(self) -> None:
        self._told = 0
        self._new: deque[tuple[str, str, int]] = deque()  # reason, step, block

    @property
    def total(self) -> int:
        """Frames lost since the beginning."""
        return self._told + len(self._new)

    def count(self, frame: Frame, reason: str) -> None:
        """One frame lost."""
        self._new.append((reason, frame.step_id, frame.block_id))

    def take(self) -> list[str]:
        """A sentence for each reason since the last time, which names every block."""
        reasons: dict[str, dict[str, list[int]]] = {}
        while self._new:
            reason, step_id, block_id = self._new.popleft()
            reasons.setdefault(reason, {}).setdefault(step_id, []).append(block_id)
            self._told += 1
        return [f"frames lost: {_by_step(steps)}, {self._told} in all; {reason}" for reason, steps in reasons.items()]


def _by_step(steps: dict[str, list[int]]) -> str:
    """`4 (blocks 12 to 14, 17 of step capture-1)`, with "and" between steps."""
    count = sum(len(blocks) for blocks in steps.values())
    places = [f"{ranges(blocks)}{f' of step {step_id}' if step_id else ''}" for step_id, blocks in steps.items()]
    return f"{count} ({' and '.join(places)})"


def ranges(blocks: Iterable[int]) -> str:
    """`block 3`, `blocks 12 to 14, 17`: every block id in the order given, neighbours as a range."""
    runs: list[tuple[int, int]] = []
    for block in blocks:
        if runs and block == runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], block)
        else:
            runs.append((block, block))
    texts = [f"{first}" if first == last else f"{first} to {last}" for first, last in runs]
    is_one = len(runs) == 1 and runs[0][0] == runs[0][1]
    return f"block{'' if is_one else 's'} {', '.join(texts)}"
