"""Observations from plain arrays or a CSV table: a fit of centres measured elsewhere needs no session and no stand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermostand.compensation.camera_selection import read_frame_temperatures
from thermostand.compensation.history.thermal_history import (
    States,
    ThermalHistory,
    ThermalStateSpec,
    compute_states_at,
    read_history,
    refine_temperature,
)
from thermostand.compensation.observations import Float, Observations, SessionFacts, concatenate
from thermostand.compensation.spreadsheet import Spreadsheet, read_spreadsheet
from thermostand.compensation.value_checks import LARGEST_SIDE_px, check_centres, check_degC
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.markers.target import Target
from thermostand.recording.reading.interpolation import interpolate
from thermostand.recording.reading.session import Session

Column = tuple[ArrayLike, ArrayLike]
"""Instants, ns, ascending, and values."""


class StatefulModel(Protocol):
    """A drift model."""

    @property
    def memory(self) -> ThermalStateSpec:
        """What has to be remembered for it."""
        ...


def states(
    model: StatefulModel,
    session: Session | None = None,
    time_ns: ArrayLike | None = None,
    camera_degC: ArrayLike | None = None,
    *,
    air: Column | None = None,
    supply: Column | None = None,
    camera: Column | None = None,
) -> States:
    """Compute the camera's thermal state at F instants, for `model.correct(points, states(...))`.

    Give either a session, or arrays: `time_ns` and `air`, with `supply` and `camera` where they are known.

    Parameters
    ----------
    model : DriftModel
        The model that is asked; it decides what has to be remembered of the past.
    session : Session, optional
        The session that recorded the camera.
    time_ns : (F,), optional
        The instants, ascending. In a session they are by default those of its frames.
    camera_degC : (F,), optional
        The camera's own temperature at the instants, where it is known better.
    air : (time_ns, degC), optional
        The air near the camera, from the time before the instants on.
    supply : (time_ns, 0 or 1), optional
        Whether the camera is on, until the next instant. By default it is on.
    camera : (time_ns, degC), optional
        The camera's own temperature between the frames.

    Returns
    -------
    States
        F states: one for all points, or one for each point.

    Raises
    ------
    ValueError
        When neither a session nor `time_ns` with `air` is given, or shapes do not agree.
    """
    if session is None:
        if time_ns is None or air is None:
            raise ValueError(
                "give a session, or time_ns and air=(time_ns, degC): a thermal state follows from the past"
            )
        instants, own = _check_instants(time_ns, camera_degC)
        return compute_states_at(build_history(air, supply, camera, instants, own), model.memory, instants, own)
    if air is not None or supply is not None or camera is not None:
        raise ValueError("air, supply and camera belong to arrays; a session has recorded them")
    recorded_degC = read_frame_temperatures(session)
    wanted = session.frame_times_ns if time_ns is None else time_ns
    instants, own = _check_instants(wanted, camera_degC)
    if camera_degC is None:
        own = np.array([recorded_degC.get(instant, math.nan) for instant in instants.tolist()])
    return compute_states_at(read_history(session), model.memory, instants, own)


def build_history(
    air: Column, supply: Column | None, camera: Column | None, time_ns: NDArray[np.int64], camera_degC: Float
) -> ThermalHistory:
    """Return what lags are computed from; ValueError when a column is none. A camera without `supply` is on, for it has
    temperatures, and without `camera` what it read at the frames is all that is known of its own."""
    frames = time_ns, camera_degC
    powered = (np.empty(0, np.int64), np.empty(0)) if supply is None else _check_column("supply", supply)
    if np.any((powered[1] != 0) & (powered[1] != 1)):
        raise ValueError("supply: expected 0 (off) and 1 (on)")
    own = frames if camera is None else _check_column("camera", camera)
    measured = np.isfinite(own[1])
    return refine_temperature(ThermalHistory(*_check_column("air", air), *powered, own[0][measured], own[1][measured]))


def _check_column(name: str, given: Column) -> tuple[NDArray[np.int64], Float]:
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


def _check_instants(time_ns: ArrayLike, camera_degC: ArrayLike | None) -> tuple[NDArray[np.int64], Float]:
    instants = np.atleast_1d(np.array(time_ns, np.int64))
    own = np.full(len(instants), np.nan) if camera_degC is None else np.atleast_1d(np.array(camera_degC, np.float64))
    if instants.ndim != 1 or own.shape != instants.shape:
        raise ValueError(f"time_ns and camera_degC are (F,), not {instants.shape} and {own.shape}")
    if np.any(np.diff(instants) < 0):
        raise ValueError("time_ns go backwards; give the instants in order of time")
    return instants, own


NEEDED = ("frame", "marker", "x_px", "y_px", "camera_degC")
COVARIANCE = ("var_x_px2", "cov_xy_px2", "var_y_px2")
SIZE = ("width_px", "height_px")
CENTRE_COLUMNS = (
    "session", "frame", "image", "time_ns", "role", "chamber_degC", "camera_degC", "air_degC", *SIZE,
    "marker", "x_px", "y_px", *COVARIANCE,
)  # fmt: skip
"""Of the table of centres that `compensate observe` writes; those that `load_observations` does not need may lack."""
_OF_FRAMES = ("session", "role", "chamber_degC", "camera_degC", "air_degC", "time_ns")
_ROW_EACH = f"it needs {', '.join(NEEDED)}, a row for each centre"
_MOST_FRAMES, _MOST_MARKERS, _LAST_NS = 1_000_000, 100_000, 2**63 - 1
Index = NDArray[np.int64]


def load_observations(path: Path, camera_serial: str = "") -> Observations:
    """Load a table of centres, as any spreadsheet program writes it.

    It has a row for each centre: frame and marker (whole numbers from 0 on, in any order), x_px, y_px and camera_degC;
    and, where they are known, time_ns, chamber_degC (the set-point), role, air_degC (of the air near the camera, for
    the thermal form), var_x_px2, cov_xy_px2 and var_y_px2, width_px and height_px of the image, and session: between
    two sessions target or camera were moved, and each has its own reference. A row without a marker is a reading
    between the frames, of time_ns with air_degC or camera_degC.

    A marker without a row, or with an empty place, is missing. SessionError that names file, line and column.
    """
    table = read_spreadsheet(path)
    table.require(NEEDED, _ROW_EACH)
    missing = [name for name in COVARIANCE if not table.has(name)]
    if missing and len(missing) < len(COVARIANCE):
        raise SessionError(f"{path}: has no column {missing[0]}; {_ROW_EACH}")
    of_marker = np.array([bool(text) for text in table.column("marker")], bool)
    seen, readings = table.select(of_marker), table.select(~of_marker)
    if not seen.lines:
        raise SessionError(f"{path}: has no rows; it needs one for each centre")
    frame, frame_at = np.unique(seen.whole_numbers("frame", _MOST_FRAMES), return_inverse=True)
    marker = seen.whole_numbers("marker", _MOST_MARKERS)
    pairs, first = np.unique(np.column_stack([frame_at, marker]), axis=0, return_index=True)
    if len(pairs) < len(marker):
        row = int(np.setdiff1d(np.arange(len(marker)), first)[0])
        raise seen.fault(row, f"frame {frame[frame_at[row]]} has this marker already")
    centres = np.full((len(frame), int(marker.max()) + 1, 2), np.nan)
    covariance = np.full((*centres.shape, 2), np.nan)
    centres[frame_at, marker] = np.column_stack([seen.numbers("x_px"), seen.numbers("y_px")])
    if not missing:
        covariance[frame_at, marker] = _parse_covariances(seen)
    frames = _take_first_rows(seen, frame_at)
    size = _parse_size(seen)
    if size is None and np.isfinite(centres).any():
        size = _estimate_image_size(centres)
    sessions = frames.column("session") if frames.has("session") else [""] * len(frame)
    parts: list[Observations] = []
    for name in dict.fromkeys(sessions):
        own = np.array([each == name for each in sessions], bool)
        given = _FrameColumns.of(frames.select(own), readings.select(_is_of(readings, name)))
        try:
            parts.append(
                observations_of(
                    centres[own],
                    given.camera_degC,
                    given.time_ns,
                    chamber_degC=given.chamber_degC,
                    role=given.role,
                    air=given.air,
                    camera=given.camera,
                    covariance_px2=None if missing else covariance[own],
                    image_size=size,
                    camera_serial=camera_serial,
                    name=f"{path.stem} {name}".strip(),
                )
            )
        except ValueError as error:
            raise SessionError(f"{path}: {error}") from error
    return concatenate(parts)


@dataclass(frozen=True, slots=True, eq=False)
class _FrameColumns:
    """What a table says of the frames of one session; None for a column that it has not."""

    camera_degC: Float
    time_ns: Index | None
    chamber_degC: Float | None
    role: list[str] | None
    air: Column | None
    camera: Column | None

    @classmethod
    def of(cls, frames: Spreadsheet, readings: Spreadsheet) -> _FrameColumns:
        """SessionError that names what does not fit."""
        path, time_ns = frames.path, None
        if frames.states("time_ns"):
            time_ns = frames.whole_numbers("time_ns", _LAST_NS)
            if (np.diff(time_ns) <= 0).any():
                raise SessionError(
                    f"{path}: time_ns does not grow from frame to frame; number the frames in order of time"
                )
        if frames.states("air_degC") and time_ns is None:
            raise SessionError(f"{path}: has air_degC without time_ns; the thermal form needs both")
        air, camera = (_merge_readings(frames, readings, time_ns, name) for name in ("air_degC", "camera_degC"))
        return cls(
            camera_degC=frames.numbers("camera_degC"),
            time_ns=time_ns,
            chamber_degC=frames.numbers("chamber_degC") if frames.states("chamber_degC") else None,
            role=_check_roles(frames) if frames.states("role") else None,
            air=air,
            camera=camera if air is not None and readings.lines else None,
        )


def _merge_readings(frames: Spreadsheet, readings: Spreadsheet, time_ns: Index | None, name: str) -> Column | None:
    """The instants, ascending, and values of a column, in the frames and between them; None where it is not known."""
    if time_ns is None or not frames.states(name):
        return None
    instants = np.concatenate([time_ns, readings.whole_numbers("time_ns", _LAST_NS)])
    values = np.concatenate([frames.numbers(name), readings.numbers(name)])
    order = np.argsort(instants, kind="stable")
    known = order[np.isfinite(values[order])]
    return (instants[known], values[known]) if len(known) else None


def _is_of(readings: Spreadsheet, session: str) -> NDArray[np.bool_]:
    """(M,): readings of this session, and those of all."""
    if not readings.has("session"):
        return np.ones(len(readings.lines), bool)
    return np.array([text in ("", session) for text in readings.column("session")], bool)


def _take_first_rows(table: Spreadsheet, frame_at: NDArray[np.intp]) -> Spreadsheet:
    """The first row of each frame, in the order of their numbers; SessionError when a later row contradicts it."""
    _, first = np.unique(frame_at, return_index=True)
    for name in (name for name in _OF_FRAMES if table.has(name)):
        cells = table.column(name)
        for row, at in enumerate(frame_at.tolist()):
            if cells[row] != cells[first[at]]:
                frame = table.column("frame")[row]
                raise table.fault(row, f"{name} of frame {frame} is another one in an earlier line")
    return table.take(first)


def _parse_size(table: Spreadsheet) -> tuple[int, int] | None:
    """The image's width and height, px; None where the table does not say them."""
    if not all(table.has(name) for name in SIZE):
        return None
    found = np.unique(np.column_stack([table.whole_numbers(name, LARGEST_SIDE_px + 1) for name in SIZE]), axis=0)
    if len(found) > 1:
        raise SessionError(f"{table.path}: {' and '.join(SIZE)} are not the same in all rows; one camera has one size")
    return int(found[0, 0]), int(found[0, 1])


