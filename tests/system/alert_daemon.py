"""A daemon that has nothing but alerts: `python -m tests.system.alert_daemon COMMAND...`.

It says the id of the process that sends, then each alert that was not delivered; each line it reads is an alert. Before
one that ends with "!" it takes every descriptor there is, as a daemon that leaks them does; it can start nothing then,
until an alert was not delivered.
"""

import asyncio
import os
import resource
import sys
from contextlib import suppress
from pathlib import Path

from thermostand.foundation.clock import WallClock
from thermostand.foundation.events import ALERT_FAILED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event
from thermostand.stand.config.alerts_section import AlertsConfig
from thermostand.stand.serving.alerts import send_alerts


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def children():
    return [pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()]


async def main(command):
    hub, clock = Hub(), WallClock()
    config = AlertsConfig(command=command, command_causes=("queue_empty",), command_limit_s=5.0)

    def failed(item):
        if item.kind == ALERT_FAILED:
            os.closerange(30, 100)
            say(item.text)

    async with send_alerts("lab", config, hub, clock):
        while not children():
            await asyncio.sleep(0.01)
        say(children()[0])
        resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))
        hub.subscribe(failed)
        while line := await asyncio.to_thread(sys.stdin.readline):
            with suppress(OSError):
                while line.endswith("!\n"):
                    os.dup(0)
            hub.publish(Event(clock.now_ns(), "info", "queue_empty", line.rstrip("\n"), {}))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1:]))
