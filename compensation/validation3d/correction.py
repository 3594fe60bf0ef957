"""A drift model applied to the frames of a validation, each with the camera's thermal state at its instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compensation.drift.drift_model import DriftModel
from compensation.drift.training import frame_states
from compensation.observations import Float, Observations
from compensation.validation3d.positions import ValidationFrames


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """centres_px (F, N, 2): corrected, NaN in other frames, for missing markers and where the model has no answer.
    model_px2 (F, N, 2, 2): covariance of the correction alone. flags (F, N): of drift_model.Outside."""

    centres_px: Float
    model_px2: Float
    flags: NDArray[np.uint8]


def corrected(observations: Observations, frames: ValidationFrames, model: DriftModel) -> Corrected:
    """Every marker of the frames that are used."""
    states = frame_states(observations, model.memory)
    centres_px = np.full(observations.centres_px.shape, np.nan)
    model_px2 = np.full(observations.covariance_px2.shape, np.nan)
    flags = np.zeros(centres_px.shape[:2], np.uint8)
    for index in frames.used.tolist():
        seen = np.isfinite(observations.centres_px[index, :, 0])
        found, state = observations.centres_px[index, seen], states.where(np.array([index]))
        centres_px[index, seen] = model.correct(found, state)
        model_px2[index, seen] = model.covariance(found, state)
        flags[index, seen] = model.flags(found, state)
    return Corrected(centres_px, model_px2, flags)
