"""What cannot be calibrated."""

from __future__ import annotations

from foundation.errors import StandError


class CalibrationError(StandError):
    """Observations that do not determine a camera, or a pose; the sentence says why."""
