"""One count of a camera's frames, over all its starts."""

from __future__ import annotations

_WRAP = 65535  # 16-bit frame ids of GigE Vision count 1..65535 and skip 0


class FrameCount:
    """Turns the camera's frame ids, which begin again at each start, into one count that only rises."""

    def __init__(self) -> None:
        self.total = 0
        self._last_id = 0

    def restart(self, first_id: int = 1) -> None:
        """Ids start again with the next frame: at 1, a USB3 Vision camera's at 0."""
        self._last_id = first_id - 1

    def advance(self, frame_id: int) -> int:
        """Count up to this frame, those missing before it included; returns the total."""
        step = frame_id - self._last_id
        if step <= 0:
            step += _WRAP
        self._last_id = frame_id
        self.total += step
        return self.total
