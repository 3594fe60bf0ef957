"""What the detection of a target ends with when there is nothing to measure."""

from __future__ import annotations

from foundation.errors import StandError


class DetectionError(StandError):
    """The target was not found or not identified beyond doubt; `found` counts the markers that were."""

    def __init__(self, text: str, found: int = 0) -> None:
        super().__init__(text)
        self.found = found
