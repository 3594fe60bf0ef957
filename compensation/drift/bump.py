"""A step of the image in a night: what is recorded of one that was found."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from thermostand.foundation.documents import Document

MOTIONS = 4


class Bump(Document):
    """A step between two frames of a session: after_ns is the last one before it, before_ns the first one after it.

    motions_px (4,): shift along I and J, turn and scale, each in px at half the image's width from its centre,
    sigma_px (4,) their standard uncertainties. marker: the one that moved, from 0; None when the whole image did.
    """

    session_id: str
    after_ns: int
    before_ns: int
    motions_px: Annotated[tuple[float, ...], Field(min_length=MOTIONS, max_length=MOTIONS)]
    sigma_px: Annotated[tuple[float, ...], Field(min_length=MOTIONS, max_length=MOTIONS)]
    marker: int | None = None

    @property
    def size_px(self) -> float:
        """How far the image's middle moved, or what turns and scales did at its edge."""
        return max(math.hypot(*self.motions_px[:2]), *(abs(one) for one in self.motions_px[2:]))

    @property
    def text(self) -> str:
        """Who moved how far, in a sentence without its time."""
        if self.marker is not None:
            who = f"marker {self.marker} moved"
        else:
            who = "the image moved"
        i, j = (
            f"{1e3 * value:+.0f} ({1e3 * sigma:.0f})"
            for value, sigma in zip(self.motions_px[:2], self.sigma_px[:2], strict=True)
        )
        turned = (
            ""
            if self.marker is not None
            else "; turned and scaled by {:+.0f} and {:+.0f} mpx at its edge".format(
                *(1e3 * value for value in self.motions_px[2:])
            )
        )
        return f"{who} by {i} mpx along I and {j} along J (standard uncertainty){turned}"
