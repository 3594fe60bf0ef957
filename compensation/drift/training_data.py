"""What the thermal form learns from: frames, their states and features, each against its session's own reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.candidates import find_interior
from thermostand.compensation.drift.displacements import Displacements, compute_displacements, find_reference_frames
from thermostand.compensation.drift.terms import MOTIONS, ConstantTerm, Term, compute_features, compute_motions
from thermostand.compensation.expression import Origin
from thermostand.compensation.history.thermal_history import Float, States, ThermalStateSpec, compute_states_at
from thermostand.compensation.observations import Mask, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError

Index = NDArray[np.int64]

# A fit inverts matrices of as many rows as there are instants: half of it would take up to eight times as long.
INSTANT_NS = 240 * NS_PER_S
# Without it the evidence blows up on drawn cameras (16 of them, numbers 3000 on).
_COMMON_NOISE_PX = 0.002
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
    label = _label_instants(observations, rows)
    count = int(label.max()) + 1
    g = compute_motions(rows.measured_px, observations.image_size)
    weight = 1 / rows.variance_px2
    normal, moment = np.zeros((count, MOTIONS, MOTIONS)), np.zeros((count, MOTIONS))
    np.add.at(normal, label, np.einsum("mak,ma,mal->mkl", g, weight, g))
    np.add.at(moment, label, np.einsum("mak,ma,ma->mk", g, weight, rows.displacement_px))
    rows_of = np.bincount(label)
    mean = np.stack([np.bincount(label, column[rows.frame]) / rows_of for column in features.T], axis=1)
    first = np.zeros(count, np.int64)
    first[label[::-1]] = rows.frame[::-1]
    # As in the paper's form: beyond it the markers do not determine eight motions.
    good = (np.linalg.cond(normal) < 1e8) & np.isfinite(mean).all(axis=1)
    gram, normal, first = _compute_gram(g, label, rows_of)[good], normal[good], first[good]
    covariance = np.linalg.inv(normal)
    noise_px2 = np.einsum("ikl,ilk->i", covariance, gram) / MOTIONS
    more = (1 + _COMMON_NOISE_PX**2 / noise_px2)[:, None]
    return Instants(
        amounts_px=np.asarray(np.linalg.solve(normal, moment[good][:, :, None])[:, :, 0], np.float64),
        variance_px2=more * np.diagonal(covariance, axis1=1, axis2=2),
        features=mean[good],
        chamber_degC=np.where(set_point[first], observations.chamber_degC[first], np.nan),
        session=observations.session[first],
        time_s=(observations.time_ns[first] - observations.time_ns[0]) / NS_PER_S,
        frame=first,
    )


def _compute_gram(g: Float, label: Index, rows_of: Index) -> Float:
    """(I, 8, 8): mean of the squares of the motions at one marker; over the normal equations it is their variance."""
    gram = np.zeros((len(rows_of), MOTIONS, MOTIONS))
    np.add.at(gram, label, np.einsum("mak,mal->mkl", g, g))
    return gram / rows_of[:, None, None]


def _label_instants(observations: Observations, rows: Displacements) -> Index:
    """(M,): the instant of each row, from 0."""
    _, first, step = np.unique(np.array(observations.step_id), return_index=True, return_inverse=True)
    step = np.argsort(np.argsort(first))[step]  # as they came: an order of ids would move a fit's last digits
    part = observations.time_ns // INSTANT_NS
    key = np.column_stack([observations.session, step, part])[rows.frame]
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


_TRUSTED_S = 3600.0
"""After a gap the state is a guess; frames within this time teach nothing, unless the reference is one of them."""

_WARM_S = 3 * 3600.0
"""So long after switching on what still moves is the air's doing."""

_SAME_PLACE_PX = 10.0
"""A warm-up seen this far from the reference was of a camera that had been moved or rolled."""


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """rows: of REFERENCE, FIT and WARM_UP frames. frames (F,): which ones. states, features (F, H): of all frames, the
    features of `terms` minus those of each session's reference. reference_features (H,): of the first session's."""

    observations: Observations
    rows: Displacements
    frames: Mask
    terms: tuple[Term, ...]
    origin: Origin
    states: States
    features: Float
    reference_features: Float

    @property
    def set_points(self) -> Mask:
        """(F,): frames at a set-point, which can be left out with all its visits."""
        return self.observations.of(Role.REFERENCE, Role.FIT)

    @property
    def folds(self) -> Mask:
        """(F,): frames that are left out with a set-point: those at it, and those on the way to it, which show nearly
        the same state. A camera that was switched on lately is on no way to a set-point."""
        # Left out with the set-point, since they show nearly its state: of 7 drawn cameras that learned on the way
        # intervals held 88 % of the time, and 78 with these frames kept.
        on_the_way = self.observations.of(Role.WARM_UP) & (self.states.on_s >= _WARM_S)
        return self.set_points | on_the_way

    @property
    def fold_rows(self) -> Displacements:
        """The rows of these frames."""
        return self.rows.where(self.folds[self.rows.frame])

    @property
    def at_rest(self) -> Mask:
        """(M,): which of the fold_rows are at set-points."""
        return self.set_points[self.fold_rows.frame]

    @property
    def moving_rows(self) -> Displacements:
        """The rows of frames that were not at rest, of sessions with a reference: on the way to set-points between
        others, and of a camera that was switched on lately; the chamber's temperature is NaN in these."""
        observed = self.observations
        known = np.unique(observed.session[observed.of(Role.REFERENCE)])
        moving = observed.of(Role.WARM_UP) & np.isin(observed.session, known)
        rows = self.rows.where(moving[self.rows.frame])
        rows = replace(rows, chamber_degC=np.where(self.folds[rows.frame], rows.chamber_degC, np.nan))
        on_the_way = np.isfinite(rows.chamber_degC)
        asked = ~on_the_way
        if on_the_way.any():
            asked[on_the_way] = find_interior(rows.chamber_degC[on_the_way])
        return rows.where(asked)

    def assign_folds(self, frame: Index) -> Float:
        """(M,): with which others these frames (M,) are left out: those of their set-point; of a camera that was
        switched on lately those of four minutes, as numbers below all temperatures."""
        observed = self.observations
        pieces = (observed.time_ns[frame] - observed.time_ns.min()) // INSTANT_NS
        at_set_point = self.folds[frame] & np.isfinite(observed.chamber_degC[frame])
        return np.where(at_set_point, observed.chamber_degC[frame], -1000.0 - pieces)

    def condense(self) -> Instants:
        """The rows condensed."""
        return condense_instants(self.observations, self.rows, self.features, self.folds)


