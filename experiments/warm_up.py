"""The paper's warm-up (section 3.1): a cold camera is switched on and watched while it heats itself.

The chamber stays at the ambient temperature; the camera is off until it has cooled to it; the flap is open
throughout the capture so that frames come without a pause.
"""

from __future__ import annotations

from collections.abc import Iterator

from experiments.parameters import CaptureParameters, Chamber_degC, FrameCount, Wait_s
from experiments.steps import (
    Capture,
    CloseFlap,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Role,
    Soak,
    StartChamber,
    Step,
    StopChamber,
)


class WarmUp(CaptureParameters):
    """Parameters of a warm-up; the paper took 3600 frames every 500 ms at 24 degC."""

    chamber_degC: Chamber_degC = 24.0
    cool_down_s: Wait_s = 7200.0
    frames: FrameCount = 3600


def warm_up(parameters: WarmUp) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped, the flap closed and the camera on."""
    yield CloseFlap()
    yield from (MoveTo(axis, position) for axis, position in parameters.table_position.items())
    yield PowerCamera(on=False)
    yield StartChamber(parameters.chamber_degC)
    yield Soak(parameters.cool_down_s)
    yield OpenFlap()
    yield PowerCamera(on=True)
    yield Capture(
        parameters.frames, parameters.interval_s, parameters.exposure_s, Role.WARM_UP, parameters.chamber_degC
    )
    yield CloseFlap()
    yield StopChamber()
