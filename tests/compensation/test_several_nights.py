"""Nights of one camera fitted together: what does not repeat between them is in the model's uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from compensation.drift.thermal_learning import fit_thermal
from compensation.drift.thermal_model import ThermalModel
from compensation.observations import concatenate

from .drawn_cameras import Camera, drawn_camera
from .drawn_nights import Night, full_night, night

SEED = 2700


def made(camera: Camera, number: int) -> Night:
    """The image of each night is larger by a part that no temperature explains, along J and towards the edges of the
    cycle: 0.5 mpx/K of the set-point in every other night."""
    one = night(camera, full_night(), 10 * SEED + number, session_id=f"night-{number}")
    away_K = one.observed.chamber_degC - 24.0
    shift = (0.0005 if number % 2 else -0.0005) * away_K[:, None, None] * np.array([0.0, 1.0])
    return Night(replace(one.observed, centres_px=one.observed.centres_px + shift), one.truth_px + shift)


def thermal(*nights: Night) -> ThermalModel:
    return fit_thermal(concatenate([one.observed for one in nights]))


def test_what_does_not_repeat_between_nights_is_claimed() -> None:
    nights = [made(drawn_camera(SEED), number) for number in range(2)]
    alone, together = thermal(nights[0]), thermal(*nights)
    assert together.discrepancy_px[1] > 0.006 > 2 * alone.discrepancy_px[1]
    assert together.discrepancy_px[0] < 0.003


def test_a_night_that_the_others_cannot_do_without_says_nothing() -> None:
    camera = drawn_camera(SEED)
    whole, few = made(camera, 0), made(camera, 1)
    far = np.abs(few.observed.chamber_degC - 24.0) > 8
    reasons = tuple("not of this night" if out else why for out, why in zip(far, few.observed.reasons, strict=True))
    short = Night(replace(few.observed, reasons=reasons), few.truth_px)
    assert thermal(whole, short).discrepancy_px[1] < 0.006
