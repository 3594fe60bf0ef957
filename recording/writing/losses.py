"""Frames that will not be in the session: counted, and told by reason, step and block."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from foundation.instants import utc_text
from foundation.items import Batch
from foundation.readings import Frame
from recording.writing.space import Notice


class Losses:
    """What is lost; `count` is called from any thread, `take` from one."""

    def __init__(self) -> None:
        self._told = 0
        self._lost_ns: deque[tuple[str, int]] = deque()  # step, instant
        self._begins_ns: dict[str, int] = {}  # of captures that were begun anew, by step
        self._new: deque[tuple[str, str, int]] = deque()  # reason, step, block

    @property
    def total(self) -> int:
        """Frames lost since the beginning, without those of captures that were begun anew after them."""
        return sum(time_ns >= self._begins_ns.get(step_id, time_ns) for step_id, time_ns in tuple(self._lost_ns))

    def count(self, frame: Frame, reason: str) -> None:
        """One frame lost."""
        self._lost_ns.append((frame.step_id, frame.time_ns))
        self._new.append((reason, frame.step_id, frame.block_id))

    def supersede(self, step_id: str, time_ns: int) -> None:
        """The capture was begun anew: what it lost before that instant is missing nowhere."""
        self._begins_ns[step_id] = time_ns

    def take(self) -> list[Notice]:
        """An event for each reason since the last time, which names every block: `blocks` in its data are pairs of the
        first and the last."""
        reasons: dict[str, dict[str, list[int]]] = {}
        while self._new:
            reason, step_id, block_id = self._new.popleft()
            reasons.setdefault(reason, {}).setdefault(step_id, []).append(block_id)
            self._told += 1
        return [self._notice(reason, steps) for reason, steps in reasons.items()]

    def _notice(self, reason: str, steps: dict[str, list[int]]) -> Notice:
        blocks = [run for blocks in steps.values() for run in runs(blocks)]
        data = {"blocks": blocks, "steps": list(steps), "total": self._told, "reason": reason}
        text = f"frames lost: {_by_step(steps)}, {self._told} in all; {reason}"
        return Notice("error", "frames_dropped", text, data)


class DroppedReadings:
    """Readings that did not fit into memory while the disk took nothing: told when that begins, and when it is over
    with their number and span."""

    def __init__(self) -> None:
        self._readings = 0
        self._from_ns = self._to_ns = 0

    def count(self, batch: Batch, tell: Callable[[Notice], None]) -> None:
        """One batch that will not be in the session."""
        if not self._readings:
            self._from_ns = batch.time_ns
            text = "the disk has taken nothing for so long that readings are dropped; events and frames' data are kept"
            tell(Notice("error", "readings_dropped", text))
        self._readings += len(batch.readings)
        self._to_ns = batch.time_ns

    def end(self, tell: Callable[[Notice], None]) -> None:
        """Everything that was kept is on the disk."""
        if self._readings:
            data = {"readings": self._readings, "from_ns": self._from_ns, "to_ns": self._to_ns}
            span = f"from {utc_text(self._from_ns)} to {utc_text(self._to_ns)}"
            text = f"{self._readings} readings {span} were dropped while the disk took nothing"
            tell(Notice("error", "readings_lost", text, data))
            self._readings = 0


def _by_step(steps: dict[str, list[int]]) -> str:
    """`4 (blocks 12 to 14, 17 of step capture-1)`, with "and" between steps."""
    count = sum(len(blocks) for blocks in steps.values())
    places = [f"{ranges(blocks)}{f' of step {step_id}' if step_id else ''}" for step_id, blocks in steps.items()]
    return f"{count} ({' and '.join(places)})"


def runs(blocks: Iterable[int]) -> list[list[int]]:
    """The first and the last of each run of neighbours, in the order given."""
    found: list[list[int]] = []
    for block in blocks:
        if found and block == found[-1][1] + 1:
            found[-1][1] = block
        else:
            found.append([block, block])
    return found


def ranges(blocks: Iterable[int]) -> str:
    """`block 3`, `blocks 12 to 14, 17`: every block id in the order given, neighbours as a range."""
    found = runs(blocks)
    texts = [f"{first}" if first == last else f"{first} to {last}" for first, last in found]
    is_one = len(found) == 1 and found[0][0] == found[0][1]
    return f"block{'' if is_one else 's'} {', '.join(texts)}"
