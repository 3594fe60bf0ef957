"""`compensate calibrate`: from a calibration session to the camera file, its exports and its report."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from thermostand.compensation.calibration.calibrate import CameraCalibration, Model, calibrate
from thermostand.compensation.calibration.camera_file import CameraFile, build_camera_file
from thermostand.compensation.calibration.exports import EXPORTS, refit_radtan, write_exports
from thermostand.compensation.calibration.pinhole import NAMES
from thermostand.compensation.calibration.session_centres import observe_positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.camera_selection import read_serial
from thermostand.compensation.commands.options import (
    CameraName,
    Incomplete,
    TargetOption,
    load_optional_target,
    open_session,
    report_marker_search,
)
from thermostand.compensation.observations import read_session_target
from thermostand.compensation.reporting.pages import render_calibration_page
from thermostand.foundation.command_app import App
from thermostand.foundation.files import check_folder_writable, check_writable, write_atomically
from thermostand.foundation.output import show
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session

app = App()

_TABLE = TableSigma()


@app.command("calibrate")
def calibrate_session(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of a recorded calibration.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The camera file (JSON) to write.")],
    *,
    export: Annotated[
        Path | None, typer.Option(help="A folder, new or not, for the OpenCV, ROS, Kalibr and mrcal files.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="A page (HTML) with residuals and uncertainty.")] = None,
    target: TargetOption = None,
    model: Annotated[
        Model, typer.Option(help="The pinhole; auto takes what does better at held-out positions.")
    ] = Model.AUTO,
    linear_um: Annotated[float, typer.Option(min=0.001, help="Standard uncertainty of a linear position.")] = (
        1e3 * _TABLE.linear_mm
    ),
    rotary_arcmin: Annotated[float, typer.Option(min=0.0001, help="Standard uncertainty of a rotary position.")] = (
        _TABLE.rotary_arcmin
    ),
    straightness_um: Annotated[
        float, typer.Option(min=0, help="Standard uncertainty across the table's axis; 0 if it is straight.")
    ] = 0.0,
    wobble_arcmin: Annotated[
        float, typer.Option(min=0, help="Standard uncertainty of the table's tilt; 0 if it has none.")
    ] = 0.0,
    keep_rays: Annotated[
        bool, typer.Option("--keep-rays", help="Write the ray model, too, when it does not describe the lens.")
    ] = False,
    camera: CameraName = None,
    incomplete: Incomplete = False,
) -> None:
    """Calibrate the camera: pinhole and ray model, with board and table adjusted within their uncertainties.

    Example: compensate calibrate sessions/20260101T180000Z-calibration -o camera.json --export exports
    """
    for path in (out, report):
        if path is not None:
            check_writable(path)
    if export is not None:
        check_folder_writable(export, EXPORTS)
    opened = open_session(session, camera, incomplete)
    used = load_optional_target(target) or read_session_target(opened)
    sigma = TableSigma(linear_um / 1e3, rotary_arcmin, straightness_um / 1e3, wobble_arcmin)
    with report_marker_search(opened.frame_count) as shown:
        positions = observe_positions(opened, used, shown)
    found = calibrate(positions, used, sigma, model)
    file = _build_file(opened, used.name, found, keep_rays=keep_rays)
    lines = [format_summary(file, used)]
    page = None if report is None else render_calibration_page(file, found)
    if report is not None and page is not None:
        write_atomically(report, page)
    if export is not None:
        write_exports(export, file.lens, file.camera_serial or "camera", file.fit.rms_px)
    file.save(out)
    show(file.model_dump(mode="json"), lines)


def format_summary(file: CameraFile, target: Target) -> str:
    """The calibration in a few lines."""
    sigma = [file.covariance[index][index] ** 0.5 for index in range(len(file.vector))]
    lines = [f"{file.model}: {file.fit.markers} markers at {len(file.table.linear_mm)} positions"]
    lines += [
        f"  {name} {value:12.6g} +- {uncertainty:.2g}"
        for name, value, uncertainty in zip(NAMES, file.vector, sigma, strict=False)
    ]
    fit = file.fit
    lines += [
        f"residual {1e3 * fit.rms_px:z.2f} mpx per coordinate, {fit.ratio:z.3f} x the detection sigma "
        f"({1e3 * fit.detection_sigma_px:z.2f} mpx); discrepancy {1e3 * fit.discrepancy_px:z.2f} mpx; "
        f"{fit.outliers} outliers",
    ]
    if file.scores:
        scores = ", ".join(f"{score.model} {1e3 * score.rms_px:z.2f}" for score in file.scores)
        lines.append(f"held-out positions, mpx per coordinate: {scores}")
    if (apart_px := file.uncertainty.halves_rms_px) is not None:
        lines.append(f"the halves differ by {1e3 * apart_px:z.2f} mpx RMS at {file.uncertainty.distance_mm:z.0f} mm")
    lines += file.not_known
    lines += _format_projection(file)
    if file.rays_warning:
        lines.append(f"{file.rays_warning}{'' if file.rays else '. It is not written; --keep-rays writes it'}")
    refit = refit_radtan(file.lens)
    lines.append(
        f"Kalibr's model without k3 differs by {1e3 * refit.rms_px:z.2f} mpx RMS, {1e3 * refit.worst_px:z.1f} at most"
    )
    lines.append(target.orientation)
    return "\n".join(lines)


def _format_projection(file: CameraFile) -> list[str]:
    """Say how well the projection is known in each place, and where there was no marker."""
    sigma_px = np.array(file.uncertainty.sigma_px, np.float64)
    if not np.isfinite(sigma_px).any():
        return []
    unseen = "" if not file.uncertainty.not_seen else f"; {100 * np.isnan(sigma_px).mean():.0f} % of the picture: "
    return [
        f"the projection is known to {1e3 * np.nanmin(sigma_px):z.2f} to {1e3 * np.nanmax(sigma_px):z.2f} mpx "
        f"(standard uncertainty) at {file.uncertainty.distance_mm:z.0f} mm{unseen}{file.uncertainty.not_seen}"
    ]


def _build_file(session: Session, target_name: str, found: CameraCalibration, *, keep_rays: bool) -> CameraFile:
    return build_camera_file(
        found,
        camera_serial=read_serial(session),
        session_ids=(session.metadata.get("session_id", ""),),
        target_name=target_name,
        software_version=importlib.metadata.version("thermostand"),
        keep_rays=keep_rays,
    )
