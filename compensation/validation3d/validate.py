"""The whole validation of a session: what the target's deviations are before and after compensation.

Axes are the calibrated camera's, as in the paper: X to the right in the image, Y down, Z along the optical axis away
from the camera. The place that deviates is the target's middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import StrEnum
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermostand.compensation.budget.budget import (
    average_states,
    compute_displacement_px,
    read_stand_states,
    vary_inputs,
)
from thermostand.compensation.budget.geometry import Geometry, ThermometerState, UncertainValue
from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.calibrate import format_ray_name
from thermostand.compensation.calibration.camera_file import CameraFile
from thermostand.compensation.calibration.pinhole import make_cross_matrices
from thermostand.compensation.calibration.pose import Lens, Pose, find_pose
from thermostand.compensation.calibration.session_centres import (
    MeanCentres,
    TableVisit,
    average_centres,
    compute_scatter_chi,
    list_visits,
    read_position,
)
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Float, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import CalibrationError, SessionError
from thermostand.recording.reading.session import Session

# Session of the validation recipe -> which frames show which validation position at which temperature.

FrameIndices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ValidationFrames:
    """T temperatures in order of visit, the first is the reference; P positions V0, V1, ... in order of visit there.

    linear_mm, rotary_deg (P,): where the axes stood at the reference. chamber_degC (T,): set-points. frames: T rows of
    P + 1 arrays of frame numbers, usable ones; the last is V0 again, at the end of the temperature. An array is empty
    where nothing was seen.
    """

    linear_mm: Float
    rotary_deg: Float
    chamber_degC: Float
    frames: tuple[tuple[FrameIndices, ...], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """V0, V1, ..."""
        return tuple(f"V{index}" for index in range(len(self.linear_mm)))

    @property
    def used(self) -> FrameIndices:
        """All frames of all temperatures, ascending."""
        return np.sort(np.concatenate([frames for row in self.frames for frames in row]))


def select_validation_frames(session: Session, observations: Observations) -> ValidationFrames:
    """SessionError without two temperatures, or when a position was not seen at the first of them."""
    visits = list_visits(session.steps(), {Role.POSE, Role.REPEATABILITY})
    if not visits:
        raise SessionError(
            f"{session.path}: has no capture with the role {Role.POSE}; record one with the validation recipe"
        )
    seen = _group_pose_frames(observations)
    rows = _group_temperatures(visits, seen, observations.chamber_degC)
    if len(rows) < 2:
        raise SessionError(f"{session.path}: poses were seen at {len(rows)} temperature; two are needed to compare")
    (_, reference), *_ = rows
    posed = {
        _get_sent_position(visits[step_id]): step_id
        for step_id in reversed(reference)
        if visits[step_id].role == Role.POSE
    }
    at = list(reversed(posed.values()))
    _check_seen_at_reference(session, visits, at)
    return ValidationFrames(
        linear_mm=np.array([read_position(session, "linear", visits[step_id]) for step_id in at]),
        rotary_deg=np.array([read_position(session, "rotary", visits[step_id]) for step_id in at]),
        chamber_degC=np.array([chamber_degC for chamber_degC, _ in rows]),
        frames=tuple(
            _group_places(visits, seen, steps, [_get_sent_position(visits[step_id]) for step_id in at])
            for _, steps in rows
        ),
    )


def _group_pose_frames(observations: Observations) -> dict[str, FrameIndices]:
    """Step id -> its usable pose frames."""
    steps = np.array(observations.step_id)
    chosen = observations.of(Role.POSE, Role.REPEATABILITY)
    return {str(step_id): np.flatnonzero(chosen & (steps == step_id)) for step_id in np.unique(steps[chosen])}


def _group_temperatures(
    visits: dict[str, TableVisit], seen: dict[str, FrameIndices], chamber_degC: Float
) -> list[tuple[float, list[str]]]:
    """Set-point and the steps seen at it, in order; going back to a set-point is another temperature."""
    known = [step_id for step_id in visits if step_id in seen]
    return [
        (set_point, list(steps)) for set_point, steps in groupby(known, lambda step: float(chamber_degC[seen[step][0]]))
    ]


def _group_places(
    visits: dict[str, TableVisit], seen: dict[str, FrameIndices], steps: list[str], places: list[tuple[float, float]]
) -> tuple[FrameIndices, ...]:
    """The frames at each place, and of the return to the first."""
    found = {(_get_sent_position(visits[step_id]), visits[step_id].role): seen[step_id] for step_id in steps}
    nothing = np.empty(0, np.int64)
    posed = [found.get((place, str(Role.POSE)), nothing) for place in places]
    return (*posed, found.get((places[0], str(Role.REPEATABILITY)), nothing))


def _check_seen_at_reference(session: Session, visits: dict[str, TableVisit], at: list[str]) -> None:
    known = {_get_sent_position(visits[step_id]) for step_id in at}
    for visit in visits.values():
        if _get_sent_position(visit) not in known:
            linear_mm, rotary_deg = _get_sent_position(visit)
            raise SessionError(
                f"{session.path}: the position {linear_mm:g} mm, {rotary_deg:g} deg was not seen at the first "
                "temperature, to which all others are compared"
            )


def _get_sent_position(visit: TableVisit) -> tuple[float, float]:
    return visit.sent["linear"], visit.sent["rotary"]


# How far the target at V0, V1, ... seems to have moved since the reference temperature.

# It was one third until a fitted model's errors were seen to be alike over half of the image.
_CORRELATED = 1 / 2
"""Of the image's width: over this distance errors of a drift model are taken to be alike."""


