"""Observations from plain arrays: a fit of centres measured elsewhere needs no session and no stand."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermostand.compensation.history.known_states import Column, history_of
from thermostand.compensation.history.thermal_history import History
from thermostand.compensation.observations import Float, Observations, SessionFacts
from thermostand.compensation.sound_values import LARGEST_SIDE_px, check_centres, check_degC
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.markers.target import Target
from thermostand.recording.reading.interpolation import interpolated

_SPACING_mm = 1.0
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
    """F frames of N markers of one camera.

    centres_px (F, N, 2): (x, y), NaN where a marker is missing. camera_degC (F,): the camera's own, NaN: the frame is
    not used. time_ns (F,): middle of the exposure, ascending; else a frame a second. chamber_degC (F,): the set-point,
    whose frames are left out together to choose a model; else camera_degC in whole degrees. role (F,): of
    experiments.steps.Role; else `reference` at the set-point nearest to reference_degC (else that of the first frame)
    and `fit` at the others. air: (time_ns, degC), both (A,), near the camera, for the thermal form; with it
    supply: (time_ns, 0 or 1), when the camera was off and on, else it was on all the time; camera: (time_ns, degC), its
    own readings between the frames, else it is taken to go straight from one to the next. sigma_px: standard
    uncertainty of a coordinate, where there is no covariance_px2 (F, N, 2, 2). image_size: (width, height), else what
    holds the centres. ValueError when shapes do not agree, or something cannot be what it is given as.
    """
    centres, own = _seen(centres_px, camera_degC)
    if air is None and (supply is not None or camera is not None):
        raise ValueError("supply and camera say more of a camera's past only together with air")
    frames, count = centres.shape[:2]
    instants, chamber, roles = _columns(own, time_ns, chamber_degC, role, reference_degC)
    missing, size = np.isnan(centres).any(axis=2) | np.isnan(own)[:, None], image_size or _size_of(centres)
    check_centres("centres_px", centres, size)
    covariance = _covariance(covariance_px2, sigma_px, missing)
    history = None if air is None else history_of(air, supply, camera, instants, own)
    return Observations(
        target=target or _unnamed(count),
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
        air_degC=_air_at(history, instants),
        centres_px=np.where(missing[..., None], np.nan, centres),
        covariance_px2=np.where(missing[..., None, None], np.nan, covariance),
        flags=np.zeros((frames, count), np.uint8),
        reasons=tuple(map(_reason, own.tolist(), np.all(missing, axis=1).tolist())),
        histories=() if history is None else (history,),
    )


def _covariance(covariance_px2: ArrayLike | None, sigma_px: float, missing: NDArray[np.bool_]) -> Float:
    """What is given, else that of coordinates with this uncertainty each, for all of (F, N, 2, 2); ValueError when it
    is no covariance of a centre that is there."""
    if covariance_px2 is None:
        if not sigma_px > 0:
            raise ValueError(f"sigma_px is {sigma_px}; expected one above 0")
        return np.eye(2) * sigma_px**2
    given, shape = _numbers("covariance_px2", covariance_px2), (*missing.shape, 2, 2)
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


def _numbers(what: str, given: ArrayLike) -> Float:
    """As an array; ValueError that says which argument holds no numbers, or rows of different lengths."""
    try:
        return np.array(given, np.float64)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{what}: expected numbers, as many in each row ({error})") from error


def _seen(centres_px: ArrayLike, camera_degC: ArrayLike) -> tuple[Float, Float]:
    """Centres (F, N, 2) and temperatures (F,); ValueError when they are not."""
    centres, camera = _numbers("centres_px", centres_px), _numbers("camera_degC", camera_degC)
    if centres.ndim != 3 or centres.shape[2] != 2 or camera.shape != centres.shape[:1] or not len(camera):
        raise ValueError(f"centres are (F, N, 2) and temperatures (F,), not {centres.shape} and {camera.shape}")
    if not np.isfinite(centres).all(axis=2).any():
        raise ValueError(f"none of the {len(centres)} frames has a centre: centres_px are all NaN")
    check_degC("camera_degC", camera)
    return centres, camera


def _columns(
    camera_degC: Float,
    time_ns: ArrayLike | None,
    chamber_degC: ArrayLike | None,
    role: ArrayLike | None,
    reference_degC: float | None,
) -> tuple[NDArray[np.int64], Float, NDArray[np.str_]]:
    """Instants, set-points and roles (F,) of the frames, as given or as supposed; ValueError when one is not (F,)."""
    frames = len(camera_degC)
    if chamber_degC is not None:
        check_degC("chamber_degC", _numbers("chamber_degC", chamber_degC))
    instants = np.arange(frames) * NS_PER_S if time_ns is None else np.array(time_ns, np.int64)
    chamber = np.round(camera_degC) if chamber_degC is None else np.array(chamber_degC, np.float64)
    roles = _roles(chamber, reference_degC) if role is None else np.array(role, np.str_)
    for what, column in (("time_ns", instants), ("chamber_degC", chamber), ("role", roles)):
        if column.shape != (frames,):
            raise ValueError(f"{what} has shape {column.shape}, not ({frames},)")
    if (falls := np.flatnonzero(np.diff(instants) <= 0)).size:
        raise ValueError(f"time_ns does not grow at frame {falls[0] + 1}; give the frames in order of time")
    known = [str(each) for each in Role]
    if unknown := sorted(set(roles.tolist()) - set(known)):
        raise ValueError(f"role has {unknown[0]!r}; there are {', '.join(known)}")
    return instants, chamber, roles


def _size_of(centres_px: Float) -> tuple[int, int]:
    """(width, height) of an image that holds all centres (F, N, 2), of at most the size of a sensor."""
    width, height = np.clip(np.ceil(np.nanmax(centres_px, axis=(0, 1))) + 1, 1, LARGEST_SIDE_px)
    return int(width), int(height)


def _air_at(history: History | None, time_ns: NDArray[np.int64]) -> Float:
    """The air's temperature at these instants, NaN where it is not known."""
    if history is None:
        return np.full(len(time_ns), np.nan)
    return interpolated(history.ambient_ns, history.ambient_degC, time_ns)


def _reason(camera_degC: float, unseen: bool) -> str:
    if math.isnan(camera_degC):
        return "the camera's temperature is unknown"
    return "no marker has a centre" if unseen else ""


def _roles(chamber_degC: Float, reference_degC: float | None) -> NDArray[np.str_]:
    """`reference` at the set-point nearest to the wanted one, `fit` at the others."""
    known = np.unique(chamber_degC[np.isfinite(chamber_degC)])
    wanted = chamber_degC[0] if reference_degC is None else reference_degC
    nearest = known[np.argmin(np.abs(known - wanted))] if len(known) else math.nan
    return np.where(chamber_degC == nearest, str(Role.REFERENCE), str(Role.FIT))


def _unnamed(count: int) -> Target:
    """N markers in no known order: models are of the image, and do not ask where the markers are on the target."""
    return Target.model_construct(
        name="", columns=count, rows=1, pitch_mm=_SPACING_mm, diameter_mm=_SPACING_mm / 3, minimum_markers=None
    )
