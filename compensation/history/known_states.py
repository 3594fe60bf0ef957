"""The thermal states that a model asks for, from whatever knows a camera's past: a session, observations, arrays."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermostand.compensation.history.states import Float, Memory, States
from thermostand.compensation.history.thermal_history import History, recorded_history, refined, states_at
from thermostand.compensation.one_camera import temperatures_at_frames
from thermostand.compensation.sound_values import check_degC
from thermostand.recording.reading.session import Session

Column = tuple[ArrayLike, ArrayLike]
"""Instants, ns, ascending, and values."""


class Remembering(Protocol):
    """A drift model."""

    @property
    def memory(self) -> Memory:
        """What has to be remembered for it."""
        ...


def states(
    model: Remembering,
    session: Session | None = None,
    time_ns: ArrayLike | None = None,
    camera_degC: ArrayLike | None = None,
    *,
    air: Column | None = None,
    supply: Column | None = None,
    camera: Column | None = None,
) -> States:
    """The camera's thermal state at F instants, for `model.correct(points, states(...))`: one state for all points, or
    one for each.

    Of a session: at its frames, or at `time_ns` (F,), ascending. Of arrays: `time_ns` and, from the time before it on,
    `air` near the camera, degC; `supply`, 0 or 1, until the next instant (else the camera is on); `camera`, its own
    temperature between the frames, degC. camera_degC (F,): its own at the instants, where it is known better.
    ValueError when neither a session nor `time_ns` with `air` is given, or shapes do not agree.
    """
    if session is None:
        if time_ns is None or air is None:
            raise ValueError(
                "give a session, or time_ns and air=(time_ns, degC): a thermal state follows from the past"
            )
        instants, own = _instants(time_ns, camera_degC)
        return states_at(history_of(air, supply, camera, instants, own), model.memory, instants, own)
    if air is not None or supply is not None or camera is not None:
        raise ValueError("air, supply and camera belong to arrays; a session has recorded them")
    recorded_degC = temperatures_at_frames(session)
    wanted = session.frame_times_ns if time_ns is None else time_ns
    instants, own = _instants(wanted, camera_degC)
    if camera_degC is None:
        own = np.array([recorded_degC.get(instant, math.nan) for instant in instants.tolist()])
    return states_at(recorded_history(session), model.memory, instants, own)


def history_of(
    air: Column, supply: Column | None, camera: Column | None, time_ns: NDArray[np.int64], camera_degC: Float
) -> History:
    """What lags are computed from; ValueError when a column is none. A camera without `supply` is on, for it has
    temperatures, and without `camera` what it read at the frames is all that is known of its own."""
    frames = time_ns, camera_degC
    powered = (np.empty(0, np.int64), np.empty(0)) if supply is None else _column("supply", supply)
    if np.any((powered[1] != 0) & (powered[1] != 1)):
        raise ValueError("supply: expected 0 (off) and 1 (on)")
    own = frames if camera is None else _column("camera", camera)
    measured = np.isfinite(own[1])
    return refined(History(*_column("air", air), *powered, own[0][measured], own[1][measured]))


def _column(name: str, given: Column) -> tuple[NDArray[np.int64], Float]:
    """Finite values with their instants."""
    if len(given) != 2:
        raise ValueError(f"{name}: expected (time_ns, values), not {len(given)} columns")
    try:
        time_ns, values = np.array(given[0], np.int64), np.array(given[1], np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{name}: expected numbers ({error})") from error
    if time_ns.ndim != 1 or time_ns.shape != values.shape:
        raise ValueError(
            f"{name}: expected (time_ns, values), two columns of the same length, not {time_ns.shape}, {values.shape}"
        )
    if np.any(np.diff(time_ns) < 0):
        raise ValueError(f"{name}: its time_ns go backwards; give them in order of time")
    if name != "supply":
        check_degC(name, values)
    good = np.isfinite(values)
    return time_ns[good], values[good]


def _instants(time_ns: ArrayLike, camera_degC: ArrayLike | None) -> tuple[NDArray[np.int64], Float]:
    instants = np.atleast_1d(np.array(time_ns, np.int64))
    own = np.full(len(instants), np.nan) if camera_degC is None else np.atleast_1d(np.array(camera_degC, np.float64))
    if instants.ndim != 1 or own.shape != instants.shape:
        raise ValueError(f"time_ns and camera_degC are (F,), not {instants.shape} and {own.shape}")
    if np.any(np.diff(instants) < 0):
        raise ValueError("time_ns go backwards; give the instants in order of time")
    return instants, own