@dataclass(frozen=True, slots=True, eq=False)
class CentreUncertainty:
    """What is uncertain of centres besides their noise; None without a correction.

    model_px2 (N, 2, 2): covariance of the drift model's. errors_px (V, N, 2): of the stand's, V fields of one standard
    uncertainty each.
    """

    model_px2: Float | None = None
    errors_px: Float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FoundPose:
    """place_mm (3,): of the target's middle. rotation (3, 3). noise, model, stand (6, 6): covariances of a small
    rotation (rad) and of the place (mm) by the markers' noise, the drift model, the stand's correction. chi: of Pose.
    """

    place_mm: Float
    rotation: Float
    noise: Float
    model: Float
    stand: Float
    chi: float


def find_target_pose(
    lens: Lens, board: Board, mean: MeanCentres, growth: float, uncertainty: CentreUncertainty, image_width_px: int
) -> FoundPose:
    """Pose from mean centres, their covariances times `growth`. CalibrationError when the markers give no pose."""
    covariance_px2 = mean.covariance_px2 * growth
    pose = find_pose(lens, board, mean.centres_px, covariance_px2)
    seen = np.isfinite(mean.centres_px[:, 0])
    pixels = mean.centres_px[seen]
    about_middle = _make_lever_matrix(pose, compute_middle_mm(board))
    gain = about_middle @ _compute_gain(lens, board.points_mm[seen], pose, pixels, covariance_px2[seen])
    model, stand = np.zeros((6, 6)), np.zeros((6, 6))
    if uncertainty.model_px2 is not None:
        model = (
            gain @ _compute_field_covariance(pixels, uncertainty.model_px2[seen], _CORRELATED * image_width_px) @ gain.T
        )
    if uncertainty.errors_px is not None:
        moved = uncertainty.errors_px[:, seen].reshape(len(uncertainty.errors_px), -1) @ gain.T
        stand = moved.T @ moved
    noise = about_middle @ pose.covariance @ about_middle.T
    return FoundPose(pose.locate_point_mm(compute_middle_mm(board)), pose.rotation, noise, model, stand, pose.chi)


def compute_middle_mm(board: Board) -> Float:
    """The middle (3,) of the target: of all its points the least dependent on its rotation."""
    return (board.points_mm.min(axis=0) + board.points_mm.max(axis=0)) / 2


def compute_rotation_mrad(found: FoundPose, reference: FoundPose) -> Float:
    """The rotation vector (3,) from the reference's orientation, about the camera's axes."""
    return 1e3 * Rotation.from_matrix(found.rotation @ reference.rotation.T).as_rotvec()


