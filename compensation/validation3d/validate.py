"""The whole validation of a session: what the target's deviations are before and after compensation.

Axes are the calibrated camera's, as in the paper: X to the right in the image, Y down, Z along the optical axis away
from the camera. The place that deviates is the target's middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.budget.budget import displacement_px, mean_state, states_at, varied
from thermostand.compensation.budget.geometry import Geometry, StandState, UncertainValue
from thermostand.compensation.calibration.camera_file import CameraFile
from thermostand.compensation.calibration.model_scores import ray_name
from thermostand.compensation.calibration.pose import find_pose
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.training import frame_states
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.validation3d.deviations import CalibratedCamera, Deviations, deviations
from thermostand.compensation.validation3d.validation_frames import ValidationFrames
from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class StandPart:
    """What the stand has done to each centre since the reference temperature, px; NaN in frames that are not used.

    here (F, N, 2): with the target where it is. excess (F, N, 2): that minus what it does to a target at
    geometry.distance_mm, where the drift was measured. here_errors, excess_errors (V, F, N, 2): how much they change
    when one of V uncertain inputs is larger by its standard uncertainty.
    """

    here: Float
    excess: Float
    here_errors: Float
    excess_errors: Float


def stand_part(
    session: Session, observations: Observations, frames: ValidationFrames, geometry: Geometry, distances_mm: Float
) -> StandPart:
    """distances_mm (P,): of the target's middle from the lens at each position.

    SessionError when one of the five thermometers was silent.
    """
    used = frames.used
    states = dict(zip(used.tolist(), states_at(session, observations.time_ns[used]), strict=True))
    reference = mean_state([states[index] for row in frames.frames[0] for index in row.tolist()])
    _check_known(session, [reference, *states.values()])
    at = [geometry.model_copy(update={"distance_mm": _moved(geometry, z_mm)}) for z_mm in distances_mm.tolist()]
    inputs = 1 + sum(1 for _ in varied(reference, geometry))
    here, at_fit = (np.full((inputs, *observations.centres_px.shape), np.nan) for _ in range(2))
    for row in frames.frames:
        for stand, indices in zip([*at, at[0]], row, strict=True):
            for index in indices.tolist():
                centres = observations.centres_px[index]
                here[:, index] = _displacements_px(states[index], reference, stand, centres)
                at_fit[:, index] = _displacements_px(states[index], reference, geometry, centres)
    excess = here - at_fit
    return StandPart(here[0], excess[0], here[1:] - here[0], excess[1:] - excess[0])


def _check_known(session: Session, states: list[StandState]) -> None:
    for name in StandState.__dataclass_fields__:
        if not all(math.isfinite(getattr(state, name)) for state in states):
            silent = name.removesuffix("_degC")
            raise SessionError(
                f"{session.path}: the thermometer {silent} was silent while poses were taken, so the stand's part "
                "cannot be computed; leave out --budget"
            )


def _moved(geometry: Geometry, distance_mm: float) -> UncertainValue:
    return UncertainValue(value=distance_mm, u=geometry.distance_mm.u)


def _displacements_px(state: StandState, reference: StandState, geometry: Geometry, centres_px: Float) -> Float:
    """(1 + V, N, 2): nominal, and with each uncertain input larger in turn."""
    inputs = [(state, geometry), *varied(state, geometry)]
    return np.array([displacement_px(each, reference, stand, centres_px) for each, stand in inputs])


StandAt = Callable[[Float], StandPart | None]
"""(distances of the positions (P,), mm) -> the stand's part in their frames, None when it was not asked for."""


class LensModel(StrEnum):
    """Which of the camera file's models gives the poses. RAYS is the paper's kind."""

    PINHOLE = "pinhole"
    RAYS = "rays"


@dataclass(frozen=True, slots=True, eq=False)
class SpatialValidation:
    """T temperatures, the first is the reference, P positions.

    names, linear_mm, rotary_deg, distance_mm (P,): V0, V1, ... at the reference. chamber_degC, camera_degC (T,).
    frame_count (T, P): frames averaged. outside (T, P): part of the corrections beyond the model's valid range, flags
    (T, P) why, of drift_model.Outside. before, after: compensation. camera_alone: before, the stand's part taken out;
    with_stand: after, and the stand's part taken at each position's own distance; None when it was not asked for.
    """

    names: tuple[str, ...]
    linear_mm: Float
    rotary_deg: Float
    distance_mm: Float
    chamber_degC: Float
    camera_degC: Float
    frame_count: NDArray[np.int64]
    outside: Float
    flags: NDArray[np.uint8]
    before: Deviations
    after: Deviations
    camera_alone: Deviations | None
    with_stand: Deviations | None
    lens: str
    model: str
    session_id: str
    simulated: bool

    @property
    def variants(self) -> tuple[Deviations, ...]:
        """Those that there are, in order."""
        return tuple(one for one in (self.before, self.after, self.camera_alone, self.with_stand) if one is not None)


