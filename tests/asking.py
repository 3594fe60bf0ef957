"""What tests ask a daemon."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from thermostand.foundation.errors import SessionError
from thermostand.stand.serving.client import LIMIT_S, Answer, server_of
from thermostand.stand.serving.desk import RunStatus


def ask(session: Path, verb: str, body: Mapping[str, object] | None = None, timeout_s: float = LIMIT_S) -> Answer:
    """What the daemon that runs `session` answers to a command; SessionError when none runs, it does not answer, or it
    refuses."""
    return server_of(session).order(verb, body, timeout_s)


def ask_status(session: Path, timeout_s: float = LIMIT_S) -> RunStatus:
    """The status of the run; SessionError as `ask`, and when nothing is run there."""
    state = server_of(session).state(timeout_s)
    if state.run is None:
        raise SessionError(f"{session}: nothing is run at the moment")
    return state.run