def _make_lever_matrix(pose: Pose, point_mm: Float) -> Float:
    """(6, 6): a pose's small rotation and translation -> the rotation and the shift of a point of the target."""
    found = np.eye(6)
    found[3:, :3] = -make_cross_matrices(pose.rotation @ point_mm)
    return found


def _compute_gain(lens: Lens, points_mm: Float, pose: Pose, pixels: Float, covariance_px2: Float) -> Float:
    """(6, 2N): how the pose follows its centres, (J' W J)^-1 J' W."""
    turned = points_mm @ pose.rotation.T
    moves = np.concatenate([-make_cross_matrices(turned), np.broadcast_to(np.eye(3), (len(turned), 3, 3))], axis=2)
    slopes = lens.compute_point_jacobian(turned + pose.translation_mm, pixels) @ moves
    weighted = np.linalg.inv(covariance_px2) @ slopes
    return pose.covariance @ weighted.reshape(-1, 6).T


def _compute_field_covariance(pixels: Float, covariance_px2: Float, length_px: float) -> Float:
    """(2N, 2N): covariance of an error that is a smooth field, of which (N, 2, 2) is known at each point; along x and
    y independent, between points falling as a Gaussian."""
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1) / length_px
    sigma = np.sqrt(np.diagonal(covariance_px2, axis1=1, axis2=2))
    field = np.exp(-(apart**2) / 2)[:, None, :, None] * np.eye(2)[None, :, None, :]
    return (sigma[:, :, None, None] * field * sigma).reshape(2 * len(pixels), -1)


_LEAST_MARKERS = 12  # as for a calibration; round number, nothing was measured


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """The calibrated camera and target, and what the lens model is called."""

    lens: Lens
    lens_name: str
    board: Board

    @property
    def middle_mm(self) -> Float:
        """The middle (3,) of the target."""
        return compute_middle_mm(self.board)


@dataclass(frozen=True, slots=True, eq=False)
class Deviations:
    """T temperatures, the first is the reference, P positions; NaN where there is no pose.

    translation_um, rotation_mrad (T, P, 3): since the reference, along and about X, Y, Z. noise_um, model_um, stand_um
    (T, P, 3): standard uncertainty of the translation by the markers' noise, the drift model and the stand's
    correction; table_um (3,): by the table, from repeat_um (T, 3), V0 at the end of each temperature minus V0 at its
    begin. u_mrad (T, P, 3): of the rotation, by all but the table. chi (T, P): misfit of the pose, 1 when noise
    explains it.
    """

    name: str
    translation_um: Float
    rotation_mrad: Float
    noise_um: Float
    model_um: Float
    stand_um: Float
    u_mrad: Float
    repeat_um: Float
    table_um: Float
    chi: Float

    @property
    def u_um(self) -> Float:
        """(T, P, 3): standard uncertainty of the translation; a deviation has the table's share twice."""
        return np.sqrt(self.noise_um**2 + self.model_um**2 + self.stand_um**2 + 2 * self.table_um**2)

    @property
    def per_temperature_um(self) -> Float:
        """(T, 3): mean absolute deviation over the positions."""
        return _average_known(np.abs(self.translation_um), axis=1)

    @property
    def u_per_temperature_um(self) -> Float:
        """(T, 3): its standard uncertainty, the positions' taken as fully correlated: an upper limit."""
        return _average_known(self.u_um, axis=1)

    @property
    def mean_um(self) -> Float:
        """(3,): mean over the temperatures but the reference; what the paper reports."""
        return _average_known(self.per_temperature_um[1:], axis=0)

    @property
    def u_mean_um(self) -> Float:
        """(3,): its standard uncertainty, an upper limit as above."""
        return _average_known(self.u_per_temperature_um[1:], axis=0)

    @property
    def mean_rotation_mrad(self) -> Float:
        """(3,): mean absolute rotation over the positions, then over the temperatures but the reference."""
        return _average_known(_average_known(np.abs(self.rotation_mrad), axis=1)[1:], axis=0)


