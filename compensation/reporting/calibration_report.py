"""The page of a calibration: one HTML file that needs nothing else."""

from __future__ import annotations

from thermostand.compensation.calibration.calibrate import Calibration
from thermostand.compensation.calibration.camera_file import CameraFile
from thermostand.compensation.reporting.drawing import calibration_figures as figures
from thermostand.compensation.reporting.page import Drawing, Facts, Heading, Paragraph, Table, page

_FIGURES = (
    (
        figures.residual_vectors,
        "residuals",
        "Residuals of all markers, enlarged as the scale bar shows; they should have no pattern.",
    ),
    (figures.residual_sizes, "sizes", "RMS residual of each table position and of each marker."),
    (
        figures.normalised_histogram,
        "histogram",
        "Residuals in units of the detection sigma; the line is what noise alone gives.",
    ),
    (
        figures.uncertainty_map,
        "uncertainty",
        "Standard uncertainty of the projection at the mean distance, and how far the calibrations of the two halves "
        "of the positions differ there. White dots are the markers; where it is hatched, none was near, and nothing is "
        "known.",
    ),
    (figures.model_scores, "scores", "Models at positions they were not fitted to; bars are standard errors."),
    (figures.rays_against_pinhole, "rays", "Where the ray model sees what the pinhole sees, at the mean distance."),
    (
        figures.corrections,
        "corrections",
        "How the adjustment changed the board's coordinates and the table's positions.",
    ),
)


def report_page(file: CameraFile, calibration: Calibration) -> str:
    """The report as HTML text; the same data give the same text."""
    shown = [each for each in _FIGURES if calibration.scores or each[0] is not figures.model_scores]
    drawn = [Drawing(draw(calibration), name, caption) for draw, name, caption in shown]
    title = f"Calibration of camera {file.camera_serial}"
    parts = [
        Heading(title, 1),
        Paragraph(f"From {', '.join(file.session_ids)}, target {file.target_name}.", aside=True),
        Heading("Camera"),
        _camera(file),
        _facts(file),
        Heading("Held-out positions"),
        *([_scores(file)] if file.scores else []),
        *map(Paragraph, file.not_known),
        Heading("Figures"),
        *drawn,
    ]
    return page(title, parts)


def _camera(file: CameraFile) -> Table:
    sigma = [file.covariance[index][index] ** 0.5 for index in range(len(file.vector))]
    rows = [
        [name, f"{value:.7g}", f"{uncertainty:.2g}"]
        for name, value, uncertainty in zip(file.names, file.vector, sigma, strict=True)
    ]
    return Table([file.model, "value", "standard uncertainty"], rows)


def _facts(file: CameraFile) -> Facts:
    fit, apart_px = file.fit, file.uncertainty.halves_rms_px
    return Facts(
        [
            ("Residual", f"{1e3 * fit.rms_px:z.2f} mpx per coordinate, {fit.ratio:z.3f} x the detection sigma"),
            ("Detection sigma", f"{1e3 * fit.detection_sigma_px:z.2f} mpx per coordinate, mean of a position's frames"),
            ("Unexplained", f"{1e3 * fit.discrepancy_px:z.2f} mpx per coordinate beyond noise and priors"),
            ("Markers", f"{fit.markers} at {len(file.table.linear_mm)} positions, {fit.outliers} outliers left out"),
            ("Ray model", _rays(file)),
            ("Halves", "not known" if apart_px is None else f"{1e3 * apart_px:z.2f} mpx RMS apart"),
        ]
    )


def _rays(file: CameraFile) -> str:
    if (rays := file.rays) is None:
        return f"not in the camera file; {file.rays_doubt}"
    extent = f"degree {rays.degree}, {rays.range_mm[0]:z.0f} to {rays.range_mm[1]:z.0f} mm"
    return f"{extent}; {file.rays_doubt}" if file.rays_doubt else extent


def _scores(file: CameraFile) -> Table:
    rows = [
        [score.model, f"{1e3 * score.rms_px:z.3f}", f"{1e3 * score.sigma_px:z.3f}", str(score.positions)]
        for score in file.scores
    ]
    chosen = next((index for index, score in enumerate(file.scores) if score.model == file.model), None)
    return Table(["model", "RMS per coordinate (mpx)", "standard error (mpx)", "positions"], rows, chosen)
