"""`compensate certificate`: a calibration certificate of a camera's thermal drift."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.budget.geometry import load_geometry
from thermostand.compensation.camera_selection import select_camera
from thermostand.compensation.certificate.certificate import issue_certificate
from thermostand.compensation.certificate.order import load_order
from thermostand.compensation.commands.options import CameraName, MarkerSearch
from thermostand.compensation.reporting.dcc import serialise_dcc
from thermostand.compensation.reporting.equipment import list_equipment
from thermostand.compensation.reporting.pages import render_certificate_page, render_pdf
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import check_writable, write_atomically, write_bytes_atomically
from thermostand.foundation.output import show
from thermostand.recording.reading.session import Session

app = App()


@app.command("certificate")
def write_certificate(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Folders of sessions of one camera.")],
    order: Annotated[
        Path,
        typer.Option(help="A file that states what no recording knows: number, customer, item, traceability, limits."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE.pdf|html", help="The page to write; else the order's name as .pdf."),
    ] = None,
    *,
    camera: CameraName = None,
    finding: MarkerSearch,
) -> None:
    """Write a calibration certificate (ISO/IEC 17025, 7.8) as a page, and as a digital calibration certificate (DCC) of
    the same name with .xml next to it.

    Values and budgets are those of the datasheet. What the order lacks is asked for; nothing is filled in.

    Example: compensate certificate sessions/20260101T180000Z-thermal-cycle --order order.yaml
    """
    page = out or order.with_suffix(".pdf")
    if page.suffix.lower() not in (".pdf", ".html"):
        raise ConfigError(f"{page}: give a name that ends in .pdf, .html")
    document = page.with_suffix(".xml")
    for path in (page, document):
        check_writable(path)
    stated = load_order(order)
    geometry = None if stated.geometry == "none" else load_geometry(stated.geometry)
    observations = finding.observed(sessions, camera)
    opened = [Session.open(path) for path in sessions]
    for session in opened:
        select_camera(session, camera)
    made = issue_certificate(opened, observations, stated, geometry)
    equipment = list_equipment(opened[0])
    html, xml = render_certificate_page(made, equipment), serialise_dcc(made, equipment)
    if page.suffix.lower() == ".pdf":
        write_bytes_atomically(page, render_pdf(html))
    else:
        write_atomically(page, html)
    write_atomically(document, xml)
    by_simulation = [one.quantity.key for one in made.values if one.method != "GUM"]
    lines = [f"{page} and {document}: {len(made.values)} values with U, of which {len(by_simulation)} by Monte Carlo"]
    lines += [f"{one.value.quantity.name}: {one.verdict}" for one in made.conformities]
    show({"page": page, "dcc": document, "values": made.values, "conformities": made.conformities}, lines)
