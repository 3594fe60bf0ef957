"""The table of `compensate detect`: one CSV row per marker and image, markers without a centre included."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from compensation.files import whole_file
from compensation.markers.detection import Detection, Flag
from compensation.target import Target

COLUMNS = (
    "image", "time_ns", "marker", "row", "column", "x_px", "y_px", "var_x_px2", "cov_xy_px2", "var_y_px2", "flags",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class DetectedImage:
    """One image's markers. image: its file name or frame index. time_ns: None when unknown (an empty cell)."""

    image: str
    time_ns: int | None
    detection: Detection


def write_detections(path: Path, target: Target, images: Iterable[DetectedImage]) -> None:
    """Write the table. Markers count from 1, rows and columns from 0; without a centre the numbers are nan.

    The file appears when it is complete; when writing fails, or `images` raises, an older file stays as it was.
    SessionError when the place cannot be written to.
    """
    with whole_file(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for image in images:
            writer.writerows(_rows(image, target))


def flags_text(flags: int) -> str:
    """`OK`, or the names of the flags joined by `|`."""
    return "|".join(flag.name or "" for flag in Flag(flags)) or "OK"


def _rows(image: DetectedImage, target: Target) -> Iterator[tuple[object, ...]]:
    """The image's rows; 1e-6 px and 7 digits of the variances are far below the noise."""
    found = image.detection
    time_ns = "" if image.time_ns is None else image.time_ns
    for number in range(1, target.count + 1):
        (x, y), covariance = found.centres_px[number - 1], found.covariance_px2[number - 1]
        variances = (f"{value:.6e}" for value in (covariance[0, 0], covariance[0, 1], covariance[1, 1]))
        row, column = target.row_column(number)
        flags = flags_text(int(found.flags[number - 1]))
        yield image.image, time_ns, number, row, column, f"{x:.6f}", f"{y:.6f}", *variances, flags
