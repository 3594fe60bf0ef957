"""A night that is still being recorded, as observations: what its finished and unfinished segments hold so far.

The recorder is not disturbed: finished segments are read where they are, of the others a copy is salvaged.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from thermostand.compensation.history.thermal_history import recorded_history
from thermostand.compensation.observations import Observations, observe
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.layout import FINISHED, FRAMES, TELEMETRY, UNFINISHED
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_unfinished


def recorded_so_far(session: Path) -> Observations:
    """The frames so far, with the telemetry up to the last of them: what comes in while somebody waits for a decision
    changes nothing. SessionError when there is nothing to be read, or no frame can be used."""
    with tempfile.TemporaryDirectory(prefix="thermostand-known-") as folder:
        copy = Path(folder) / session.name
        for series in (TELEMETRY, FRAMES):
            (copy / series).mkdir(parents=True)
            for segment in sorted((session / series).iterdir()) if (session / series).is_dir() else ():
                _taken(segment, copy / series)
        salvage_unfinished(Path(folder))
        observed = observe(copy, incomplete=_unreported)
        history = recorded_history(Session.open(copy), int(observed.time_ns[-1]))
        return replace(observed, histories=(history,))


def _taken(segment: Path, folder: Path) -> None:
    """A segment may be finished between the list and the look at it."""
    finished = segment.with_name(f"{segment.name.partition('.')[0]}{FINISHED}")
    try:
        if segment.name.endswith(UNFINISHED) and not finished.exists():
            shutil.copyfile(segment, folder / segment.name)
        elif finished.exists() and not (folder / finished.name).exists():
            (folder / finished.name).symlink_to(finished.absolute())
    except FileNotFoundError:
        if not finished.exists():
            raise SessionError(f"{segment}: was removed while it was read") from None
        (folder / finished.name).symlink_to(finished.absolute())


def _unreported(sentence: str) -> None:
    """A night under way lacks its rest."""