def camera_of(file: CameraFile, lens: LensModel) -> CalibratedCamera:
    """The calibrated camera and target of a camera file; CalibrationError when it has no ray model, and that is
    asked for."""
    if lens is LensModel.PINHOLE:
        return CalibratedCamera(file.lens, file.model, file.adjusted_board)
    rays = file.ray_lens
    return CalibratedCamera(rays, ray_name(rays.degree), file.adjusted_board)


def check_same(observations: Observations, file: CameraFile, model: DriftModel) -> None:
    """SessionError when camera file, model and session are not of the same camera and target."""
    facts = observations.sessions[0]
    here = (facts.camera_serial, observations.target.name, observations.image_size)
    others = {
        "camera file": (file.camera_serial, file.target_name, file.image_size_px),
        "drift model": (model.facts.camera_serial, model.facts.target_name, model.facts.image_size),
    }
    for name, other in others.items():
        if other != here:
            raise SessionError(f"the {name} is of {_named(other)}, the session of {_named(here)}")


def validate(
    observations: Observations,
    frames: ValidationFrames,
    camera: CalibratedCamera,
    model: DriftModel,
    stand_at: StandAt = lambda _: None,
) -> SpatialValidation:
    """SessionError when the model has no answer for any frame. CalibrationError when the reference has no pose."""
    compensated = corrected(observations, frames, model)
    if not np.isfinite(compensated.centres_px).any():
        raise SessionError("the drift model has no answer for any frame: the session lacks what it needs")
    before = deviations("before compensation", camera, observations, frames, observations.centres_px)
    after = deviations(
        "after compensation", camera, observations, frames, compensated.centres_px, compensated.model_px2
    )
    distance_mm = _distances_mm(observations, frames, camera)
    alone, with_stand = _stand_variants(observations, frames, camera, compensated, stand_at(distance_mm))
    outside, flags = _outside(frames, compensated, len(frames.names))
    return SpatialValidation(
        names=frames.names,
        linear_mm=frames.linear_mm,
        rotary_deg=frames.rotary_deg,
        distance_mm=distance_mm,
        chamber_degC=frames.chamber_degC,
        camera_degC=_camera_degC(observations, frames),
        frame_count=np.array([[len(indices) for indices in row[:-1]] for row in frames.frames]),
        outside=outside,
        flags=flags,
        before=before,
        after=after,
        camera_alone=alone,
        with_stand=with_stand,
        lens=camera.lens_name,
        model=f"{model.form}: {model.title}",
        session_id=observations.sessions[0].session_id,
        simulated=observations.simulated,
    )


def _named(what: tuple[str, str, tuple[int, int]]) -> str:
    serial, target, (width, height) = what
    return f"camera {serial}, target {target}, {width} x {height} px"


def _distances_mm(observations: Observations, frames: ValidationFrames, camera: CalibratedCamera) -> Float:
    """(P,): of the target's middle along Z, in the first frame of each position."""
    middle = camera.middle_mm
    first = [indices[0] for indices in frames.frames[0][:-1]]
    poses = (
        find_pose(camera.lens, camera.board, observations.centres_px[index], observations.covariance_px2[index])
        for index in first
    )
    return np.array([pose.place_mm(middle)[2] for pose in poses])


def _stand_variants(
    observations: Observations,
    frames: ValidationFrames,
    camera: CalibratedCamera,
    compensated: Corrected,
    stand: StandPart | None,
) -> tuple[Deviations | None, Deviations | None]:
    """The drift model was fitted with the stand's part at the fit's distance in it: only the difference is left."""
    if stand is None:
        return None, None
    alone = observations.centres_px - stand.here
    nearer, model_px2 = compensated.centres_px - stand.excess, compensated.model_px2
    return (
        deviations(
            "before, without the stand's part", camera, observations, frames, alone, errors_px=stand.here_errors
        ),
        deviations(
            "after, the stand's part at each distance",
            camera,
            observations,
            frames,
            nearer,
            model_px2,
            stand.excess_errors,
        ),
    )


def _outside(frames: ValidationFrames, compensated: Corrected, positions: int) -> tuple[Float, NDArray[np.uint8]]:
    shares = np.full((len(frames.frames), positions), np.nan)
    flags = np.zeros(shares.shape, np.uint8)
    for row, steps in enumerate(frames.frames):
        for column, indices in enumerate(steps[:positions]):
            if len(indices):
                shares[row, column] = (compensated.flags[indices] != 0).mean()
                flags[row, column] = np.bitwise_or.reduce(compensated.flags[indices], axis=None)
    return shares, flags


def _camera_degC(observations: Observations, frames: ValidationFrames) -> Float:
    """(T,): mean of the camera's own temperature over a temperature's frames."""
    return np.array([observations.camera_degC[np.concatenate(row)].mean() for row in frames.frames])


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
    model = model.of_sessions(session.session_id for session in observations.sessions)
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
