"""`compensate budget`: what the stand itself did to the images of a session."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from thermostand.compensation.budget.budget import Budget, budget, table
from thermostand.compensation.budget.geometry import load_geometry
from thermostand.compensation.commands.options import CameraName, Incomplete, TargetOption, named_target, open_session
from thermostand.compensation.observations import session_target
from thermostand.compensation.one_camera import take
from thermostand.foundation.command_app import App
from thermostand.foundation.output import show
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session

app = App()


@app.command("budget")
def budget_of_session(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of a recorded session.")],
    geometry: Annotated[str, typer.Option(help="The stand's geometry: a file, or the installed `paper`.")] = "paper",
    target: TargetOption = None,
    camera: CameraName = None,
    incomplete: Incomplete = False,
) -> None:
    """The stand's error budget: refraction, granite, target and table, in um and px, with uncertainty.

    Example: compensate budget sessions/20260101T180000Z-validation --geometry my-stand.yaml
    """
    stand = load_geometry(geometry)
    recorded = open_session(session, camera, incomplete)
    found = budget(recorded, named_target(target) or session_target(recorded), stand)
    show(found, [table(found)])


def budgets_of_sessions(
    paths: Sequence[Path], camera: str | None, geometry: str, target: Target | None
) -> dict[str, Budget]:
    """The budget of each session, by its name. SessionError or ConfigError with a sentence."""
    stand = load_geometry(geometry)
    opened = [Session.open(path) for path in paths]
    for session in opened:
        take(session, camera)
    return {
        session.metadata.get("session_id", ""): budget(session, target or session_target(session), stand)
        for session in opened
    }
