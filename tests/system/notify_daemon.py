"""A daemon that has nothing but somebody to tell: `python -m tests.system.notify_daemon COMMAND...`.

It says the id of the process that tells, and then for each line it reads what became of telling that line. Before one
that ends with "!" it takes every descriptor there is, as a daemon that leaks them does; it can start nothing then.
"""

import asyncio
import os
import resource
import sys
from contextlib import suppress

from thermostand.foundation.clock import WallClock
from thermostand.stand.guarding.notify import Notifier


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def main(command):
    notifier = Notifier(command, 5.0, WallClock())
    notifier.start()
    say(notifier.pid)
    resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))
    for line in sys.stdin:
        with suppress(OSError):
            while line.endswith("!\n"):
                os.dup(0)
        failure = await notifier.tell(line.rstrip("\n"))
        os.closerange(30, 100)
        say(failure)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1:]))