def compute_deviations(
    name: str,
    camera: CalibratedCamera,
    observations: Observations,
    frames: ValidationFrames,
    centres_px: Float,
    *,
    model_px2: Float | None = None,
    errors_px: Float | None = None,
) -> Deviations:
    """Compute the deviations in space from centres (F, N, 2), which may be corrected. model_px2 (F, N, 2, 2), errors_px
    (V, F, N, 2): of the corrections, as CentreUncertainty has them.

    The frames of a position at a temperature are averaged first. CalibrationError when V0, V1, ... at the reference
    have no pose.
    """
    means = [[_average_centres(observations, centres_px, indices) for indices in row] for row in frames.frames]
    chi = compute_scatter_chi([mean for row in means for mean in row if mean is not None])
    growth = 1.0 if np.isnan(chi) else max(1.0, chi) ** 2
    width = observations.image_size[0]
    grid: list[list[FoundPose | None]] = []
    for row, indices in zip(means, frames.frames, strict=True):
        grid.append([])
        for mean, chosen in zip(row, indices, strict=True):
            uncertainty = _average_uncertainty(chosen, model_px2, errors_px)
            grid[-1].append(
                None if mean is None else find_target_pose(camera.lens, camera.board, mean, growth, uncertainty, width)
            )
    return _compare_poses(name, frames.names, grid)


def _average_uncertainty(indices: FrameIndices, model_px2: Float | None, errors_px: Float | None) -> CentreUncertainty:
    """Means over the frames: what is wrong with a correction is common to them. Of the frames that have the marker."""
    return CentreUncertainty(
        None if model_px2 is None or not len(indices) else _average_known(model_px2[indices], axis=0),
        None if errors_px is None or not len(indices) else _average_known(errors_px[:, indices], axis=1),
    )


def _average_centres(observations: Observations, centres_px: Float, indices: FrameIndices) -> MeanCentres | None:
    """Average the centres of frames; None when too few markers are left for a pose that can be judged."""
    mean = average_centres(centres_px[indices], observations.covariance_px2[indices]) if len(indices) else None
    if mean is None or np.count_nonzero(np.isfinite(mean.centres_px[:, 0])) < _LEAST_MARKERS:
        return None
    return mean