def compute_frame_states(observations: Observations, memory: ThermalStateSpec) -> States:
    """The thermal state at every frame (F,) of all sessions, each from its own history."""
    if not observations.histories:
        return States.at_degC(observations.camera_degC, len(observations.frame), memory)
    rows = States.at_degC(observations.camera_degC, len(observations.frame), memory).rows
    for index, history in enumerate(observations.histories):
        own = observations.session == index
        found = compute_states_at(history, memory, observations.time_ns[own], observations.camera_degC[own])
        rows[own] = found.rows
    return States(memory, rows)


def estimate_self_heating_K(observations: Observations) -> float:
    """Return how much warmer than the air the camera is at the reference; SessionError when the air there is
    unknown."""
    reference = observations.of(Role.REFERENCE)
    excess_K = (observations.camera_degC - observations.air_degC)[reference]
    if not np.isfinite(excess_K).any():
        raise SessionError("the sessions have no air temperature near the camera; the thermal form needs it")
    return max(float(np.nanmean(excess_K)), 1.0)


def build_training(observations: Observations, terms: tuple[Term, ...], memory: ThermalStateSpec) -> Training:
    """SessionError when no frame's thermal state is known."""
    reference = observations.of(Role.REFERENCE)
    states = compute_frame_states(observations, memory)
    origin = Origin(
        float(np.nanmean(states.camera_degC[reference])), float(np.nanmean(observations.air_degC[reference]))
    )
    found = compute_features(states, [term.feature for term in terms], origin)
    against = find_reference_frames(observations)
    frames = observations.of(Role.REFERENCE, Role.FIT, Role.WARM_UP) & np.isfinite(found).all(axis=1)
    frames &= _find_trusted_frames(observations, states, against)
    if not (frames & reference).any():
        raise SessionError("the sessions' telemetry does not give the thermal state at the reference frames")
    relative, first = _subtract_reference(observations, terms, found, against & frames)
    anchored = np.unique(observations.session[against & frames])
    rows = compute_displacements(observations, frames & np.isin(observations.session, anchored), against)
    rows = rows.where(_is_same_place(rows)[rows.frame])
    return Training(
        observations=observations,
        rows=rows,
        frames=frames,
        terms=terms,
        origin=origin,
        states=states,
        features=relative,
        reference_features=first,
    )


def _find_trusted_frames(observations: Observations, states: States, against: Mask) -> Mask:
    """(F,): frames whose state is no guess; all of a session whose own reference is one."""
    trusted = states.settled_s >= _TRUSTED_S
    known = np.unique(observations.session[trusted & against])
    return trusted | ~np.isin(observations.session, known)


def _subtract_reference(
    observations: Observations, terms: tuple[Term, ...], found: Float, against: Mask
) -> tuple[Float, Float]:
    """Features (F, H) minus those of each session's reference, and these (H,) of the first with REFERENCE frames.

    The constant is the misfit at the reference: 1, and 0 in a session that has none.
    """
    constant = np.array([isinstance(term, ConstantTerm) for term in terms])
    has_reference = np.unique(observations.session[observations.of(Role.REFERENCE)])
    relative, first = found.copy(), np.zeros(len(terms))
    for index in np.unique(observations.session[against]):
        own = observations.session == index
        mean = found[own & against].mean(axis=0)
        keeps = index in has_reference
        relative[own] -= np.where(constant & keeps, 0.0, mean)
        if index == has_reference[0]:
            first = np.where(constant, 0.0, mean)
    return relative, first


def _is_same_place(rows: Displacements) -> Mask:
    """(F,): frames that show the target about where the reference has it."""
    count = int(rows.frame.max()) + 1
    distance = np.linalg.norm(rows.displacement_px, axis=1)
    mean_px = np.bincount(rows.frame, distance, count) / np.maximum(np.bincount(rows.frame, minlength=count), 1)
    return mean_px < _SAME_PLACE_PX
