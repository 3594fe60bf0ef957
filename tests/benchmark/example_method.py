"""A method of one's own, as `make benchmark METHOD=tests/benchmark/example_method.py` takes it: an affine motion of the
image for each temperature the camera has shown, and a straight line between them. NAME and `fit` are all there is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.benchmark.scoring import Correction, Corrector, Float
from thermostand.compensation.observations import Observations

NAME = "a table of affine motions"


def fit(training: Observations) -> Corrector:
    """Learns from the reference and fit frames of one session."""
    reference_px = training.centres_px[training.of("reference")].mean(axis=0)
    frames = np.flatnonzero(training.of("reference", "fit"))
    degC, motions = [], []
    for set_point in np.unique(training.chamber_degC[frames]):
        own = frames[training.chamber_degC[frames] == set_point]
        seen_px = training.centres_px[own].mean(axis=0)
        degC.append(training.camera_degC[own].mean())
        motions.append(np.linalg.lstsq(_terms(seen_px), reference_px - seen_px, rcond=None)[0])
    order = np.argsort(degC)
    table_degC, table = np.array(degC)[order], np.array(motions)[order].reshape(len(order), 6)

    def corrected(session: Observations, asked: NDArray[np.int64], seen_px: Float) -> Correction:
        own_degC = session.camera_degC[asked]
        motion = np.stack([np.interp(own_degC, table_degC, column) for column in table.T], axis=1).reshape(-1, 3, 2)
        return Correction(np.array([seen + _terms(seen) @ one for seen, one in zip(seen_px, motion, strict=True)]))

    return corrected


def _terms(xy_px: Float) -> Float:
    return np.column_stack([np.ones(len(xy_px)), xy_px / 1000])
