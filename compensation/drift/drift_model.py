"""What every drift model can do, and what it says when it is asked beyond what it was calibrated for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntFlag
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.candidates import Candidate, Pair
from thermostand.compensation.drift.hull import MARGIN_PX, compute_distances_px
from thermostand.compensation.drift.model_facts import ModelFacts
from thermostand.compensation.history.thermal_history import Float, States, ThermalStateSpec

Flags = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Situation = States | Float | float
"""Thermal states, one for each point or one for all; or only the camera's temperature, degC, which is enough for the
paper's form only (states_of)."""


class Outside(IntFlag):
    """Why a correction is an extrapolation.

    Attributes
    ----------
    PLACE
        The point is beyond the hull of the markers (plus 1 px).
    CAMERA, AMBIENT
        The camera's temperature, or the air's, is outside the calibrated range.
    SWITCHED_ON
        The camera was switched on more recently than ever in the calibration.
    HISTORY
        The record does not reach back far enough, or has a gap.
    STATE
        Each of these is in its range, but not in this combination.
    """

    PLACE = 1
    CAMERA = 2
    AMBIENT = 4
    SWITCHED_ON = 8
    HISTORY = 16
    STATE = 32


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DriftModel(ABC):
    """The drift of one camera: maps measured positions to those at the reference temperature.

    `thermostand.fit` makes one, `load_model` and `save_model` read and write it.

    Attributes
    ----------
    form
        "paper" or "thermal".
    facts
        What it was fitted to.
    discrepancy_px
        (2,), one standard deviation along x and y: what the form leaves unexplained at temperatures not fitted, marker
        noise taken off, px.
    candidates
        The table of choice, with every form tried.
    other
        The other form, fitted to the same frames; None when they could not support it.
    """

    form: ClassVar[str]
    facts: ModelFacts
    discrepancy_px: Float
    candidates: tuple[Candidate, ...]
    other: DriftModel | None = None

    @property
    @abstractmethod
    def title(self) -> str:
        """The form in words."""

    @property
    @abstractmethod
    def memory(self) -> ThermalStateSpec:
        """What has to be remembered for it: thermal_history.states_at and state_of take it."""

    @abstractmethod
    def shift(self, xy_px: Float, state: Situation) -> Float:
        """Return the displacement to the reference of points measured in these states.

        Parameters
        ----------
        xy_px
            Points (N, 2) as (x, y), px; integers are pixel centres.
        state
            The camera's thermal state: one for all points, or one for each.

        Returns
        -------
        Float
            (N, 2), px; NaN where a point or its state is NaN. Outside the valid range it extrapolates: ask `flags`.
        """

    def correct(self, xy_px: Float, state: Situation) -> Float:
        """Return where the points would be at the reference.

        Parameters
        ----------
        xy_px
            Points (N, 2) as (x, y), px; integers are pixel centres.
        state
            The camera's thermal state: one for all points, or one for each.

        Returns
        -------
        Float
            (N, 2), px; NaN where a point, or one of several states, is NaN.

        Raises
        ------
        ValueError
            When not a single point has an answer, as in states that are not known.
        """
        points = check_points(xy_px)
        corrected = points + self.shift(points, state)
        known = np.isfinite(points).all(axis=1)
        if known.any() and not np.isfinite(corrected[known]).any():
            raise ValueError(f"a model of the form {self.form} cannot correct these points: the camera's state is NaN")
        return corrected

    @abstractmethod
    def covariance(self, xy_px: Float, state: Situation) -> Float:
        """Return the covariance of `shift`, without the noise of the point itself.

        Returns
        -------
        Float
            (N, 2, 2), px^2; NaN where `shift` is.
        """

    def of_sessions(self, session_ids: Iterable[str]) -> Self:
        """The model for these sessions: `covariance` holds for any session, and is smaller for those that were fitted
        where what another session adds is not small compared with what the form leaves."""
        return self

    @abstractmethod
    def flags(self, xy_px: Float, state: Situation) -> Flags:
        """Return why each correction is an extrapolation.

        Returns
        -------
        Flags
            (N,), bits of `Outside`; 0 is a correction as good as `covariance` says.
        """

    def inside(self, xy_px: Float, state: Situation) -> Mask:
        """Return whether points and states are in the calibrated range, (N,): no flag."""
        return self.flags(xy_px, state) == 0


def broadcast_states(state: Situation, count: int, memory: ThermalStateSpec) -> States:
    """One state for each of `count` points. ValueError when there are more or fewer, or a temperature alone is given to
    a form that remembers."""
    if not isinstance(state, States):
        if memory.parts:
            raise ValueError(
                "a model of the form thermal follows the camera's past, and its temperature alone does not say it: "
                "give thermostand.states(model, session), or of arrays; model.other is the paper's form, if it has one"
            )
        degC = np.asarray(state, np.float64)
        if degC.shape not in ((), (1,), (count,)):
            raise ValueError(f"one temperature for all {count} points, or one for each, not {degC.shape}")
        return States.at_degC(degC, count, memory)
    if (found := len(state.camera_degC)) not in (1, count):
        raise ValueError(f"one state for all {count} points, or one for each, not {found}")
    return state if found == count else state.where(np.zeros(count, np.int64))


def check_points(xy_px: Float) -> Float:
    """Points (N, 2), px, also from lists; ValueError when they are none."""
    points = np.asarray(xy_px, np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points are (N, 2), not {points.shape}")
    return points


def compute_place_flags(xy_px: Float, hull_px: Float) -> Flags:
    """(N,): PLACE outside the hull, or without a place."""
    outside = ~(compute_distances_px(xy_px, hull_px) >= -MARGIN_PX).all(axis=1)
    return np.where(outside, np.uint8(Outside.PLACE), np.uint8(0))


def compute_range_flags(values: Float, limits: Pair, flag: Outside) -> Flags:
    """(N,): the flag where a value is outside the limits, or NaN."""
    return np.where((values >= limits[0]) & (values <= limits[1]), np.uint8(0), np.uint8(flag))
