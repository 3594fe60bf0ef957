"""`compensate validate`: the paper's validation in three dimensions, from a recorded session."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.budget.geometry import load_geometry
from thermostand.compensation.calibration.camera_file import load_camera
from thermostand.compensation.camera_selection import find_camera_name
from thermostand.compensation.commands.options import MarkerSearch
from thermostand.compensation.drift.model_file import load_model
from thermostand.compensation.observations import Float
from thermostand.compensation.reporting.pages import render_validation_page
from thermostand.compensation.validation3d.document import format_summary, serialise_validation
from thermostand.compensation.validation3d.validate import (
    LensModel,
    StandContribution,
    check_same,
    compute_stand_contribution,
    select_lens_model,
    select_validation_frames,
    validate,
)
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import check_writable, write_atomically
from thermostand.foundation.output import say, show
from thermostand.recording.reading.session import Session

app = App()


@app.command("validate")
def validate_session(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of a session of the validation recipe.")],
    camera: Annotated[Path, typer.Option(help="The camera file of `compensate calibrate`.")],
    model: Annotated[Path, typer.Option(help="The drift model of `compensate fit`.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The HTML file to write, with a JSON file next to it.")],
    budget: Annotated[
        str | None, typer.Option(help="Compute the stand's part, too: its geometry, a file or the installed `paper`.")
    ] = None,
    lens: Annotated[
        LensModel, typer.Option(help="Which model of the camera file gives the poses.")
    ] = LensModel.PINHOLE,
    *,
    finding: MarkerSearch,
) -> None:
    """Measure how far the target at V0..V3 seems to move with temperature, before and after compensation, next to the
    paper's values.

    In a session of several cameras the one is used whose serial number the camera file has.

    Example: compensate validate sessions/20260101T180000Z-validation --camera camera.json --model model.json
    -o validation.html
    """
    numbers_path = _choose_numbers_path(out)
    file, drift = load_camera(camera), load_model(model)
    calibrated = select_lens_model(file, lens)
    if lens is LensModel.RAYS and file.rays_warning:
        say(file.rays_warning)
    geometry = None if budget is None else load_geometry(budget)
    opened = Session.open(session)
    observations = finding.observed([session], find_camera_name(opened, file.camera_serial))
    check_same(observations, file, drift)
    frames = select_validation_frames(opened, observations)

    def stand_at(distances_mm: Float) -> StandContribution | None:
        if geometry is None:
            return None
        return compute_stand_contribution(opened, observations, frames, geometry, distances_mm)

    found = validate(observations, frames, calibrated, drift, stand_at)
    write_atomically(out, render_validation_page(found))
    write_atomically(numbers_path, serialise_validation(found))
    show(json.loads(serialise_validation(found)), [format_summary(found)])


def _choose_numbers_path(page: Path) -> Path:
    """Return where the numbers are written; ConfigError when that is the page, or one of the two cannot be written."""
    numbers_path = page.with_suffix(".json")
    if numbers_path == page:
        raise ConfigError(f"{page}: the page is HTML, and a JSON file is written next to it; name it .html")
    for path in (page, numbers_path):
        check_writable(path)
    return numbers_path
