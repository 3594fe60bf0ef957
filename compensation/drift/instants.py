"""Rows of single marker centres condensed to instants: all that a homography times features can learn from them.

The frames of one capture within a minute are one instant. Its N (8 x 8) and b (8) are the normal equations of the eight
motions; everything after works on these, however many frames and markers there were.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compensation.drift.displacements import Displacements
from compensation.drift.terms import MOTIONS, motions
from compensation.history.states import Float
from compensation.observations import Mask, Observations
from foundation.clock import NS_PER_S

_INSTANT_NS = 60 * NS_PER_S
_FLOOR_PX = 0.002
"""What no model of this kind explains is common to all markers of an instant: many frames at one temperature (a
warm-up has thousands) do not outweigh one frame at each of many."""


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """I instants. normal (I, 8, 8), moment (I, 8): weighted normal equations of the motions. features (I, H): means
    over the frames, minus those of the reference. chamber_degC (I,): set-point, NaN in a warm-up. session (I,)."""

    normal: Float
    moment: Float
    features: Float
    chamber_degC: Float
    session: NDArray[np.int64]

    def where(self, mask: Mask) -> Instants:
        """The instants of a mask (I,)."""
        kept = self.normal[mask], self.moment[mask], self.features[mask]
        return Instants(*kept, self.chamber_degC[mask], self.session[mask])

    @property
    def square(self) -> float:
        """The weighted square sum of the motions that were measured."""
        amounts = np.linalg.solve(self.normal, self.moment[:, :, None])[:, :, 0]
        return float((amounts * self.moment).sum())


def condense_instants(
    observations: Observations, rows: Displacements, features: Float, set_point: NDArray[np.bool_]
) -> Instants:
    """features (F, H): of each frame. set_point (F,): whether a frame's chamber temperature is one to be left out.
    Instants whose markers do not determine a homography are left out."""
    label = _labels(observations, rows)
    count = int(label.max()) + 1
    g = motions(rows.measured_px, observations.image_size)
    weight = 1 / rows.variance_px2
    normal, moment = np.zeros((count, MOTIONS, MOTIONS)), np.zeros((count, MOTIONS))
    np.add.at(normal, label, np.einsum("mak,ma,mal->mkl", g, weight, g))
    np.add.at(moment, label, np.einsum("mak,ma,ma->mk", g, weight, rows.displacement_px))
    rows_of = np.bincount(label)
    noise_px2 = np.einsum("ikl,ilk->i", np.linalg.pinv(normal), _gram(g, label, rows_of)) / MOTIONS
    weight_of = noise_px2 / (noise_px2 + _FLOOR_PX**2)
    mean = np.stack([np.bincount(label, column[rows.frame]) / rows_of for column in features.T], axis=1)
    first = np.zeros(count, np.int64)
    first[label[::-1]] = rows.frame[::-1]
    chamber_degC = np.where(set_point[first], observations.chamber_degC[first], np.nan)
    good = np.linalg.cond(normal) < 1e8
    weighted = normal * weight_of[:, None, None], moment * weight_of[:, None]
    found = Instants(*weighted, mean, chamber_degC, observations.session[first])
    return found.where(good & np.isfinite(mean).all(axis=1))


def _gram(g: Float, label: NDArray[np.int64], rows_of: NDArray[np.int64]) -> Float:
    """(I, 8, 8): mean of the squares of the motions at one marker; over the normal equations it is their variance."""
    gram = np.zeros((len(rows_of), MOTIONS, MOTIONS))
    np.add.at(gram, label, np.einsum("mak,mal->mkl", g, g))
    return gram / rows_of[:, None, None]


def _labels(observations: Observations, rows: Displacements) -> NDArray[np.int64]:
    """(M,): the instant of each row, from 0."""
    _, step = np.unique(np.array(observations.step_id), return_inverse=True)
    minute = observations.time_ns // _INSTANT_NS
    key = np.column_stack([observations.session, step, minute])[rows.frame]
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()
