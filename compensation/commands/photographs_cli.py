"""`compensate calibrate-photographs` and `calibrate-rig`: cameras from pictures of a board held in any poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermostand.compensation.calibration.board import Board, make_board, make_corner_board
from thermostand.compensation.calibration.calibrate import try_check
from thermostand.compensation.calibration.exports import EXPORTS, write_exports
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import NAMES
from thermostand.compensation.calibration.rig import RigCalibration, calibrate_rig
from thermostand.compensation.calibration.session_centres import Views
from thermostand.compensation.calibration.views import (
    LEAST_MARKERS,
    PointUncertainty,
    ViewCalibration,
    calibrate_views,
    compute_point_uncertainty,
    cross_validate_px,
)
from thermostand.compensation.commands.options import (
    MegapixelsOption,
    load_board,
    report_marker_search,
    say_left_out,
)
from thermostand.compensation.pictures import measure_points
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import CalibrationError, ConfigError
from thermostand.foundation.files import check_folder_writable, make_folder, write_atomically
from thermostand.foundation.image_limit import GREATEST_MEGAPIXELS, allow_images_up_to
from thermostand.foundation.output import show
from thermostand.foundation.progress import Report
from thermostand.markers.corner_board import BoardOfCorners
from thermostand.markers.detection import DetectionError
from thermostand.markers.image_file import read_image
from thermostand.markers.target import Target

app = App()

RIG = "rig.json"


@app.command("calibrate-rig")
def calibrate_rig_command(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER...", help="A folder of pictures for each camera, the first one first."),
    ],
    target: Annotated[str, typer.Option("--target", help="A target file or an installed name, as for photographs.")],
    export: Annotated[
        Path, typer.Option(help="A folder, new or not: rig.json, and a folder of files for each camera.")
    ],
    max_megapixels: MegapixelsOption = GREATEST_MEGAPIXELS,
) -> None:
    """Calibrate cameras that are fixed to each other: lenses, and each camera's pose against the first one.

    Pictures of one moment have the same name in all folders; a camera that does not see the target may lack some. Hold
    the target still for each moment, tilted by 20 to 40 deg to all sides, at least three times where a camera and the
    first one both see it. A point X of the first camera's frame is at R X + t in another one's (rig.json, mm).

    Example: compensate calibrate-rig left right --target my-target.yaml --export rig
    """
    with allow_images_up_to(max_megapixels):
        if len(folders) < 2 or len({folder.name for folder in folders}) < len(folders):
            raise ConfigError("a rig has two or more cameras, each with a folder of another name")
        check_folder_writable(export, [RIG])
        for folder in folders:
            check_folder_writable(export / folder.name, EXPORTS)
        board = load_board(target)
        names = _list_picture_names(folders)
        failures: list[str] = []
        suspect: list[str] = []
        with report_marker_search(len(folders) * len(names)) as report:
            seen = [
                collect_views(
                    _list_pictures(folder, names),
                    board,
                    failures,
                    suspect,
                    _offset_progress(report, number * len(names)),
                )
                for number, folder in enumerate(folders)
            ]
        say_left_out("not used:", failures, suspect)
        useful = np.any([views.seen.any(axis=1) for views in seen], axis=0)
        found = calibrate_rig([views.select(useful) for views in seen], make_prior_board(board))
        lines = [
            f"{np.count_nonzero(useful)} moments, {len(folders)} cameras",
            *_format_cameras(found, folders),
            board.orientation,
        ]
        data = _write_calibration(found, folders, export)
        show({"cameras": data, "not_used": failures, "suspect": suspect, "exports": export}, lines)


def _list_picture_names(folders: list[Path]) -> list[str]:
    """The names of the pictures, those of all folders together."""
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder}: not a folder")
    names = sorted({path.name for folder in folders for path in folder.iterdir() if path.is_file()})
    if not names:
        raise ConfigError(f"{folders[0]}: there are no pictures")
    return names


def _offset_progress(report: Report, before: int) -> Report:
    def later(done: float, text: str) -> None:
        report(before + done, text)

    return later


def _list_pictures(folder: Path, names: list[str]) -> list[tuple[Path | None, str]]:
    """List the picture of each moment with its name; None where the folder has none."""
    return [(folder / name if (folder / name).exists() else None, f"{folder.name}/{name}") for name in names]


def _write_calibration(found: RigCalibration, folders: list[Path], export: Path) -> list[dict[str, object]]:
    """Write rig.json and each camera's files; what rig.json says."""
    data = _describe_cameras(found, folders)
    make_folder(export)
    for number, folder in enumerate(folders):
        write_exports(export / folder.name, found.scene.lenses[number], folder.name, found.rms_px(number))
    write_atomically(export / RIG, json.dumps(data, indent=1) + "\n")
    return data