def _compare_poses(name: str, names: tuple[str, ...], grid: list[list[FoundPose | None]]) -> Deviations:
    count = len(names)
    reference = [found for found in grid[0][:count] if found is not None]
    if len(reference) < count:
        missing = next(name for name, found in zip(names, grid[0], strict=False) if found is None)
        raise CalibrationError(
            f"{missing} at the reference temperature, from which all deviations are, has fewer than {_LEAST_MARKERS} "
            f"markers ({name})"
        )
    apart = [[_compare_pose(found, first) for found, first in zip(row, reference, strict=False)] for row in grid]
    repeats = [_compare_pose(row[count], row[0]) for row in grid]
    return Deviations(
        name=name,
        **{
            field.name: np.array([[getattr(one, field.name) for one in row] for row in apart])
            for field in fields(_PoseDifference)
        },
        repeat_um=np.array([one.translation_um for one in repeats]),
        table_um=_estimate_table_um(repeats),
        chi=np.array([[np.nan if found is None else found.chi for found in row[:count]] for row in grid]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _PoseDifference:
    """One pose against another, each (3,)."""

    translation_um: Float
    rotation_mrad: Float
    noise_um: Float
    model_um: Float
    stand_um: Float
    u_mrad: Float


def _compare_pose(found: FoundPose | None, other: FoundPose | None) -> _PoseDifference:
    """What the drift model leaves unexplained counts twice, at the reference as well; the stand's correction is nothing
    there, and its errors count once."""
    if found is None or other is None:
        return _PoseDifference(*np.full((6, 3), np.nan))
    noise = np.diagonal(found.noise) + np.diagonal(other.noise)
    model = np.diagonal(found.model) + np.diagonal(other.model)
    stand = np.diagonal(found.stand)
    return _PoseDifference(
        translation_um=1e3 * (found.place_mm - other.place_mm),
        rotation_mrad=compute_rotation_mrad(found, other),
        noise_um=1e3 * np.sqrt(noise[3:]),
        model_um=1e3 * np.sqrt(model[3:]),
        stand_um=1e3 * np.sqrt(stand[3:]),
        u_mrad=1e3 * np.sqrt((noise + model + stand)[:3]),
    )


def _estimate_table_um(repeats: list[_PoseDifference]) -> Float:
    """(3,): standard uncertainty of one visit, from the scatter of returns without the markers' share; what the camera
    drifts in these minutes is in it. 0 when the table never came back."""
    squares = np.array([one.translation_um**2 - one.noise_um**2 for one in repeats])
    return np.sqrt(np.maximum(np.nan_to_num(_average_known(squares, axis=0)), 0) / 2)


def _average_known(values: Float, axis: int) -> Float:
    """Average what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class StandContribution:
    """What the stand has done to each centre since the reference temperature, px; NaN in frames that are not used.

    here (F, N, 2): with the target where it is. excess (F, N, 2): that minus what it does to a target at
    geometry.distance_mm, where the drift was measured. here_errors, excess_errors (V, F, N, 2): how much they change
    when one of V uncertain inputs is larger by its standard uncertainty.
    """

    here: Float
    excess: Float
    here_errors: Float
    excess_errors: Float


def compute_stand_contribution(
    session: Session, observations: Observations, frames: ValidationFrames, geometry: Geometry, distances_mm: Float
) -> StandContribution:
    """distances_mm (P,): of the target's middle from the lens at each position.

    SessionError when one of the five thermometers was silent.
    """
    used = frames.used
    states = dict(zip(used.tolist(), read_stand_states(session, observations.time_ns[used]), strict=True))
    reference = average_states([states[index] for row in frames.frames[0] for index in row.tolist()])
    _check_known(session, [reference, *states.values()])
    at = [geometry.model_copy(update={"distance_mm": _with_distance(geometry, z_mm)}) for z_mm in distances_mm.tolist()]
    inputs = 1 + sum(1 for _ in vary_inputs(reference, geometry))
    here, at_fit = (np.full((inputs, *observations.centres_px.shape), np.nan) for _ in range(2))
    for row in frames.frames:
        for stand, indices in zip([*at, at[0]], row, strict=True):
            for index in indices.tolist():
                centres = observations.centres_px[index]
                here[:, index] = _compute_displacements_px(states[index], reference, stand, centres)
                at_fit[:, index] = _compute_displacements_px(states[index], reference, geometry, centres)
    excess = here - at_fit
    return StandContribution(here[0], excess[0], here[1:] - here[0], excess[1:] - excess[0])


def _check_known(session: Session, states: list[ThermometerState]) -> None:
    for name in ThermometerState.__dataclass_fields__:
        if not all(math.isfinite(getattr(state, name)) for state in states):
            silent = name.removesuffix("_degC")
            raise SessionError(
                f"{session.path}: the thermometer {silent} was silent while poses were taken, so the stand's part "
                "cannot be computed; leave out --budget"
            )


def _with_distance(geometry: Geometry, distance_mm: float) -> UncertainValue:
    return UncertainValue(value=distance_mm, u=geometry.distance_mm.u)


def _compute_displacements_px(
    state: ThermometerState, reference: ThermometerState, geometry: Geometry, centres_px: Float
) -> Float:
    """(1 + V, N, 2): nominal, and with each uncertain input larger in turn."""
    inputs = [(state, geometry), *vary_inputs(state, geometry)]
    return np.array([compute_displacement_px(each, reference, stand, centres_px) for each, stand in inputs])


StandAt = Callable[[Float], StandContribution | None]
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
        """The variants that were computed, in order."""
        return tuple(one for one in (self.before, self.after, self.camera_alone, self.with_stand) if one is not None)


def select_lens_model(file: CameraFile, lens: LensModel) -> CalibratedCamera:
    """The calibrated camera and target of a camera file; CalibrationError when it has no ray model, and that is
    asked for."""
    if lens is LensModel.PINHOLE:
        return CalibratedCamera(file.lens, file.model, file.adjusted_board)
    rays = file.ray_lens
    return CalibratedCamera(rays, format_ray_name(rays.degree), file.adjusted_board)


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
            raise SessionError(f"the {name} is of {_format_setup(other)}, the session of {_format_setup(here)}")


def validate(
    observations: Observations,
    frames: ValidationFrames,
    camera: CalibratedCamera,
    model: DriftModel,
    stand_at: StandAt = lambda _: None,
) -> SpatialValidation:
    """SessionError when the model has no answer for any frame. CalibrationError when the reference has no pose."""
    compensated = correct_centres(observations, frames, model)
    if not np.isfinite(compensated.centres_px).any():
        raise SessionError("the drift model has no answer for any frame: the session lacks what it needs")
    before = compute_deviations("before compensation", camera, observations, frames, observations.centres_px)
    after = compute_deviations(
        "after compensation", camera, observations, frames, compensated.centres_px, model_px2=compensated.model_px2
    )
    distance_mm = _compute_distances_mm(observations, frames, camera)
    alone, with_stand = _compute_stand_variants(observations, frames, camera, compensated, stand_at(distance_mm))
    outside, flags = _summarise_flags(frames, compensated, len(frames.names))
    return SpatialValidation(
        names=frames.names,
        linear_mm=frames.linear_mm,
        rotary_deg=frames.rotary_deg,
        distance_mm=distance_mm,
        chamber_degC=frames.chamber_degC,
        camera_degC=_average_camera_degC(observations, frames),
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


def _format_setup(what: tuple[str, str, tuple[int, int]]) -> str:
    serial, target, (width, height) = what
    return f"camera {serial}, target {target}, {width} x {height} px"


def _compute_distances_mm(observations: Observations, frames: ValidationFrames, camera: CalibratedCamera) -> Float:
    """(P,): of the target's middle along Z, in the first frame of each position."""
    middle = camera.middle_mm
    first = [indices[0] for indices in frames.frames[0][:-1]]
    poses = (
        find_pose(camera.lens, camera.board, observations.centres_px[index], observations.covariance_px2[index])
        for index in first
    )
    return np.array([pose.locate_point_mm(middle)[2] for pose in poses])


def _compute_stand_variants(
    observations: Observations,
    frames: ValidationFrames,
    camera: CalibratedCamera,
    compensated: CorrectedCentres,
    stand: StandContribution | None,
) -> tuple[Deviations | None, Deviations | None]:
    """The drift model was fitted with the stand's part at the fit's distance in it: only the difference is left."""
    if stand is None:
        return None, None
    alone = observations.centres_px - stand.here
    nearer, model_px2 = compensated.centres_px - stand.excess, compensated.model_px2
    return (
        compute_deviations(
            "before, without the stand's part", camera, observations, frames, alone, errors_px=stand.here_errors
        ),
        compute_deviations(
            "after, the stand's part at each distance",
            camera,
            observations,
            frames,
            nearer,
            model_px2=model_px2,
            errors_px=stand.excess_errors,
        ),
    )


def _summarise_flags(
    frames: ValidationFrames, compensated: CorrectedCentres, positions: int
) -> tuple[Float, NDArray[np.uint8]]:
    shares = np.full((len(frames.frames), positions), np.nan)
    flags = np.zeros(shares.shape, np.uint8)
    for row, steps in enumerate(frames.frames):
        for column, indices in enumerate(steps[:positions]):
            if len(indices):
                shares[row, column] = (compensated.flags[indices] != 0).mean()
                flags[row, column] = np.bitwise_or.reduce(compensated.flags[indices], axis=None)
    return shares, flags


def _average_camera_degC(observations: Observations, frames: ValidationFrames) -> Float:
    """(T,): mean of the camera's own temperature over a temperature's frames."""
    return np.array([observations.camera_degC[np.concatenate(row)].mean() for row in frames.frames])


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedCentres:
    """centres_px (F, N, 2): corrected, NaN in other frames, for missing markers and where the model has no answer.
    model_px2 (F, N, 2, 2): covariance of the correction alone. flags (F, N): of drift_model.Outside."""

    centres_px: Float
    model_px2: Float
    flags: NDArray[np.uint8]


def correct_centres(observations: Observations, frames: ValidationFrames, model: DriftModel) -> CorrectedCentres:
    """Every marker of the frames that are used."""
    states = compute_frame_states(observations, model.memory)
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
    return CorrectedCentres(centres_px, model_px2, flags)
