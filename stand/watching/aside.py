"""Output for people, written by a thread of its own: a terminal or a log that blocks delays nothing else."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from typing import ParamSpec

_MOST_WAITING = 1000  # what comes while so much waits is not shown; it is recorded all the same
_FAREWELL_S = 2.0  # real seconds for what still waits at the end

Shown = ParamSpec("Shown")


class Aside:
    """Makes calls in their order, in a thread that never keeps the process from ending."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[Callable[[], object] | None] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._show, name="aside", daemon=True)
        self._thread.start()

    def __call__(self, show: Callable[Shown, object]) -> Callable[Shown, None]:
        """`show`, made later: its caller never waits."""

        def later(*args: Shown.args, **options: Shown.kwargs) -> None:
            with suppress(queue.Full):
                self._waiting.put_nowait(partial(show, *args, **options))

        return later

    def close(self) -> None:
        """Show what still waits, as far as that goes."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
            self._thread.join(_FAREWELL_S)

    def _show(self) -> None:
        while (show := self._waiting.get()) is not None:
            with suppress(OSError):  # a terminal that is gone
                show()


@contextmanager
def aside() -> Generator[Aside]:
    """An Aside while inside."""
    shown = Aside()
    try:
        yield shown
    finally:
        shown.close()
