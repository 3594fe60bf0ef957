"""The commands that run a recipe: demo, run, resume."""

from __future__ import annotations

import asyncio
import itertools
import tempfile
import threading
import uuid
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, Interrupted, SessionError, StandError
from thermostand.foundation.exit_codes import NOT_REPORTED
from thermostand.foundation.output import get_output, say, show
from thermostand.foundation.usage import report_failure
from thermostand.recording.repair.salvage import format_salvaged
from thermostand.stand.commands.checked_cli import warn_unchecked
from thermostand.stand.commands.endpoint import ConfigOption, RecipeArgument, TokenOption, UrlOption
from thermostand.stand.commands.live import View, follow_run, open_view
from thermostand.stand.commands.status_snapshot import RemoteStand, StatusSnapshot
from thermostand.stand.commands.verbs import make_recipe_request, order
from thermostand.stand.config.check_record import load_check_record
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.estimating.learned_durations import learn_durations
from thermostand.stand.estimating.run_estimate import estimate_plan, explain_small_disk, find_existing
from thermostand.stand.running.opening.stand_lock import find_daemon_pid
from thermostand.stand.running.order import Order, load_order
from thermostand.stand.running.resume import is_of_virtual_time, load_interruption
from thermostand.stand.running.session_report import REPORT_NAME, NotReported, check_reportable, report_session
from thermostand.stand.service.run import resume, run_real, run_virtual
from thermostand.stand.serving.api_models import QueuedRun, StandState
from thermostand.stand.serving.client import Server, make_server
from thermostand.stand.serving.instances import list_daemons
from thermostand.stand.serving.interface import make_interface

app = App()

ReportOption = Annotated[
    bool, typer.Option("--report", help="Then fit the drift: model.json and report.html, in the session's folder.")
]

AttendedOption = Annotated[
    bool, typer.Option("--attended", help="Wait at each prompt until an operator's `stand continue`.")
]


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="Where the session and the report go; numbered when there is a demo already.")
    ] = Path("demo"),
) -> None:
    """Run a simulated thermal cycle, fit the drift, and print what compensation gains.

    Example: stand demo --out /tmp/demo
    """
    order = load_order("demo", "simulated")
    directory = _find_unused_path(out)
    _check_writable(directory)
    estimate = estimate_plan(tuple(order.recipe.plan()), order.config, directory)
    with follow_run(estimate, directory, is_virtual=True) as shown:
        session = asyncio.run(run_virtual(order, directory, None, shown.watch, front=shown.follow_service))
    _show_session(session, directory, f"session  {session}", report=True)


@app.command()
def run(
    recipe: RecipeArgument,
    *,
    config: ConfigOption = "simulated",
    out: Annotated[Path | None, typer.Option(help="Where the session goes; else recording.directory.")] = None,
    virtual_time: Annotated[
        bool,
        typer.Option("--virtual-time", help="In a simulated laboratory, as fast as it goes; for any stand's file."),
    ] = False,
    seed: Annotated[int | None, typer.Option(help="The simulated laboratory's seed (with --virtual-time).")] = None,
    attended: AttendedOption = False,
    report: ReportOption = False,
    detach: Annotated[
        bool, typer.Option("--detach", help="Where `stand serve` has the stand: submit the run and leave.")
    ] = False,
    url: UrlOption = "",
    token_file: TokenOption = None,
) -> None:
    """Run a recipe and record it; prints the session's folder.

    Where `stand serve` has the stand, here or at --url, the run is submitted to it and followed; Ctrl-C stops it.

    Example: stand run thermal-cycle --config laboratory.yaml --out /data/sessions --report
    """
    if url:
        _check_remote_options({"--virtual-time": virtual_time, "--seed": seed, "--out": out, "--report": report})
        remote = make_server(url, token_file)
        return _follow(remote, submit_recipe(remote, recipe, attended=attended), detach=detach, report=False)
    _check_seed(seed, virtual_time=virtual_time)
    order = replace(load_order(recipe, config), attended=attended)
    if report:
        check_reportable(order.recipe.plan())
    if not virtual_time:
        path = find_packaged("", config)
        warn_unchecked(path, order.config, load_check_record(path))
    if not virtual_time and (server := find_daemon(order.config)) is not None:
        return _follow(server, submit(server, order, out), detach=detach, report=report)
    if detach:
        raise ConfigError("--detach: no `stand serve` has this stand, and a run by itself ends with its command")
    directory = out or order.config.recording.directory
    _check_writable(directory)
    estimate = estimate_plan(tuple(order.recipe.plan()), order.config, directory)
    if lack := explain_small_disk(directory, estimate.steps, order.config):
        say(f"warning: {directory}: {lack}")
    interface = None if virtual_time else make_interface(order.config, directory)
    with follow_run(estimate, directory, is_virtual=virtual_time) as shown:
        if interface is None:
            work = run_virtual(order, directory, seed, shown.watch, front=shown.follow_service)
        else:
            front = shown.make_front(interface, order.target_text)
            work = run_real(order, directory, shown.watch, front=front)
        session = asyncio.run(work)
    _finish(session, order.config, report=report)


