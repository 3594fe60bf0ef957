"""The process that runs the notify command for a daemon, see foundation/helper.py.

It is small, and all it needs is loaded when the daemon starts: a daemon that has grown to gigabytes, has no descriptor
left or waits for a disk does not have to start a program itself. A command under way when the daemon goes is run to its
end.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress

MODULE = "thermostand.stand.guarding.notify_process"
LEFT_NAME = "stand-tell-left"  # of a process whose daemon has gone
KILLED_LIMIT_S = 1.0  # real seconds for what was killed to be gone


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
        process.wait(KILLED_LIMIT_S)
    except subprocess.TimeoutExpired:
        return " and could not be killed"
    return ""
