"""Observations from a CSV table of centres and temperatures, measured by any program."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.arrays import observations_of
from thermostand.compensation.csv_rows import Row, numbers, read_rows
from thermostand.compensation.observations import Float, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

NEEDED = ("frame", "marker", "x_px", "y_px", "camera_degC")
OF_FRAMES = ("camera_degC", "time_ns", "chamber_degC", "role", "air_degC")
_COVARIANCE = ("var_x_px2", "cov_xy_px2", "var_y_px2")
_ROW_EACH = f"it needs {', '.join(NEEDED)}, a row for each centre"
_MOST_FRAMES, _MOST_MARKERS = 1_000_000, 100_000
Index = NDArray[np.int64]


def observations_of_table(path: Path, camera_serial: str = "") -> Observations:
    """A row for each centre: frame and marker (whole numbers from 0 on, in any order), x_px, y_px and camera_degC; and,
    where they are known, time_ns, chamber_degC (the set-point), role, air_degC (of the air near the camera, for the
    thermal form), var_x_px2, cov_xy_px2 and var_y_px2.

    A marker without a row, or with an empty place, is missing. SessionError that names file, line and column.
    """
    rows = _rows(path)
    frame, frame_at = _numbered(path, rows, "frame", _MOST_FRAMES)
    marker, marker_at = _numbered(path, rows, "marker", _MOST_MARKERS)
    pairs, first = np.unique(np.column_stack([frame_at, marker_at]), axis=0, return_index=True)
    if len(pairs) < len(rows):
        line = int(np.setdiff1d(np.arange(len(rows)), first)[0])
        raise SessionError(f"{path}: line {line + 2}: frame {rows[line]['frame']} has this marker already")
    shape = (len(frame), int(marker.max()) + 1)
    centres, covariance = np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
    at = frame_at, marker[marker_at]
    centres[at] = np.column_stack([numbers(path, rows, "x_px"), numbers(path, rows, "y_px")])
    of_frames = {name: _of_frames(path, rows, frame_at, name) for name in OF_FRAMES if name in rows[0]}
    times = of_frames.get("time_ns")
    time_ns = None if times is None else np.array([_instant(path, text) for text in times], np.int64)
    if time_ns is not None and (np.diff(time_ns) <= 0).any():
        raise SessionError(f"{path}: time_ns does not grow from frame to frame; number the frames in order of time")
    air = _temperatures(path, of_frames, "air_degC")
    if air is not None and time_ns is None:
        raise SessionError(f"{path}: has air_degC without time_ns; the thermal form needs both")
    camera_degC = _temperatures(path, of_frames, "camera_degC")
    if _COVARIANCE[0] in rows[0]:
        covariance[at] = _covariances(path, rows)
    try:
        return observations_of(
            centres,
            np.empty(0) if camera_degC is None else camera_degC,
            time_ns,
            chamber_degC=_temperatures(path, of_frames, "chamber_degC"),
            role=_roles(path, of_frames.get("role")),
            air=None if air is None or time_ns is None else (time_ns, air),
            covariance_px2=covariance if _COVARIANCE[0] in rows[0] else None,
            camera_serial=camera_serial,
            name=path.stem,
        )
    except ValueError as error:
        raise SessionError(f"{path}: {error}") from error


def _rows(path: Path) -> list[dict[str, str]]:
    rows, columns = read_rows(path, NEEDED, _ROW_EACH)
    missing = [name for name in _COVARIANCE if name not in columns]
    if missing and len(missing) < len(_COVARIANCE):
        raise SessionError(f"{path}: has no column {missing[0]}; {_ROW_EACH}")
    if not rows:
        raise SessionError(f"{path}: has no rows; it needs one for each centre")
    return rows


def _numbered(path: Path, rows: Sequence[Row], column: str, most: int) -> tuple[Index, Index]:
    """The numbers that occur, ascending, and each row's index among them."""
    for line, row in enumerate(rows, 2):
        text = row[column].strip()
        if not text.isdecimal() or int(text) >= most:
            raise SessionError(f"{path}: line {line}: {column} is {text!r}, not a whole number from 0 on below {most}")
    found, at = np.unique(np.array([int(row[column]) for row in rows], np.int64), return_inverse=True)
    return found, at.ravel().astype(np.int64)


def _covariances(path: Path, rows: Sequence[Row]) -> Float:
    """(M, 2, 2); SessionError where it is none."""
    xx, xy, yy = (numbers(path, rows, name) for name in _COVARIANCE)
    placed = np.array([bool(row["x_px"].strip()) for row in rows])
    wrong = placed & ~((xx > 0) & (yy > 0) & (xx * yy > xy**2))
    if wrong.any():
        line = int(np.flatnonzero(wrong)[0]) + 2
        raise SessionError(f"{path}: line {line}: {', '.join(_COVARIANCE)} are no covariance of a centre")
    return np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)


def _of_frames(path: Path, rows: Sequence[Row], frame_at: Index, column: str) -> list[str]:
    """The text of each frame, which is the same in all of its rows."""
    found: dict[int, str] = {}
    for line, (index, row) in enumerate(zip(frame_at.tolist(), rows, strict=True), 2):
        if found.setdefault(index, row[column].strip()) != row[column].strip():
            raise SessionError(
                f"{path}: line {line}: {column} of frame {row['frame']} is another one in an earlier line"
            )
    return [found[index] for index in range(len(found))]


def _temperatures(path: Path, of_frames: Mapping[str, list[str]], column: str) -> Float | None:
    texts = of_frames.get(column)
    if texts is None:
        return None
    try:
        return np.array([float(text) if text else math.nan for text in texts])
    except ValueError as error:
        raise SessionError(f"{path}: {column}: {error}") from None


def _instant(path: Path, text: str) -> int:
    if not text.isdecimal():
        raise SessionError(f"{path}: time_ns is {text!r}, not a whole number of nanoseconds")
    return int(text)


def _roles(path: Path, texts: list[str] | None) -> list[str] | None:
    known = [str(role) for role in Role]
    for text in texts or []:
        if text not in known:
            raise SessionError(f"{path}: role is {text!r}, not one of {', '.join(known)}")
    return texts