def _check_remote_options(given: Mapping[str, object]) -> None:
    """ConfigError when an option is given that a run at a stand elsewhere has no use for."""
    if name := next((name for name, value in given.items() if not (value is None or value is False)), ""):
        raise ConfigError(f"{name} is for a run of this machine; leave it out, or --url")


def _check_seed(seed: int | None, *, virtual_time: bool) -> None:
    if seed is not None and not virtual_time:
        raise ConfigError("--seed belongs to --virtual-time; a running laboratory has its own seed")
    if seed is not None and seed < 0:
        raise ConfigError(f"--seed is 0 or more, not {seed}")


@app.command("resume")
def resume_run(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="The session of a run that did not end.")],
    config: ConfigOption = "simulated",
    reset: Annotated[
        bool, typer.Option("--reset", help="Reset a trip first; only when its cause has been removed.")
    ] = False,
    attended: AttendedOption = False,
    report: ReportOption = False,
) -> None:
    """Resume a run that was killed or interrupted, in its session: what is done is not done again.

    Recipe, seed, target and camera settings are the session's; programs, files, addresses and limits are this stand's.
    Where `stand serve` has the stand, it resumes the run, and this follows; Ctrl-C stops it.

    Example: stand resume sessions/20260101T180000Z-thermal-cycle --config laboratory.yaml
    """
    before = load_interruption(directory, load_config(find_packaged("", config)), reset=reset)
    order = replace(before.order, attended=attended)
    before = replace(before, order=order)
    try:
        if report:
            check_reportable(order.recipe.plan())
        for segment in before.salvaged:
            typer.echo(format_salvaged(segment), err=True)
        estimate = estimate_plan(before.state.plan, order.config, before.directory.parent)
    except BaseException:
        before.release()
        raise
    is_virtual = is_of_virtual_time(before)
    if not is_virtual and (server := find_daemon(order.config)) is not None:
        before.release()
        _resume_remotely(server, directory, attended=attended, report=report)
        return
    sessions = directory.parent
    try:
        interface = None if is_virtual else make_interface(order.config, sessions)
    except BaseException:
        before.release()
        raise
    with follow_run(estimate, sessions, is_virtual=is_virtual) as shown:
        front = shown.follow_service if interface is None else shown.make_front(interface, order.target_text)
        session = asyncio.run(resume(before, shown.watch, front=front))
    _finish(session, order.config, report=report)


def _follow(server: Server, submitted: QueuedRun, *, detach: bool, report: bool) -> None:
    """A run of the daemon that has the stand."""
    if detach:
        show({"id": submitted.id}, [f"run {submitted.id} is queued; `stand status` follows it"])
        return
    session = follow(server, submitted)
    _show_session(session, session, str(session), report=report)


def _resume_remotely(server: Server, directory: Path, *, attended: bool, report: bool) -> None:
    """Resume the run in the daemon that has the stand."""
    if attended:
        raise ConfigError("--attended: `stand serve` has this stand, and resumes a run as it was queued; leave it out")
    session = follow(server, submit_resume(server, directory))
    _show_session(session, session, str(session), report=report)


def _finish(session: Path, config: StandConfig, *, report: bool) -> None:
    """Do what follows a complete run: learn the next plan's durations, print its folder, make its report."""
    try:
        learn_durations(session.parent, config)
    except (SessionError, OSError) as error:  # what cannot be kept is no reason for a run to fail
        say(f"warning: {error}")
    _show_session(session, session, str(session), report=report)


def _show_session(session: Path, folder: Path, line: str, *, report: bool) -> None:
    """The session, and when asked for its report's lines; status NOT_REPORTED when there is none: the run itself has
    gone well."""
    if not get_output().as_json:
        typer.echo(line)  # before the report, which takes a minute
    try:
        lines = report_session(session, folder).lines if report else []
        show({"session": session, "report": folder / REPORT_NAME if report else None}, lines)
    except NotReported as error:
        if get_output().as_json:
            show({"session": session, "report": None, "error": str(error)}, ())
        raise report_failure(error, NOT_REPORTED) from error


def _find_unused_path(out: Path) -> Path:
    """`out`, or `out-2`, `out-3` ... when it exists: a second demo never touches the first."""
    if not out.name:
        raise ConfigError(f"--out {out}: a demo needs a folder of its own name")
    candidates = (out.with_name(f"{out.name}-{number}") for number in itertools.count(2))
    return out if not out.exists() else next(path for path in candidates if not path.exists())


def _check_writable(directory: Path) -> None:
    """ConfigError when no session could be made below `directory`: to be raised before anything is opened."""
    try:
        Path(tempfile.mkdtemp(prefix=".writable-", dir=find_existing(directory))).rmdir()
    except OSError as error:
        raise ConfigError(f"{directory}: no session can be written there ({error.strerror})") from error


# `stand run` where a daemon has the stand: the run is submitted to it and followed, and Ctrl-C stops it.

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
