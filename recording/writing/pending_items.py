"""Since when what was published waits for the disk."""

from __future__ import annotations

import asyncio
from collections import deque


class PendingItems:
    """Instants of publication of what is not durable yet; used from the event loop.

    A frame that the disk refused, or was too slow for, waits until frames can be written again, although it is lost:
    a run must not continue as if its next one were safe. `change` is set, and replaced, when something has been saved
    or lost.
    """

    def __init__(self) -> None:
        self._new_ns: int | None = None  # the oldest item that no commit has taken yet
        self._taken_ns: deque[tuple[int, int]] = deque()  # commits under way or refused: number, their oldest item
        self._commits = 0
        self._frames_ns: deque[int] = deque()
        self._refused_ns: int | None = None
        self.change = asyncio.Event()

    @property
    def since_ns(self) -> int | None:
        """The oldest of all; None when nothing is due."""
        taken_ns = self._taken_ns[0][1] if self._taken_ns else None
        frame_ns = self._frames_ns[0] if self._frames_ns else None
        return _find_earliest(self._new_ns, taken_ns, frame_ns, self._refused_ns)

    @property
    def frames_refused(self) -> bool:
        """Whether frames could not be written when that was tried last."""
        return self._refused_ns is not None

    def item_published(self, now_ns: int) -> None:
        """One item of telemetry."""
        if self._new_ns is None or now_ns < self._new_ns:
            self._new_ns = now_ns

    def items_taken(self) -> int:
        """A commit of all items published so far begins; its number."""
        self._commits += 1
        if self._new_ns is not None:
            self._taken_ns.append((self._commits, self._new_ns))
            self._new_ns = None
        return self._commits

    def items_saved(self, commit: int) -> None:
        """The items of this commit, and of all before, are durable."""
        while self._taken_ns and self._taken_ns[0][0] <= commit:
            self._taken_ns.popleft()

    def frame_published(self, now_ns: int) -> None:
        """One frame, behind those that wait."""
        self._frames_ns.append(now_ns)

    def frame_done(self) -> int:
        """The first frame that waited does not any more; when it was published."""
        return self._frames_ns.popleft()

    def frame_refused(self, published_ns: int) -> None:
        """A frame was lost because the disk refused it, or was too slow."""
        self._refused_ns = _find_earliest(self._refused_ns, published_ns)

    def frames_work(self) -> None:
        """A frame was written, or could have been."""
        self._refused_ns = None

    def changed(self) -> None:
        """Something has been saved or lost."""
        self.change.set()
        self.change = asyncio.Event()


def _find_earliest(*times_ns: int | None) -> int | None:
    return min((time_ns for time_ns in times_ns if time_ns is not None), default=None)
