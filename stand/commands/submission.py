"""`stand run` where a daemon has the stand: the run is submitted to it and followed, and Ctrl-C stops it."""

from __future__ import annotations

import threading
import uuid
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from thermostand.foundation.errors import ConfigError, Interrupted, SessionError, StandError
from thermostand.stand.commands.live import View, open_view
from thermostand.stand.commands.status_snapshot import RemoteStand, StatusSnapshot
from thermostand.stand.commands.verbs import make_recipe_request, order
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.running.opening.stand_lock import find_daemon_pid
from thermostand.stand.running.order import Order
from thermostand.stand.serving.api_models import QueuedRun, StandState
from thermostand.stand.serving.client import Server
from thermostand.stand.serving.instances import list_daemons

_LOOK_S = 0.5
_LOST_LIMIT_S = 60.0  # a daemon that does not answer for so long is not followed any more
_LEVELS = ("warning", "error")


def find_daemon(config: StandConfig) -> Server | None:
    """The daemon that has this stand; None when there is none, or it cannot be asked."""
    pid = find_daemon_pid(config)
    found = next((each for each in list_daemons() if each.entry.pid == pid), None)
    return None if found is None else Server(found.entry.session, found.socket)


def submit_recipe(server: Server, recipe: str, *, attended: bool = False) -> QueuedRun:
    """A file's recipe as it is now, or an installed one, checked and queued there; SessionError when the stand refuses
    it."""
    return _submit(server, attended=attended, **make_recipe_request(recipe))


def submit(server: Server, wanted: Order, out: Path | None) -> QueuedRun:
    """Checked and queued there; SessionError when the stand refuses it."""
    if out is not None and out.absolute() != Path(server.name):
        raise ConfigError(f"--out {out}: `stand serve` has this stand, and records to {server.name}")
    return _submit(server, recipe_text=wanted.recipe_text, attended=wanted.attended, key=uuid.uuid4().hex)


def submit_resume(server: Server, session: Path) -> QueuedRun:
    """The run of a session in its folder, which is the next one there; SessionError when the stand refuses it."""
    session = session.resolve()
    if session.parent != Path(server.name).resolve():
        raise ConfigError(f"{session}: `stand serve` has this stand, and resumes what is in {server.name}")
    order(server, "resume", session=session.name)
    found = [run for run in server.state().queue if run.session == session.name]
    if not found:
        raise SessionError(f"{session}: its run was taken out of the queue of `stand serve` meanwhile")
    return found[-1]


def _submit(server: Server, **given: object) -> QueuedRun:
    try:
        return QueuedRun.model_validate(order(server, "submit", **given))
    except ValidationError as error:
        raise SessionError(f"{server.name}: its daemon sent an unknown reply; is its version different?") from error


def follow(server: Server, run: QueuedRun) -> Path:
    """Show it until it has ended; its session's folder. Interrupted when it was stopped by Ctrl-C, which it then ends;
    StandError when it failed."""
    follower = _Follower(server, run)
    with open_view() as shown:
        try:
            ended = follower.follow_until_end(shown)
        except KeyboardInterrupt:
            follower.stop()
            ended = follower.follow_until_end(shown)
            raise Interrupted(ended.reason or "stopped by the operator") from None
    if ended.state != "done":
        raise StandError(f"run {ended.id} {ended.state}: {ended.reason}")
    return Path(server.name) / ended.session


class _Follower:
    def __init__(self, server: Server, run: QueuedRun) -> None:
        self._server = server
        self._run = run
        self._remote = RemoteStand(server)
        self._to_come = {"waiting", run.state} - {"running"}  # one that is resumed is `interrupted` until it begins

    def follow_until_end(self, shown: View) -> QueuedRun:
        """A daemon that is busy, or restarts, may not answer for a while."""
        silent_s = 0.0
        while True:
            try:
                state = self._server.state()
                for event in self._remote.events():
                    if event.get("level") in _LEVELS:
                        shown.tell(self._remote.line(event))
                moment = self._remote.take_snapshot(state)
            except SessionError:
                silent_s += _LOOK_S
                if silent_s > _LOST_LIMIT_S:
                    raise
            else:
                silent_s = 0.0
                run = next((each for each in state.queue if each.id == self._run.id), None)
                if run is None:
                    raise SessionError(f"run {self._run.id} was taken out of the queue")
                if run.state == "running":
                    self._to_come = {"waiting"}
                elif run.state not in self._to_come:
                    return run
                shown.show(moment if run.state == "running" else self._describe_waiting(state, moment))
            threading.Event().wait(_LOOK_S)

    def stop(self) -> None:
        """End it when it is running, else take it out of the queue."""
        state = self._server.state()
        waits = any(run.id == self._run.id and run.state in self._to_come for run in state.queue)
        if waits:
            order(self._server, "cancel", run=self._run.id)
            raise Interrupted(f"run {self._run.id} was taken out of the queue; nothing was started")
        order(self._server, "stop")

    def _describe_waiting(self, state: StandState, moment: StatusSnapshot) -> StatusSnapshot:
        ahead = sum(each.state in ("waiting", "running", "interrupted") for each in state.queue) - 1
        why = state.queue_halted or f"{ahead} others are before it"
        return replace(moment, doing=f"{moment.doing}; run {self._run.id} waits: {why}")