def _describe_cameras(found: RigCalibration, folders: list[Path]) -> list[dict[str, object]]:
    """The cameras as rig.json has them."""
    rows: list[dict[str, object]] = []
    for number, folder in enumerate(folders):
        lens = found.scene.lenses[number]
        row: dict[str, object] = {
            "name": folder.name,
            "image_size": list(lens.image_size),
            "lens": dict(zip(NAMES, lens.vector.tolist(), strict=False)),
            "lens_sigma": dict(zip(NAMES, found.compute_lens_sigma(number).tolist(), strict=False)),
            "rotation": found.scene.rotations[number].tolist(),
            "translation_mm": found.scene.translations_mm[number].tolist(),
            "rms_px": found.rms_px(number),
            "discrepancy_px": float(found.discrepancies_px[number]),
        }
        if number > 0:
            turn_deg, shift_mm = found.compute_pose_sigma(number)
            row |= {"rotation_sigma_deg": turn_deg.tolist(), "translation_sigma_mm": shift_mm.tolist()}
        rows.append(row)
    return rows


def _format_cameras(found: RigCalibration, folders: list[Path]) -> list[str]:
    lines: list[str] = []
    for number, folder in enumerate(folders):
        lens = found.scene.lenses[number]
        line = (
            f"{folder.name}: fx {lens.vector[0]:.2f} +- {found.compute_lens_sigma(number)[0]:.2g} px, residual "
            f"{1e3 * found.rms_px(number):.1f} mpx per coordinate, discrepancy "
            f"{1e3 * found.discrepancies_px[number]:.1f} mpx"
        )
        if number > 0:
            length, sigma = found.compute_baseline_mm(number)
            turn_deg = float(np.degrees(np.arccos(np.clip((np.trace(found.scene.rotations[number]) - 1) / 2, -1, 1))))
            line += (
                f"; {length:.3f} mm +- {2 * sigma:.2g} (k = 2) from {folders[0].name}, turned by {turn_deg:.3f} deg +- "
                f"{2 * found.compute_pose_sigma(number)[0].max():.2g} (k = 2)"
            )
        lines.append(line)
    return lines


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
    max_megapixels: MegapixelsOption = GREATEST_MEGAPIXELS,
) -> None:
    """Calibrate a camera from photographs of the target in any poses: Brown's pinhole, with the board adjusted.

    Tilt the target by 20 to 40 deg to all sides, at several distances, and let it reach the picture's corners. The
    focus and the aperture must stay as they are. printing_error_mm and flatness_mm of the target file say how far its
    markers may be from where they should be: a sheet of paper needs tenths of a mm. What is measured are the centres of
    the outlines; the difference to the discs' own centres is computed from the camera.

    Example: compensate calibrate-photographs photos/*.jpg --target my-target.yaml --export exports
    """
    with allow_images_up_to(max_megapixels):
        for path in images:
            if not path.is_file():
                raise ConfigError(
                    f"{path}: {'is a folder; give the pictures in it' if path.exists() else 'no such file'}"
                )
        check_folder_writable(export, EXPORTS)
        board = load_board(target)
        failures: list[str] = []
        suspect: list[str] = []
        with report_marker_search(len(images)) as report:
            seen = collect_views([(path, path.name) for path in images], board, failures, suspect, report)
        say_left_out("not used:", failures, suspect)
        views, given = seen.select(np.asarray(seen.seen.any(axis=1))), make_prior_board(board)
        found = calibrate_views(views, given)
        at_mm = distance_mm or float(np.mean(found.scene.translations_mm[:, 2]))
        held_out_px, unknown = try_check(lambda: cross_validate_px(views, given))
        projection = compute_point_uncertainty(found, at_mm)
        lines = [format_summary(found, views, held_out_px, projection, board)]
        if unknown:
            lines.append(f"how well pictures that were held out are met is not known: {unknown}")
        lens = dict(zip(NAMES, found.scene.lens.vector, strict=False))
        data = {"lens": lens, "lens_sigma": found.lens_sigma, "rms_px": found.rms_px, "projection": projection}
        checked = {"held_out_px": held_out_px, "held_out_not_known": unknown}
        more = {"discrepancy_px": found.discrepancy_px, "not_used": failures, "suspect": suspect, "exports": export}
        write_exports(export, found.scene.lens, "camera", found.rms_px)
        show({**data, **checked, **more}, lines)


