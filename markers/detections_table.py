"""The table of `compensate detect`: one CSV row per marker and image, markers without a centre included.

Two centres of each marker, both with covariance: x_px, y_px is the centre of its outline in the image, an ellipse, and
what follows a drift; disc_x_px, disc_y_px is the image of the disc's own centre, which lies elsewhere as soon as the
target is tilted, and belongs to the target's coordinates in space.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from thermostand.foundation.files import open_atomic
from thermostand.markers.detection import Detection, Flag
from thermostand.markers.eccentricity import Float, compute_disc_centres
from thermostand.markers.target import Target

COLUMNS = (
    "image", "time_ns", "marker", "row", "column", "x_px", "y_px", "var_x_px2", "cov_xy_px2", "var_y_px2", "flags",
    "disc_x_px", "disc_y_px", "disc_var_x_px2", "disc_cov_xy_px2", "disc_var_y_px2",
)  # fmt: skip

CENTRES = "x_px, y_px: centres of the outlines in the image; disc_x_px, disc_y_px: images of the discs' own centres"


def format_noise_warning(images: int) -> str:
    """Return the warning about so many images whose detections are suspect."""
    return (
        f"noise alone does not describe {images} image{'s' * (images != 1)} (texture, print, compression, flicker): "
        "the variances of their centres are estimates from how the residuals hang together, perhaps too small by half"
    )


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
    with open_atomic(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for image in images:
            writer.writerows(_iterate_rows(image, target))


def format_flags(flags: int) -> str:
    """`OK`, or the names of the flags joined by `|`."""
    return "|".join(flag.name or "" for flag in Flag(flags)) or "OK"


def _iterate_rows(image: DetectedImage, target: Target) -> Iterator[tuple[object, ...]]:
    """The image's rows."""
    found = image.detection
    discs_px, discs_px2 = compute_disc_centres(found, target)
    time_ns = "" if image.time_ns is None else image.time_ns
    for index in range(target.count):
        row, column = target.row_column(index + 1)
        yield (
            *(image.image, time_ns, index + 1, row, column),
            *_format_cells(found.centres_px[index], found.covariance_px2[index]),
            format_flags(int(found.flags[index])),
            *_format_cells(discs_px[index], discs_px2[index]),
        )


def _format_cells(centre_px: Float, covariance_px2: Float) -> tuple[str, ...]:
    """1e-6 px and 7 digits of the variances are far below the noise."""
    x, y = centre_px
    variances = (covariance_px2[0, 0], covariance_px2[0, 1], covariance_px2[1, 1])
    return (f"{x:.6f}", f"{y:.6f}", *(f"{value:.6e}" for value in variances))
