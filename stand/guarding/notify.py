"""Tells somebody outside of the stand, by a command of the configuration."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress

from drivers.clock import Clock
from drivers.lane import Lane

_KILLED_LIMIT_S = 1.0  # real seconds for what was killed to be gone


class Notifier:
    """Runs `command` with the sentence as its last argument, without a shell, in a session of its own, for at most
    `limit_s` real seconds. An empty command tells nobody."""

    def __init__(self, command: Sequence[str], limit_s: float, clock: Clock) -> None:
        self._command = tuple(command)
        self._limit_s = limit_s
        self._clock = clock

    def missing(self) -> str:
        """Why the command cannot be run, "" when it can."""
        if not self._command or shutil.which(self._command[0]) is not None:
            return ""
        return (
            f"guard.notify: {self._command[0]} is no program that can be run here, nobody would be told of a trip; "
            "install it, give its whole path, or take the line out"
        )

    async def tell(self, text: str) -> str:
        """Why it failed, "" when it did not; off the loop, but virtual time stands still meanwhile."""
        if not self._command:
            return ""
        lane = Lane("notify", self._clock)
        try:
            return await lane.call(run_command, (*self._command, text.replace("\0", " ")), self._limit_s)
        finally:
            lane.close()


def run_command(command: Sequence[str], limit_s: float) -> str:
    """Run it to its end, or kill it and its children after `limit_s`; why it failed, "" when it did not."""
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # so that Ctrl-C at the stand does not end it, and its children can be found
        )
    except (OSError, ValueError) as error:
        return f"{command[0]} could not be started ({error})"
    try:
        status = process.wait(limit_s)
    except subprocess.TimeoutExpired:
        return f"{command[0]} did not end within {limit_s:g} s{_killed(process)}"
    return "" if status == 0 else f"{command[0]} ended with status {status}"


def _killed(process: subprocess.Popen[bytes]) -> str:
    """Kill it and its children; "" when it is gone. One that runs as another user, or hangs in the kernel, stays."""
    with suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    try:
        process.wait(_KILLED_LIMIT_S)
    except subprocess.TimeoutExpired:
        return " and could not be killed"
    return ""
