"""Pieces that several sequences share; each closes the flap it opens."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from thermostand.experiments.parameters import CaptureParameters, Guaranteed, MovingTable, Settled, TablePosition
from thermostand.experiments.steps import (
    AnySoak,
    Capture,
    CheckHome,
    CloseFlap,
    MoveTo,
    OpenFlap,
    Role,
    Soak,
    SoakUntilSettled,
    Step,
)

_AXES = ("linear", "rotary")


def capture_through_flap(parameters: CaptureParameters, frames: int, role: Role, chamber_degC: float) -> Iterator[Step]:
    """`frames` images; the flap is open for them only."""
    yield OpenFlap()
    yield Capture(frames, parameters.interval_s, parameters.exposure_s, role, chamber_degC)
    yield CloseFlap()


def make_soak(duration_s: float, how: Guaranteed) -> Soak:
    """A soak at a set-point."""
    return Soak(duration_s, band_K=how.band_K, unsettled=how.unsettled)


def make_set_point_soak(
    soak_s: float, until: Settled | None, how: Guaranteed, exposure_s: float, chamber_degC: float
) -> AnySoak:
    """The soak at a set-point: `soak_s`, or at most that."""
    if until is None:
        return make_soak(soak_s, how)
    return SoakUntilSettled.until(soak_s, until, exposure_s, chamber_degC)


def move_table(table_position: Mapping[str, float]) -> Iterator[Step]:
    """Each axis of `table_position` moved there, mm or deg."""
    for axis, position in table_position.items():
        yield MoveTo(axis, position)


def approach_position(position: TablePosition) -> Iterator[Step]:
    """Approach with both axes again, also with one that is in its place already: its motor may have been without
    current meanwhile."""
    yield from move_table(dict(zip(_AXES, (position.linear_mm, position.rotary_deg), strict=True)))


def capture_at(
    parameters: MovingTable, position: TablePosition, frames: int, role: Role, chamber_degC: float
) -> Iterator[Step]:
    """The target moved to `position` and at rest there, then its frames."""
    yield from approach_position(position)
    yield Soak(parameters.settle_s, band_K=0.0)
    yield from capture_through_flap(parameters, frames, role, chamber_degC)


def check_homes() -> Iterator[Step]:
    """A home check of both axes."""
    for axis in _AXES:
        yield CheckHome(axis)
