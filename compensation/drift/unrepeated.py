"""What of a night's drift no thermal state explains and no single step either: fixings that slip again and again, or
settle differently each time.

A joint that sticks and slips moves the image along one line; fixings that settle differently after each change move it
in any direction. In nights of 24 drawn cameras each (numbers 2400 to 2423, by which the limits were chosen) what is
left along its main axis is 1.6 to 29 times that across (3 below 3) with slips, 1.2 to 3.1 (1 above 2.4) with fixings
that settle differently; in cameras that repeat it is 0.1 to 2.4 mpx.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from thermostand.compensation.drift.bump import Bump
from thermostand.compensation.drift.night_series import night_series
from thermostand.compensation.drift.step_scan import unexplained
from thermostand.compensation.observations import Observations
from thermostand.foundation.errors import SessionError

_LEAST_PX = 0.0025
_ONE_LINE = 2.4


class Cause(StrEnum):
    """What leaves such a trace. NOTHING: as small as in cameras that repeat."""

    NOTHING = "nothing"
    SLIPS = "slips"
    SETTLING = "settling"


@dataclass(frozen=True, slots=True)
class Unrepeated:
    """Of one session. cause: what it is like. along_px, across_px: RMS along the line on which most is left, and across
    it; direction_deg: of that line, from I towards J, -90..90. text: in a sentence."""

    session_id: str
    cause: Cause
    along_px: float
    across_px: float
    direction_deg: float
    text: str


def find_unrepeated(observations: Observations, bumps: Sequence[Bump]) -> tuple[Unrepeated, ...]:
    """Of each session with enough instants to tell, beside the steps that were found in it."""
    found: list[Unrepeated] = []
    for index in range(len(observations.sessions)):
        try:
            series = night_series(observations, index)
        except SessionError:  # nothing to measure against: the fit says so
            continue
        if series is None:
            continue
        own = [one.before_ns for one in bumps if one.session_id == series.session_id and one.marker is None]
        known = series.steps(series.at_ns(own))
        left = np.stack(
            [
                unexplained(
                    series.features, series.hours, series.variance_px2[:, axis], known, series.motions_px[:, axis]
                )
                for axis in (0, 1)
            ]
        )
        values, vectors = np.linalg.eigh(left @ left.T / left.shape[1])
        across_px, along_px = np.sqrt(np.maximum(values, 0.0)).tolist()
        i, j = vectors[:, 1].tolist()
        direction_deg = (math.degrees(math.atan2(j, i)) + 90) % 180 - 90
        cause = _cause(along_px, across_px)
        text = _text(cause, 1e3 * along_px, 1e3 * across_px, direction_deg)
        found.append(Unrepeated(series.session_id, cause, along_px, across_px, direction_deg, text))
    return tuple(found)


def _cause(along_px: float, across_px: float) -> Cause:
    if along_px < _LEAST_PX:
        return Cause.NOTHING
    return Cause.SLIPS if along_px > _ONE_LINE * across_px else Cause.SETTLING


def _text(cause: Cause, along_mpx: float, across_mpx: float, direction_deg: float) -> str:
    match cause:
        case Cause.SLIPS:
            return (
                f"{along_mpx:.1f} mpx RMS of the image's place do not repeat, along one line at {direction_deg:.0f} "
                f"deg from I towards J ({across_mpx:.1f} across it): as of a joint that sticks and slips"
            )
        case Cause.SETTLING:
            return (
                f"{along_mpx:.1f} mpx RMS of the image's place do not repeat, in no single direction ({across_mpx:.1f} "
                "across): as of fixings that settle differently after each change"
            )
        case Cause.NOTHING:
            return f"what does not repeat of the image's place is at most {along_mpx:.1f} mpx RMS"
