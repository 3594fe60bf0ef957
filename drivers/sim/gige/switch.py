"""The switch between several cameras and the computer: one line out, a buffer in front of it, and what does not fit is
lost, as in a real one."""

from __future__ import annotations

import threading
import time

BUFFER_bytes = 256_000  # a small one's, for all its ports
_OVERHEAD_bytes = 66  # Ethernet with preamble and gap, IP, UDP


class Switch:
    """rate_MBps: of the line out, 1e6 bytes/s. lost: packets that found no room."""

    def __init__(self, rate_MBps: float, buffer_bytes: int = BUFFER_bytes) -> None:
        self.lost = 0
        self._rate_Bps = rate_MBps * 1e6
        self._buffer_bytes = buffer_bytes
        self._held_bytes = 0.0
        self._at_s = 0.0
        self._lock = threading.Lock()  # each camera sends in a thread of its own

    def passes(self, size_bytes: int, now_s: float | None = None) -> bool:
        """Whether a packet of so many bytes of payload, which comes now, gets through."""
        with self._lock:
            now_s = time.monotonic() if now_s is None else now_s
            left_bytes = self._held_bytes - (now_s - self._at_s) * self._rate_Bps
            self._held_bytes, self._at_s = max(0.0, left_bytes), now_s
            if self._held_bytes + size_bytes > self._buffer_bytes:
                self.lost += 1
                return False
            self._held_bytes += size_bytes + _OVERHEAD_bytes
            return True
