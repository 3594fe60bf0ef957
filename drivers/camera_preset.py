"""The numbers of a simulated camera as a person writes them: a file in configs/optics, read by stand and simulator."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from thermostand.foundation.documents import Document

Effect = Literal["sag", "dead_zone", "creep", "stick_slip", "unrepeated", "coarse_sensor", "far_air"]


def _check_order(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"{list(bounds)}: the lower bound comes first")
    return bounds


Bounds = Annotated[tuple[float, float], AfterValidator(_check_order)]


def _check_positive(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] <= 0:
        raise ValueError(f"{list(bounds)}: expected bounds above 0")
    return bounds


Positive = Annotated[Bounds, AfterValidator(_check_positive)]


class SagNumbers(Document):
    """The lens hangs lower as its cell softens: give_px (exp(dT / softening_K) - 1) downwards; the camera's roll turns
    that in the picture."""

    give_px: Positive
    softening_K: Positive


class DeadZoneNumbers(Document):
    """Two plays in the mount: each follows its temperature only beyond half_K either way, by px_per_K."""

    half_K: Positive
    px_per_K: Positive


class CreepNumbers(Document):
    """An adhesive that follows the lens cell within hours, by this share of the principal point's drift."""

    hours: Positive
    share: Positive


class StickSlipNumbers(Document):
    """A contact that sticks until the body is threshold_K further, another time each time, and then slips."""

    threshold_K: Positive
    px_per_K: Positive


class UnrepeatedNumbers(Document):
    """Fixings that come to rest elsewhere after each travel_K of the body's temperature, within scatter_px (one
    standard deviation)."""

    scatter_px: Positive
    travel_K: Positive


class SensorNumbers(Document):
    """What the camera reports of its own temperature: in steps, late, and offset."""

    step_K: float = Field(gt=0, le=5)
    lag_s: Positive
    offset_K: Bounds


class FarAirNumbers(Document):
    """A thermometer of the air far from the camera: late, and with a share of the air's change only."""

    lag_s: Positive
    share: Positive


class CameraPreset(Document):
    """What temperature does to a camera, each number within bounds that somebody has published or, where nobody has,
    that are marked as assumed. Positions in px of the simulated sensor (3.45 um).

    scale_ppm_per_K: of the image. principal_point_px_per_K: how far it goes, in a direction of its own. settling_min:
    the slowest time constant of its parts. self_heating_K: of the chip above the air. radial_per_K: of Brown's k1.
    bend_per_K: how much all of it grows with temperature.
    """

    title: str
    sources: tuple[str, ...] = Field(min_length=1)
    scale_ppm_per_K: Bounds
    principal_point_px_per_K: Positive
    settling_min: Positive
    self_heating_K: Positive
    radial_per_K: Bounds
    bend_per_K: Bounds
    sag: SagNumbers
    dead_zone: DeadZoneNumbers
    creep: CreepNumbers
    stick_slip: StickSlipNumbers
    unrepeated: UnrepeatedNumbers
    coarse_sensor: SensorNumbers
    far_air: FarAirNumbers
