"""`compensate calibrate-photographs`: a camera from pictures of a board held in any poses, without stages."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from compensation.calibration.board import board_of, board_of_corners
from compensation.calibration.exports import EXPORTS, write_exports
from compensation.calibration.least_squares import Float
from compensation.calibration.pinhole import NAMES
from compensation.calibration.view_uncertainty import in_words
from compensation.calibration.views import LEAST_MARKERS, ViewCalibration, Views, calibrate_views, cross_validated_px
from compensation.commands.options import installed_target
from foundation.command_app import App
from foundation.errors import CalibrationError
from foundation.exit_codes import one_line_errors
from foundation.files import check_folder_writable
from foundation.image_limit import GREATEST_MEGAPIXELS, images_up_to
from foundation.output import say, show
from foundation.progress import Report, progress
from markers.corner_board import BoardOfCorners, SIGMA_px, find_corners, load_corner_board
from markers.detection import DetectionError, Image, detect
from markers.detections_table import doubt
from markers.image_file import read_image
from markers.target import Target

app = App()


@app.command("calibrate-photographs")
def calibrate_photographs(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Pictures of the target, of one camera.")],
    target: Annotated[
        str,
        typer.Option(
            "--target", help="A target file or an installed name; a board of squares or tags is a file with its `kind`."
        ),
    ],
    export: Annotated[Path, typer.Option(help="A folder, new or not, for the OpenCV, ROS, Kalibr and mrcal files.")],
    distance_mm: Annotated[
        float | None, typer.Option(min=1, help="Where the uncertainty is stated; else the pictures' mean distance.")
    ] = None,
    max_megapixels: Annotated[
        float, typer.Option("--max-megapixels", min=0.001, max=2000.0, help="Larger images are refused, unread.")
    ] = GREATEST_MEGAPIXELS,
) -> None:
    """Calibrate a camera from photographs of the target in any poses: Brown's pinhole, with the board adjusted.

    Tilt the target by 20 to 40 deg to all sides, at several distances, and let it reach the picture's corners. The
    focus and the aperture must stay as they are. printing_error_mm and flatness_mm of the target file say how far its
    markers may be from where they should be: a sheet of paper needs tenths of a mm. What is measured are the centres of
    the outlines; the difference to the discs' own centres is computed from the camera.

    Example: compensate calibrate-photographs photos/*.jpg --target my-target.yaml --export exports
    """
    with one_line_errors(), images_up_to(max_megapixels):
        check_folder_writable(export, EXPORTS)
        board = described(target)
        failures: list[str] = []
        doubtful: list[str] = []
        with progress("find markers", len(images)) as report:
            views = _views(images, board, failures, doubtful, report)
        for failure in failures:
            say(f"not used: {failure}")
        if doubtful:
            say(doubt(len(doubtful)))
        known = board_of(board) if isinstance(board, Target) else board_of_corners(board)
        found = calibrate_views(views, known)
        write_exports(export, found.scene.lens, "camera", found.rms_px)
        at_mm = distance_mm or float(np.mean(found.scene.translations_mm[:, 2]))
        held_out_px = cross_validated_px(views, known)
        lens = dict(zip(NAMES, found.scene.lens.vector, strict=False))
        data = {"lens": lens, "lens_sigma": found.lens_sigma, "rms_px": found.rms_px, "held_out_px": held_out_px}
        more = {"discrepancy_px": found.discrepancy_px, "not_used": failures, "doubtful": doubtful, "exports": export}
        show({**data, **more}, [summary(found, views, held_out_px, at_mm, board)])


def summary(
    found: ViewCalibration, views: Views, held_out_px: float, distance_mm: float, target: Target | BoardOfCorners
) -> str:
    """The calibration in a few lines."""
    lens = found.scene.lens
    lines = [
        f"pinhole, Brown: {np.isfinite(found.residuals_px[:, :, 0]).sum()} markers in {len(views.centres_px)} pictures"
    ]
    lines += [
        f"  {name} {value:12.6g} +- {sigma:.2g}"
        for name, value, sigma in zip(NAMES, lens.vector, found.lens_sigma, strict=False)
    ]
    sigma_px = float(np.sqrt(np.nanmean(np.diagonal(views.covariance_px2, axis1=2, axis2=3))))
    moved = (found.scene.points_mm - found.board.points_mm)[:, :2]
    lines += [
        f"residual {1e3 * found.rms_px:.1f} mpx per coordinate, detection sigma {1e3 * sigma_px:.1f} mpx, discrepancy "
        f"{1e3 * found.discrepancy_px:.1f} mpx",
        f"pictures that were held out: {1e3 * held_out_px:.1f} mpx per coordinate",
        in_words(found, distance_mm),
        f"the markers are {1e3 * float(np.sqrt(np.mean(moved**2))):.0f} um off their places in the plane (allowed: "
        f"{1e3 * float(found.board.sigma_mm[:, 0].mean()):.0f}), {1e3 * found.warp_mm:.0f} um off a plane (allowed: "
        f"{1e3 * target.flatness_mm:.0f})",
        target.orientation,
    ]
    return "\n".join(lines)


def described(name: str) -> Target | BoardOfCorners:
    """A board of squares or tags when the file says so, else a target of dots."""
    corners = load_corner_board(Path(name)) if Path(name).is_file() else None
    return corners or installed_target(name)


def look(image: Image, target: Target | BoardOfCorners) -> tuple[Float, Float, bool]:
    """Points (N, 2) px and their covariances (N, 2, 2) in a picture, and whether these are doubtful; DetectionError
    when the target is not in it."""
    if isinstance(target, Target):
        found = detect(image, target)
        return found.centres_px, found.covariance_px2, found.is_doubtful
    return find_corners(image, target), np.tile(SIGMA_px**2 * np.eye(2), (target.count, 1, 1)), False


def _views(
    images: list[Path], target: Target | BoardOfCorners, failures: list[str], doubtful: list[str], report: Report
) -> Views:
    """The pictures that show enough of the target; `failures` grows by a line for each other one, `doubtful` by the
    names of those that noise does not describe."""
    found: list[tuple[Float, Float]] = []
    size: tuple[int, int] | None = None
    for number, path in enumerate(images, 1):
        try:
            pixels = read_image(path)
            *points, is_doubtful = look(pixels, target)
        except DetectionError as error:
            failures.append(f"{path.name}: {error}")
            continue
        finally:
            report(number, path.name)
        shape = (pixels.shape[1], pixels.shape[0])
        if size not in (None, shape):
            raise CalibrationError(f"{path}: the picture has {shape[0]} x {shape[1]} pixels, those before it {size}")
        size = shape
        count = np.count_nonzero(np.isfinite(points[0][:, 0]))
        if count < LEAST_MARKERS:
            failures.append(f"{path.name}: {count} markers, {LEAST_MARKERS} are needed")
            continue
        if is_doubtful:
            doubtful.append(path.name)
        found.append((points[0], points[1]))
    if size is None:
        raise CalibrationError(failures[0] if failures else "there are no pictures")
    centres = np.array([centres for centres, _ in found]).reshape(-1, target.count, 2)
    covariances = np.array([covariance for _, covariance in found]).reshape(-1, target.count, 2, 2)
    return Views(centres, covariances, size)