def _parse_covariances(table: Spreadsheet) -> Float:
    """(M, 2, 2); SessionError where it is none."""
    xx, xy, yy = (table.numbers(name) for name in COVARIANCE)
    placed = np.isfinite(table.numbers("x_px"))
    wrong = placed & ~((xx > 0) & (yy > 0) & (xx * yy > xy**2))
    if wrong.any():
        raise table.fault(int(np.flatnonzero(wrong)[0]), f"{', '.join(COVARIANCE)} are no covariance of a centre")
    return np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)


def _check_roles(table: Spreadsheet) -> list[str]:
    known = [str(role) for role in Role]
    roles = [text.casefold() for text in table.column("role")]
    for row, text in enumerate(roles):
        if text not in known:
            raise table.fault(row, f"role is {table.column('role')[row]!r}, not one of {', '.join(known)}")
    return roles


_SPACING_mm = 1.0  # only ratios of the made-up grid count
# A fit's own covariance is symmetric to rounding only; given back as it is, it has to be accepted.
_ROUNDING = 1e-9


def observations_of(
    centres_px: ArrayLike,
    camera_degC: ArrayLike,
    time_ns: ArrayLike | None = None,
    *,
    chamber_degC: ArrayLike | None = None,
    reference_degC: float | None = None,
    role: ArrayLike | None = None,
    air: Column | None = None,
    supply: Column | None = None,
    camera: Column | None = None,
    sigma_px: float = 0.01,
    covariance_px2: ArrayLike | None = None,
    image_size: tuple[int, int] | None = None,
    target: Target | None = None,
    camera_serial: str = "",
    name: str = "arrays",
) -> Observations:
    """Make observations of plain arrays: F frames of N markers of one camera.

    Parameters
    ----------
    centres_px : (F, N, 2)
        The centres (x, y) in px; NaN where a marker is missing.
    camera_degC : (F,)
        The camera's own temperature. A frame where it is NaN is not used.
    time_ns : (F,), optional
        The middle of each exposure, ascending. By default there is one frame a second.
    chamber_degC : (F,), optional
        The set-point, whose frames are left out together to choose a model. By default it is camera_degC in whole
        degrees.
    reference_degC : float, optional
        The frames at the set-point nearest to it are the reference. By default that of the first frame is.
    role : (F,), optional
        Values of experiments.steps.Role. By default `reference` at the reference and `fit` at the others.
    air : (time_ns, degC), both (A,), optional
        The air near the camera, which the thermal form needs.
    supply : (time_ns, 0 or 1), optional
        When the camera was off and on, only together with air. By default it was on all the time.
    camera : (time_ns, degC), optional
        The camera's own readings between the frames, only together with air. By default its temperature is taken to go
        straight from one frame to the next.
    sigma_px : float
        Standard uncertainty of a coordinate, where there is no covariance_px2.
    covariance_px2 : (F, N, 2, 2), optional
        The covariance of each centre.
    image_size : (width, height), optional
        In px. By default it is what holds the centres.
    target : Target, optional
        The target. By default one without a name, of as many markers, stands for it.
    camera_serial : str
        The camera's serial number; sessions of another one are refused.
    name : str
        The session's id, in messages and reports.

    Returns
    -------
    Observations
        One session of frames, as `fit` takes them.

    Raises
    ------
    ValueError
        When shapes do not agree, or a value cannot be what it is given as.
    """
    centres, own = _check_centres(centres_px, camera_degC)
    if air is None and (supply is not None or camera is not None):
        raise ValueError("supply and camera say more of a camera's past only together with air")
    frames, count = centres.shape[:2]
    instants, chamber, roles = _fill_frame_columns(own, time_ns, chamber_degC, role, reference_degC)
    missing, size = np.isnan(centres).any(axis=2) | np.isnan(own)[:, None], image_size or _estimate_image_size(centres)
    check_centres("centres_px", centres, size)
    covariance = _check_covariance(covariance_px2, sigma_px, missing)
    history = None if air is None else build_history(air, supply, camera, instants, own)
    return Observations(
        target=target or _make_anonymous_target(count),
        sessions=(SessionFacts(name, "", camera_serial, "", "", simulated=None, incomplete=0),),
        image_size=size,
        preview=np.zeros((max(1, size[1] // 8), max(1, size[0] // 8)), np.uint8),
        session=np.zeros(frames, np.int64),
        frame=np.arange(frames),
        time_ns=instants,
        role=roles,
        step_id=("",) * frames,
        chamber_degC=chamber,
        camera_degC=own,
        air_degC=_interpolate_air(history, instants),
        centres_px=np.where(missing[..., None], np.nan, centres),
        covariance_px2=np.where(missing[..., None, None], np.nan, covariance),
        flags=np.zeros((frames, count), np.uint8),
        reasons=tuple(map(_explain_unusable, own.tolist(), np.all(missing, axis=1).tolist())),
        histories=() if history is None else (history,),
        not_known=_list_unknown(
            {
                "times": time_ns is None,
                "air": history is None,
                "supply": history is not None and supply is None,
                "set_points": chamber_degC is None,
                "uncertainty": covariance_px2 is None,
            },
            sigma_px,
        ),
    )


def _list_unknown(is_unknown: Mapping[str, bool], sigma_px: float) -> dict[str, str]:
    """Return what follows from each thing that is not known."""
    meaning = {
        "times": "times: drift with time, as while switching on, cannot be separated from drift with temperature",
        "air": "the air near the camera, and its history: the thermal form, which has lags, cannot be fitted",
        "supply": "when the camera was off: it is taken to have been on all the time",
        "set_points": "set-points: the camera's temperature in whole degrees stands for them",
        "uncertainty": f"uncertainty of the centres: {sigma_px:g} px is taken for each coordinate",
    }
    return {name: text for name, text in meaning.items() if is_unknown[name]}


def _check_covariance(covariance_px2: ArrayLike | None, sigma_px: float, missing: NDArray[np.bool_]) -> Float:
    """Return what is given, else that of coordinates with this uncertainty each, for all of (F, N, 2, 2); ValueError
    when it is no covariance of a centre that is there."""
    if covariance_px2 is None:
        if not sigma_px > 0:
            raise ValueError(f"sigma_px is {sigma_px}; expected one above 0")
        return np.eye(2) * sigma_px**2
    given, shape = _to_array("covariance_px2", covariance_px2), (*missing.shape, 2, 2)
    if given.shape not in ((2, 2), shape):
        raise ValueError(f"covariance_px2 has shape {given.shape}, not {shape} or, one for all, (2, 2)")
    whole = np.broadcast_to(given, shape)
    xx, xy, yx, yy = whole.reshape(-1, 4).T
    symmetric = np.abs(xy - yx) <= _ROUNDING * np.abs(xx + yy)  # a fit's own is so to rounding
    sound = ((xx > 0) & (yy > 0) & (xx * yy > xy**2) & symmetric & np.isfinite(xx + yy)).reshape(missing.shape)
    if wrong := np.argwhere(~missing & ~sound).tolist():
        frame, marker = wrong[0]
        raise ValueError(
            f"covariance_px2 of frame {frame}, marker {marker} is no covariance: {whole[frame, marker].tolist()}"
        )
    return whole


def _to_array(what: str, given: ArrayLike) -> Float:
    """Return an argument as an array; ValueError says which one holds no numbers, or rows of different lengths."""
    try:
        return np.array(given, np.float64)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{what}: expected numbers, as many in each row ({error})") from error


def _check_centres(centres_px: ArrayLike, camera_degC: ArrayLike) -> tuple[Float, Float]:
    """Centres (F, N, 2) and temperatures (F,); ValueError when they are not."""
    centres, camera = _to_array("centres_px", centres_px), _to_array("camera_degC", camera_degC)
    if centres.ndim != 3 or centres.shape[2] != 2 or camera.shape != centres.shape[:1] or not len(camera):
        raise ValueError(f"centres are (F, N, 2) and temperatures (F,), not {centres.shape} and {camera.shape}")
    if not np.isfinite(centres).all(axis=2).any():
        raise ValueError(f"none of the {len(centres)} frames has a centre: centres_px are all NaN")
    check_degC("camera_degC", camera)
    return centres, camera


def _fill_frame_columns(
    camera_degC: Float,
    time_ns: ArrayLike | None,
    chamber_degC: ArrayLike | None,
    role: ArrayLike | None,
    reference_degC: float | None,
) -> tuple[NDArray[np.int64], Float, NDArray[np.str_]]:
    """Instants, set-points and roles (F,) of the frames, as given or as supposed; ValueError when one is not (F,)."""
    frames = len(camera_degC)
    if chamber_degC is not None:
        check_degC("chamber_degC", _to_array("chamber_degC", chamber_degC))
    instants = np.arange(frames) * NS_PER_S if time_ns is None else np.array(time_ns, np.int64)
    chamber = np.round(camera_degC) if chamber_degC is None else np.array(chamber_degC, np.float64)
    roles = _assign_default_roles(chamber, reference_degC) if role is None else np.array(role, np.str_)
    for what, column in (("time_ns", instants), ("chamber_degC", chamber), ("role", roles)):
        if column.shape != (frames,):
            raise ValueError(f"{what} has shape {column.shape}, not ({frames},)")
    if (falls := np.flatnonzero(np.diff(instants) <= 0)).size:
        raise ValueError(f"time_ns does not grow at frame {falls[0] + 1}; give the frames in order of time")
    known = [str(each) for each in Role]
    if unknown := sorted(set(roles.tolist()) - set(known)):
        raise ValueError(f"role has {unknown[0]!r}; there are {', '.join(known)}")
    return instants, chamber, roles


def _estimate_image_size(centres_px: Float) -> tuple[int, int]:
    """(width, height) of an image that holds all centres (F, N, 2), of at most the size of a sensor."""
    width, height = np.clip(np.ceil(np.nanmax(centres_px, axis=(0, 1))) + 1, 1, LARGEST_SIDE_px)
    return int(width), int(height)


def _interpolate_air(history: ThermalHistory | None, time_ns: NDArray[np.int64]) -> Float:
    """The air's temperature at these instants, NaN where it is not known."""
    if history is None:
        return np.full(len(time_ns), np.nan)
    return interpolate(history.ambient_ns, history.ambient_degC, time_ns)


def _explain_unusable(camera_degC: float, unseen: bool) -> str:
    if math.isnan(camera_degC):
        return "the camera's temperature is unknown"
    return "no marker has a centre" if unseen else ""


def _assign_default_roles(chamber_degC: Float, reference_degC: float | None) -> NDArray[np.str_]:
    """`reference` at the set-point nearest to the wanted one, `fit` at the others."""
    known = np.unique(chamber_degC[np.isfinite(chamber_degC)])
    wanted = chamber_degC[0] if reference_degC is None else reference_degC
    nearest = known[np.argmin(np.abs(known - wanted))] if len(known) else math.nan
    return np.where(chamber_degC == nearest, str(Role.REFERENCE), str(Role.FIT))


def _make_anonymous_target(count: int) -> Target:
    """N markers in no known order: models are of the image, and do not ask where the markers are on the target."""
    return Target.model_construct(
        name="", columns=count, rows=1, pitch_mm=_SPACING_mm, diameter_mm=_SPACING_mm / 3, minimum_markers=None
    )
