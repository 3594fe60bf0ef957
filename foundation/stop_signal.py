"""When a program without an event loop is asked to end."""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Iterable
from contextlib import suppress
from types import FrameType


class StopSignal:
    """Asked for by one of the signals `numbers`, whichever thread the kernel hands it to, or by `ask`. Made in the main
    thread."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._asked, self._ask = os.pipe()
        os.set_blocking(self._ask, False)
        # Written to at once, in whichever thread; a handler of Python's has to wait for the main thread.
        signal.set_wakeup_fd(self._ask, warn_on_full_buffer=False)
        for number in numbers:
            signal.signal(number, _do_nothing)

    def ask(self) -> None:
        """Ask for the stop, from any thread; may be called again."""
        with suppress(BlockingIOError):  # it is full of such already
            os.write(self._ask, b"x")

    def wait(self, timeout_s: float | None = None) -> bool:
        """Return whether it has been asked for within so many real seconds (None: no limit)."""
        return bool(select.select([self._asked], [], [], timeout_s)[0])


def _do_nothing(number: int, frame: FrameType | None) -> None:
    """Else the signal would end the program, or be none."""
