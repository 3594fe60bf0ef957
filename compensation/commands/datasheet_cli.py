"""`compensate datasheet`: a camera's behaviour over temperature, with uncertainties."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.commands.options import CameraName, DetailsOption, Finding
from thermostand.compensation.datasheet.datasheet import datasheet
from thermostand.compensation.datasheet.details import load_details
from thermostand.compensation.drift.choosing import fit
from thermostand.compensation.drift.model_file import load_model
from thermostand.compensation.reporting.equipment import equipment_of
from thermostand.compensation.reporting.page import pdf_of
from thermostand.compensation.reporting.pages import datasheet_json, datasheet_page
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import check_writable, write_whole, write_whole_bytes
from thermostand.foundation.output import show
from thermostand.recording.reading.session import Session

app = App()

_FORMATS = (".html", ".pdf", ".json")


@app.command("datasheet")
def write_datasheet(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Folders of sessions of one camera.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.html|pdf|json", help="The file to write.")],
    model: Annotated[Path | None, typer.Option(help="Score this model; else one is fitted to the sessions.")] = None,
    details: DetailsOption = None,
    camera: CameraName = None,
    *,
    finding: Finding,
) -> None:
    """Write a camera's thermal datasheet: px/K and ppm/K, settling, hysteresis, what each form of compensation leaves,
    each with its expanded uncertainty and the budget it comes from.

    Example: compensate datasheet sessions/20260101T180000Z-thermal-cycle -o camera.pdf
    """
    if out.suffix.lower() not in _FORMATS:
        raise ConfigError(f"{out}: give a name that ends in {', '.join(_FORMATS)}")
    check_writable(out)
    stated = load_details(details)
    given = None if model is None else load_model(model)
    observations = finding.observed(sessions, camera)
    sheet = datasheet(observations, given or fit(observations), stated)
    equipment = equipment_of(Session.open(sessions[0]))
    if out.suffix.lower() == ".json":
        write_whole(out, datasheet_json(sheet, equipment))
    elif out.suffix.lower() == ".pdf":
        write_whole_bytes(out, pdf_of(datasheet_page(sheet, equipment)))
    else:
        write_whole(out, datasheet_page(sheet, equipment))
    known = sum(one.value == one.value for one in sheet.quantities)
    line = f"{out}: {known} of {len(sheet.quantities)} quantities, with U (k = 2)"
    show({"file": out, "quantities": sheet.quantities}, [line])
