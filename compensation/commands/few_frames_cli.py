"""`compensate anchor` and `fit-like`: a drift model from few frames, and what other nights or units have shown."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.commands.options import CameraName, Finding
from thermostand.compensation.drift.anchoring import anchored, thermal_of
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.type_prior import fit_like as fit_like_units
from thermostand.foundation.command_app import App
from thermostand.foundation.files import check_writable
from thermostand.foundation.output import show

app = App()


@app.command()
def anchor(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A model file, as compensate fit writes it.")],
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session, with a few reference frames.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The model file (JSON) to write, for this session.")],
    camera: CameraName = None,
    *,
    finding: Finding,
) -> None:
    """Fit a model to where the target is in a new session, with a few reference frames of the session itself.

    Camera or target were taken out since the model was fitted: what that moved is the same in all states, and is taken
    out, with its uncertainty. The new model has the thermal form alone.

    Example: compensate anchor model.json sessions/20260108T180000Z-short -o model-of-the-8th.json
    """
    check_writable(out)
    known = thermal_of(load_model(model))
    found = anchored(known, finding.observed([session], camera))
    _save(found, out)


@app.command("fit-like")
def fit_like(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Of the new unit, at two temperatures or more.")],
    units: Annotated[list[Path], typer.Argument(metavar="MODEL...", help="Of three other units or more of its type.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The model file (JSON) to write.")],
    camera: CameraName = None,
    *,
    finding: Finding,
) -> None:
    """Fit the drift model of a new unit of a camera type to few frames, with what other units of the type have shown.

    A warm-up, the reference and a set-point on each side of it, 14 and 45 degC say, teach more than a hot one alone.

    Example: compensate fit-like sessions/20260108T180000Z-short unit-1.json unit-2.json unit-3.json -o unit-4.json
    """
    check_writable(out)
    known = [thermal_of(load_model(path)) for path in units]
    found = fit_like_units(finding.observed([session], camera), known)
    _save(found, out)


def _save(found: ThermalModel, out: Path) -> None:
    save_model(found, out)
    show({"model": out, "form": found.form, "title": found.title}, [f"{found.form}: {found.title}"])
