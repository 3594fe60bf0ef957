"""What tests ask a daemon."""

from __future__ import annotations

from pathlib import Path

from foundation.errors import SessionError
from stand.serving.client import LIMIT_S, server_of
from stand.serving.desk import RunStatus


def ask_status(session: Path, timeout_s: float = LIMIT_S) -> RunStatus:
    """The status of the run; SessionError as `ask`, and when nothing is run there."""
    state = server_of(session).state(timeout_s)
    if state.run is None:
        raise SessionError(f"{session}: nothing is run at the moment")
    return state.run
