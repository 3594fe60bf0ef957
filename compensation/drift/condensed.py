"""Rows of single marker centres condensed to instants: all that a homography times features can learn from them.

The frames of one capture within four minutes are one instant: the amounts of the eight motions and their variance, by
least squares over all its markers; everything after works on these, however many frames and markers there were. What
is learned is linear in the features, so means of both lose nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.displacements import Displacements
from thermostand.compensation.drift.terms import MOTIONS, motions
from thermostand.compensation.history.states import Float
from thermostand.compensation.observations import Mask, Observations
from thermostand.foundation.clock import NS_PER_S

Index = NDArray[np.int64]

INSTANT_NS = 240 * NS_PER_S
_FLOOR_PX = 0.002
"""What no model of this kind explains is common to all markers of an instant: many frames at one temperature (a
warm-up has thousands) do not outweigh one frame at each of many."""


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """I instants. amounts_px, variance_px2 (I, 8): of the motions. features (I, H): means over the frames, minus those
    of the reference. chamber_degC (I,): set-point, NaN in a warm-up. session (I,). time_s (I,): of the first frame,
    frame (I,): which one that is."""

    amounts_px: Float
    variance_px2: Float
    features: Float
    chamber_degC: Float
    session: Index
    time_s: Float
    frame: Index


def condense_instants(observations: Observations, rows: Displacements, features: Float, set_point: Mask) -> Instants:
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
    mean = np.stack([np.bincount(label, column[rows.frame]) / rows_of for column in features.T], axis=1)
    first = np.zeros(count, np.int64)
    first[label[::-1]] = rows.frame[::-1]
    good = (np.linalg.cond(normal) < 1e8) & np.isfinite(mean).all(axis=1)
    gram, normal, first = _gram(g, label, rows_of)[good], normal[good], first[good]
    covariance = np.linalg.inv(normal)
    noise_px2 = np.einsum("ikl,ilk->i", covariance, gram) / MOTIONS
    more = (1 + _FLOOR_PX**2 / noise_px2)[:, None]
    return Instants(
        amounts_px=np.asarray(np.linalg.solve(normal, moment[good][:, :, None])[:, :, 0], np.float64),
        variance_px2=more * np.diagonal(covariance, axis1=1, axis2=2),
        features=mean[good],
        chamber_degC=np.where(set_point[first], observations.chamber_degC[first], np.nan),
        session=observations.session[first],
        time_s=(observations.time_ns[first] - observations.time_ns[0]) / NS_PER_S,
        frame=first,
    )


def _gram(g: Float, label: Index, rows_of: Index) -> Float:
    """(I, 8, 8): mean of the squares of the motions at one marker; over the normal equations it is their variance."""
    gram = np.zeros((len(rows_of), MOTIONS, MOTIONS))
    np.add.at(gram, label, np.einsum("mak,mal->mkl", g, g))
    return gram / rows_of[:, None, None]


def _labels(observations: Observations, rows: Displacements) -> Index:
    """(M,): the instant of each row, from 0."""
    _, first, step = np.unique(np.array(observations.step_id), return_index=True, return_inverse=True)
    step = np.argsort(np.argsort(first))[step]  # as they came: an order of ids would move a fit's last digits
    part = observations.time_ns // INSTANT_NS
    key = np.column_stack([observations.session, step, part])[rows.frame]
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()
