"""A daemon of its own that runs or resumes a session in virtual time, to be killed at a random moment.

`python -m tests.system.resume_process` reads a pickled (order, out) or (None, session) from its standard input. It
writes a line for each item of the hub: its type, and after a capture the instants of its frames, which are then on the
disk.
"""

import asyncio
import pickle
import subprocess
import sys
from pathlib import Path
from signal import SIGKILL
from threading import Timer

from tests import fork_server
from thermostand.foundation.items import StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import resume, run_virtual

DOWNTIME_S = 45.0


def say(line):
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def watch(hub):
    taken = {}

    def follow(item):
        if isinstance(item, Frame):
            taken.setdefault(item.step_id, []).append(item.time_ns)
        is_done = isinstance(item, StepMark) and item.state is StepState.DONE
        times_ns = taken.get(item.step_id, []) if is_done else []
        say(" ".join([type(item).__name__, *map(str, times_ns)]))

    hub.subscribe(follow)


def main():
    order, place = pickle.loads(sys.stdin.buffer.read())
    if order is None:
        say("resuming")
        before = load_interruption(place)
        say("resumed")
        asyncio.run(resume(before, watch, DOWNTIME_S))
    else:
        asyncio.run(run_virtual(order, place, None, watch))


class Daemon:
    """A running daemon; the frames at `acknowledged` (ns) are on the disk."""

    def __init__(self, order, place: Path):
        self._process = fork_server.popen(
            [sys.executable, "-m", "tests.system.resume_process"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._process.stdin.write(pickle.dumps((order, place)))
        self._process.stdin.close()
        self.acknowledged = []
        self.is_resumed = False  # the session is salvaged and read

    def lives_for(self, items, kind=""):
        """Whether it still lives when it has published so many more, of that kind."""
        for line in self._process.stdout:
            name, *times_ns = line.decode().split()
            self.acknowledged += map(int, times_ns)
            self.is_resumed = self.is_resumed or name == "resumed"
            items -= kind == name or not (kind or name.startswith("resum"))
            if items <= 0:
                return True
        return False

    def ends_within(self, real_s):
        """Whether it has come to its end by itself; else it is killed then."""
        timer = Timer(real_s, self._process.kill)
        timer.start()
        code = self.wait()
        timer.cancel()
        assert code in (0, -SIGKILL)
        return code == 0

    def kill(self):
        """Dead when this returns; what it had acknowledged meanwhile counts, too."""
        self._process.kill()
        self.wait()

    def wait(self):
        """Its exit code; may be asked again."""
        if not self._process.stdout.closed:
            self.lives_for(sys.maxsize)
            self._process.stdout.close()
        return self._process.wait()


if __name__ == "__main__":
    main()
