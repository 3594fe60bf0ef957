"""What the `stand session` commands take: their arguments, and the checks of them. Nothing is imported here that takes
time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermostand.foundation.errors import ConfigError
from thermostand.recording.format.inventory import explain_changed_names, list_segments

SessionArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a recorded session.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="The folder to make; it must not exist.")]
IncompleteOption = Annotated[bool, typer.Option("--incomplete", help="Use a session although part of it is missing.")]


def check_folder(directory: Path) -> Path:
    """`directory`; ConfigError when there is no such folder."""
    if not directory.is_dir():
        raise ConfigError(f"{directory}: {'is a file, not a folder' if directory.exists() else 'no such folder'}")
    return directory


def check_session(directory: Path) -> Path:
    """`directory`; ConfigError when it is no session."""
    if list_segments(check_folder(directory)):
        return directory
    if why := explain_changed_names(directory):
        raise ConfigError(f"{directory}: not a session: {why}")
    if any(list_segments(path) for path in directory.iterdir() if path.is_dir()):
        raise ConfigError(f"{directory}: is a folder of sessions; `stand session list {directory}` shows them")
    raise ConfigError(f"{directory}: not a session; `stand session list` shows those in a folder")
