"""What tests ask a daemon."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from thermostand.foundation.errors import SessionError
from thermostand.stand.serving.api_models import RunStatus
from thermostand.stand.serving.client import LIMIT_S, Answer, find_session_server


def ask(session: Path, verb: str, body: Mapping[str, object] | None = None, timeout_s: float = LIMIT_S) -> Answer:
    """What the daemon that runs `session` answers to a command; SessionError when none runs, it does not answer, or it
    refuses."""
    return find_session_server(session).order(verb, body, timeout_s)


def ask_status(session: Path, timeout_s: float = LIMIT_S) -> RunStatus:
    """The status of the run; SessionError as `ask`, and when nothing is run there."""
    state = find_session_server(session).state(timeout_s)
    if state.run is None:
        raise SessionError(f"{session}: nothing is run at the moment")
    return state.run
