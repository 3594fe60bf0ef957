"""Points of a CSV table, put where they would have been at the reference temperature."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from thermostand.compensation.csv_rows import Row, read_rows
from thermostand.compensation.drift.drift_model import DriftModel, Outside
from thermostand.compensation.history.states import Float, States
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import whole_file

X, Y, TIME, CAMERA = "x_px", "y_px", "time_ns", "camera_degC"
ADDED = ("x_reference_px", "y_reference_px", "var_x_correction_px2", "cov_xy_correction_px2", "var_y_correction_px2",
         "outside")  # fmt: skip


def read_points(path: Path) -> list[dict[str, str]]:
    """The rows of a table with columns x_px and y_px, such as `compensate detect` writes; SessionError when it has
    none, or a row that does not fit."""
    rows, columns = read_rows(path, (X, Y), f"it needs {X} and {Y}, as compensate detect writes them")
    taken = [name for name in ADDED if name in columns]
    if taken:
        raise SessionError(f"{path}: has a column {taken[0]} already; these points have been corrected")
    return rows


def times(path: Path, rows: Sequence[Row]) -> list[int]:
    """(M,): the instants, ns; ConfigError when a row has none."""
    found: list[int] = []
    for line, row in enumerate(rows, 2):
        text = row.get(TIME, "").strip()
        if not text.isdecimal():
            raise ConfigError(f"{path}: line {line}: {TIME} is {text!r}; --session needs the instant of every point")
        found.append(int(text))
    return found


def write_corrected(path: Path, rows: Sequence[Row], xy_px: Float, model: DriftModel, states: States) -> None:
    """The table with columns added: the corrected place, the covariance of the correction, and why it is an
    extrapolation (names of Outside joined by `|`, empty inside the calibrated range). nan where it is unknown.

    The file appears when it is complete; SessionError when the place refuses.
    """
    corrected, covariance = model.correct(xy_px, states), model.covariance(xy_px, states)
    flags = model.flags(xy_px, states)
    with whole_file(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*(rows[0] if rows else (X, Y)), *ADDED])
        for index, row in enumerate(rows):
            writer.writerow([*row.values(), *_added(corrected[index], covariance[index], int(flags[index]))])


def _added(place_px: Float, covariance_px2: Float, flags: int) -> Iterator[str]:
    yield from (f"{value:.6f}" for value in place_px)
    yield from (f"{value:.6e}" for value in (covariance_px2[0, 0], covariance_px2[0, 1], covariance_px2[1, 1]))
    yield outside_text(flags)


def outside_text(flags: int) -> str:
    """The names of the flags joined by `|`, empty when there is none."""
    return "|".join(flag.name or "" for flag in Outside(flags))
