"""What devices give: readings and frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Quality(StrEnum):
    """How far a reading may be trusted. STALE: not confirmed in this poll. BAD: no measurement at all."""

    GOOD = "good"
    STALE = "stale"
    BAD = "bad"


# Why a reading is BAD: "wire", the poll failed or its reply was garbled, and the device may be all right; "device", the
# device itself says that it has no measurement (sensor break, converter error, out of range); "" when that is unknown.
# Why one is STALE: "alarm", the device is in an alarm of its own; "suspect", it was measured, but its value is not to
# be believed (jumped, noisy, stuck); "" otherwise.
Cause = Literal["", "wire", "device", "alarm", "suspect"]


class Channel(NamedTuple):
    """What a device measures. name: the second part of its readings' channel (`air` of `thermometers.air`). unit: of
    its readings, any, 1 for a flag or count, "" for what has none. kind: what it is of, in one word (temperature,
    pressure, flag); of the first position in mm and the first in deg the table's pose is made for viewers."""

    name: str
    unit: str
    kind: str = ""


@dataclass(frozen=True, slots=True)
class Reading:
    """One measured value. `value` is NaN exactly when `quality` is BAD; `reason` then says why, `cause` who says so.

    `channel` is "device.quantity" (`thermometers.air`), `unit` as in the file formats (degC, %, mm, deg, mA,
    1 for a flag or count), `time_ns` ns since the epoch on the stand's clock.
    """

    channel: str
    value: float
    unit: str
    time_ns: int
    quality: Quality = Quality.GOOD
    reason: str = ""
    cause: Cause = ""

    def __post_init__(self) -> None:
        if math.isnan(self.value) != (self.quality is Quality.BAD):
            raise ValueError(
                f"{self.channel}: a reading is NaN exactly when it is BAD, not {self.value} {self.quality}"
            )


def bad_reading(channel: str, unit: str, time_ns: int, reason: str, cause: Cause = "device") -> Reading:
    """A BAD reading: value NaN, with the reason."""
    return Reading(channel, math.nan, unit, time_ns, Quality.BAD, reason, cause=cause)


TEMPERATURE_SUSPECT = "temperature_suspect"
"""The flag of a frame whose camera temperature is not to be believed."""
UNSETTLED = "unsettled"
"""The flag of a frame before which the chamber was not in its band at the end of the soak."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image and what belongs to it.

    Attributes
    ----------
    image
        uint8 or uint16, (height, width), [row, column]; not to be modified.
    time_ns
        Middle of the exposure on the stand's clock, ns.
    camera_degC
        The camera's own temperature; NaN when it has none or could not be read.
    block_id
        The device's own 64-bit count of frames since it was opened, gaps included.
    camera_ticks
        The camera's own time stamp, ns.
    dropped
        Frames lost since the previous one.
    step_id
        The plan's step that asked for it, "" when none did.
    windows
        (n, 4): x, y, width, height of the parts of the image that were recorded, px; the rest is filled. None when the
        whole image was recorded.
    flags
        Why it is to be left out of fits, in words of letters and _, such as TEMPERATURE_SUSPECT.
    significant_bits
        Of a sample, 0 for all of its type.
    described
        Of a recorded frame, its description as it was recorded, with what was known when it was published.
    """

    channel: str
    image: NDArray[np.uint8] | NDArray[np.uint16]
    time_ns: int
    exposure_s: float
    gain_dB: float
    camera_degC: float
    block_id: int
    camera_ticks: int
    dropped: int = 0
    step_id: str = ""
    windows: NDArray[np.int32] | None = None
    flags: tuple[str, ...] = ()
    significant_bits: int = 0
    described: bytes = b""
