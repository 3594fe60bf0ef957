"""How often a run goes on by itself after the process that writes its session was killed."""

from __future__ import annotations

from collections import deque

from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.guarding.interlocks import RECORDING_ENDED
from thermostand.stand.safety.fault import Fault

# Round number; nothing was measured.
MOST_PER_H = 3
"""A kernel that is short of memory kills once or twice; what is killed more often has a cause that stays."""


class WriterRestarts:
    """The restarts of the last hour."""

    def __init__(self) -> None:
        self._restarted_ns: deque[int] = deque()

    def may_follow(self, fault: Fault | None, now_ns: int) -> bool:
        """Return whether a run that this fault has ended is resumed now; then it counts as resumed."""
        while self._restarted_ns and now_ns - self._restarted_ns[0] >= 3600 * NS_PER_S:
            self._restarted_ns.popleft()
        if fault is None or fault.rule != RECORDING_ENDED or len(self._restarted_ns) >= MOST_PER_H:
            return False
        self._restarted_ns.append(now_ns)
        return True
