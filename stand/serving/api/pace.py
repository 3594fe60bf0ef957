"""How much of a processor the thread that serves clients may take: what it takes, the control loop may lack."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

SHARE = 0.3  # of one processor, in the long run
_LOOK_S = 0.05
_BURST_S = 0.5  # of work that is done at once: a page that opens


class Pace:
    """A budget of processor time, that of the calling thread. No client is refused for it: it waits.

    is_crowded: clients wait to be let in, and a client that has been answered goes back to the end of the line.

    `thread_s` reads the thread's processor time, `now_s` the clock; tests give their own.
    """

    def __init__(
        self,
        share: float = SHARE,
        thread_s: Callable[[], float] = time.thread_time,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.is_crowded = False
        self._share = share
        self._thread_s, self._now_s = thread_s, now_s
        self._left_s = _BURST_S
        self._seen_s, self._at_s = thread_s(), now_s()
        self._next = asyncio.Lock()

    def spent(self) -> float:
        """How long nobody should be served now, s; 0 when all is well."""
        now_s, thread_s = self._now_s(), self._thread_s()
        earned_s, spent_s = self._share * (now_s - self._at_s), thread_s - self._seen_s
        self._at_s, self._seen_s = now_s, thread_s
        self._left_s = min(_BURST_S, self._left_s + earned_s - spent_s)
        return max(0.0, -self._left_s / self._share)

    async def turn(self) -> None:
        """Return when there is budget for one more, in the order of coming."""
        async with self._next:
            while (wait_s := self.spent()) > 0.0:  # noqa: ASYNC110 - budget comes with time
                await asyncio.sleep(min(wait_s, _LOOK_S))