def format_summary(
    found: ViewCalibration,
    views: Views,
    held_out_px: float | None,
    projection: PointUncertainty,
    target: Target | BoardOfCorners,
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
        *([] if held_out_px is None else [f"pictures that were held out: {1e3 * held_out_px:.1f} mpx per coordinate"]),
        projection.text,
        f"the markers are {1e3 * float(np.sqrt(np.mean(moved**2))):.0f} um off their places in the plane (allowed: "
        f"{1e3 * float(found.board.sigma_mm[:, 0].mean()):.0f}), {1e3 * found.warp_mm:.0f} um off a plane (allowed: "
        f"{1e3 * target.flatness_mm:.0f})",
        target.orientation,
    ]
    return "\n".join(lines)


def make_prior_board(board: Target | BoardOfCorners) -> Board:
    """Return what is known of it before a calibration."""
    return make_board(board) if isinstance(board, Target) else make_corner_board(board)


def collect_views(
    pictures: Sequence[tuple[Path | None, str]],
    board: Target | BoardOfCorners,
    failures: list[str],
    suspect: list[str],
    report: Report,
) -> Views:
    """Return what a camera sees in each of its pictures, NaN where there is none or it does not show enough; `failures`
    grows by a line for each that is not used, `suspect` by the names of those that noise does not describe.

    CalibrationError when the target is in none, or they are of different sizes.
    """
    centres: Float = np.full((len(pictures), board.count, 2), np.nan)
    covariances: Float = np.full((len(pictures), board.count, 2, 2), np.nan)
    size: tuple[int, int] | None = None
    for number, (path, name) in enumerate(pictures):
        report(number, name)
        if path is None:
            continue
        try:
            pixels = read_image(path)
            found, covariance, is_suspect, _ = measure_points(pixels, board)
        except DetectionError as error:
            failures.append(f"{name}: {str(error).removeprefix(f'{path}: ')}")
            continue
        shape = (pixels.shape[1], pixels.shape[0])
        if size not in (None, shape):
            raise CalibrationError(f"{path}: the picture has {shape[0]} x {shape[1]} pixels, those before it {size}")
        size = shape
        count = np.count_nonzero(np.isfinite(found[:, 0]))
        if count < LEAST_MARKERS:
            failures.append(f"{name}: {count} markers, {LEAST_MARKERS} are needed")
            continue
        suspect += [name] * is_suspect
        centres[number], covariances[number] = found, covariance
    if size is None:
        raise CalibrationError(
            f"the target is in none of the pictures: {failures[0] if failures else 'there are none'}"
        )
    return Views(centres, covariances, size)
