"""The notices to systemd: READY, STATUS, WATCHDOG, STOPPING (sd_notify(3)), without a library."""

from __future__ import annotations

import asyncio
import os
import socket
from contextlib import suppress

STOPPING, READY, FED = "STOPPING=1", "READY=1", "WATCHDOG=1"
_EXTEND_EVERY_S, _EXTENDED_S = 20.0, 60.0  # three tries before systemd gives up


def notify_systemd(*lines: str) -> None:
    """Send these lines to the service manager; nothing when there is none."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager:
        manager.sendto("\n".join(lines).encode(), f"\0{address[1:]}" if address.startswith("@") else address)


class StatusNotice:
    """Notifies systemd of what is done now, when it changes."""

    def __init__(self) -> None:
        self._last_text = ""

    def tell(self, text: str) -> None:
        """Report the status in a few words, as `systemctl status` shows them."""
        if text != self._last_text:
            self._last_text = text
            notify_systemd(f"STATUS={text}")


def watchdog_s() -> float | None:
    """Return how often it wants to be fed at the least, None when it does not."""
    with suppress(ValueError):
        if int(os.environ.get("WATCHDOG_PID", os.getpid())) == os.getpid():
            return int(os.environ["WATCHDOG_USEC"]) / 1e6 if "WATCHDOG_USEC" in os.environ else None
    return None


async def keep_extending() -> None:
    """Ask for more time while the stand is made safe, until cancelled."""
    while True:
        notify_systemd(STOPPING, make_extension(_EXTENDED_S), "STATUS=making the stand safe")
        await asyncio.sleep(_EXTEND_EVERY_S)


def make_extension(by_s: float) -> str:
    """The line that asks for more time, from now on."""
    return f"EXTEND_TIMEOUT_USEC={round(by_s * 1e6)}"
