"""Notifies people outside the stand, by a command of the configuration."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Sequence
from contextlib import suppress
from threading import Lock

from thermostand.foundation.calls import Lane
from thermostand.foundation.clock import Clock
from thermostand.foundation.helper import Helper
from thermostand.stand.guarding.notify_process import KILLED_LIMIT_S, MODULE, run_command

_LINES = ("tell-1", "tell-2", "tell-3")  # so many commands at once: a slow one delays no other
_SPARE_S = 4.0  # real seconds beyond what the command may take, for a machine that is busy


class Notifier:
    """Runs `command` with the sentence as its last argument, without a shell, in a session of its own, for at most
    `limit_s` real seconds. An empty command notifies nobody.

    A small process runs it, so that people are notified also when the daemon or its disk hangs. It is there from
    `start` on, else from the first sentence on; one that has died, or does not answer, is replaced with the next. A few
    commands run at once, the rest in their turn.
    """

    def __init__(self, command: Sequence[str], limit_s: float, clock: Clock) -> None:
        self._command = tuple(command)
        self._limit_s = limit_s
        self._clock = clock
        self._helper: Helper | None = None
        self._replacing = Lock()  # held by a lane's thread
        self._lanes: dict[str, Lane] = {}
        self._free = list(_LINES)
        self._turns = asyncio.Semaphore(len(_LINES))

    @property
    def pid(self) -> int | None:
        """Of the process that runs the command; None while there is none."""
        return None if self._helper is None else self._helper.pid

    def missing(self) -> str:
        """Why the command cannot be run, "" when it can."""
        if not self._command or shutil.which(self._command[0]) is not None:
            return ""
        return (
            f"guard.notify: {self._command[0]} is no program that can be run here, nobody would be notified of a trip; "
            "install it, give its whole path, or take the line out"
        )

    def start(self) -> None:
        """Start the process; when that fails it is tried again with the first sentence."""
        if self._command and self._helper is None:
            with suppress(OSError):
                self._started()

    async def tell(self, text: str) -> str:
        """Why it failed, "" when it did not; off the loop and after earlier ones when many are under way, but virtual
        time stands still meanwhile."""
        if not self._command:
            return ""
        arguments = (*self._command, text.replace("\0", " "))
        async with self._turns:
            line = self._free.pop(0)
            lane = self._lanes.setdefault(line, Lane(f"notify {line}", self._clock, patient=False))
            limit_s = self._limit_s + KILLED_LIMIT_S + _SPARE_S
            try:
                async with asyncio.timeout(limit_s):
                    return await lane.call(self._run, line, arguments)
            except TimeoutError:
                self.close()
                return f"the process that runs {self._command[0]} did not answer within {limit_s:g} s"
            finally:
                self._free.append(line)

    def close(self) -> None:
        """End the process; commands under way run to their end. May be called twice."""
        self._drop(self._helper)
        for lane in self._lanes.values():
            lane.close()
        self._lanes = {}

    def _run(self, line: str, arguments: tuple[str, ...]) -> str:
        """In a lane. A process that has ended is replaced, once."""
        helper = self._helper
        try:
            return self._asked(line, arguments)
        except OSError:
            self._drop(helper)
        try:
            return self._asked(line, arguments)
        except OSError as error:
            return f"{arguments[0]} could not be started ({error})"

    def _asked(self, line: str, arguments: tuple[str, ...]) -> str:
        """Raises OSError when there is no process, or it has ended."""
        return (self._helper or self._started()).line(line).run(run_command, arguments, self._limit_s)

    def _drop(self, helper: Helper | None) -> None:
        """Not one that has taken its place meanwhile."""
        with self._replacing:
            if helper is None or helper is not self._helper:
                return
            self._helper = None
        helper.close()

    def _started(self) -> Helper:
        with self._replacing:
            if self._helper is None:
                self._helper = Helper(MODULE, _LINES, "the process that runs the notify command has ended")
            return self._helper
