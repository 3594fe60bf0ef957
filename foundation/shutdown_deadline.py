"""How long a program that ends still waits for a disk: all its waits share one budget, so that they do not add up."""

from __future__ import annotations

import asyncio
from typing import Any

# Limits of their own, one for each wait, added up to 7 s when a disk hung.
BUDGET_S = 3.0  # real seconds, of the 5 within which a daemon leaves once its stand is safe
LEAST_S = 0.1  # for each wait, though another one has used the budget up: a disk that works needs no longer


class ShutdownDeadline:
    """Each wait has its own limit. From `begin` on all of them, those under way too, end with the budget as well.

    So n waits one after the other take at most `budget_s` + n * LEAST_S. Seconds are those of the event loop.
    """

    def __init__(self, budget_s: float = BUDGET_S) -> None:
        self._budget_s = budget_s
        self._deadline_s: float | None = None
        self._started = asyncio.Event()

    def begin(self) -> None:
        """Start the budget now; may be called again."""
        if self._deadline_s is None:
            self._deadline_s = asyncio.get_running_loop().time() + self._budget_s
            self._started.set()

    def limit_s(self, at_most_s: float) -> float:
        """Return how long a wait may be that begins now."""
        if self._deadline_s is None:
            return at_most_s
        return min(at_most_s, max(LEAST_S, self._deadline_s - asyncio.get_running_loop().time()))

    async def wait(self, work: asyncio.Future[Any], at_most_s: float) -> bool:
        """Return whether `work` has ended in time; it is not cancelled, and what it raises is not raised here."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + at_most_s
        if self._deadline_s is None:
            begun = asyncio.create_task(self._started.wait())
            try:
                await asyncio.wait([work, begun], timeout=at_most_s, return_when=asyncio.FIRST_COMPLETED)
            finally:
                begun.cancel()
        left_s = self.limit_s(end_s - loop.time())
        if not work.done() and left_s > 0.0:
            await asyncio.wait([work], timeout=left_s)
        return work.done()
