"""The commands that look at a run under way, and `reset`, which a stand without a daemon has, too."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, cast

import typer

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import SessionError
from thermostand.foundation.instants import format_duration, format_local
from thermostand.foundation.output import get_output, show
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.endpoint import (
    ConfigOption,
    DirectoryArgument,
    TokenOption,
    UrlOption,
    find_server,
    on_stand,
)
from thermostand.stand.commands.remedies import get_next_command
from thermostand.stand.commands.sessions.session_text import format_size
from thermostand.stand.commands.status_snapshot import SET_POINT, describe_manual_heat, list_unsafe_parts
from thermostand.stand.commands.verbs import order
from thermostand.stand.safety.gate import ENDINGS, HELD, INTERLOCK, STOPPING
from thermostand.stand.safety.latch import LatchedFault
from thermostand.stand.service.stand_service import describe_hold
from thermostand.stand.serving.api_models import FaultState, RunStatus, StandState
from thermostand.stand.serving.client import API, Answer, Server

app = App()

_WATCH_S = 2.0  # a person looks at it; not measured
_AGAIN_S, _LOOK_S = 2.0, 0.25  # the guard looks once a second
_LABEL = 14
_NEW_NS = 10 * NS_PER_S  # slower than any installed stand polls


@app.command()
def status(
    directory: DirectoryArgument = None,
    config: ConfigOption = "simulated",
    url: UrlOption = "",
    token_file: TokenOption = None,
    plan: Annotated[bool, typer.Option("--plan", help="The steps of the plan in force, and where they are.")] = False,
) -> None:
    """Show what the run under way is doing: step, state, expected end, temperatures, frames, disk, last warning.

    Without DIR, when none runs in recording.directory: the only one on this machine. The same for `stand stop`. When
    nothing runs: whether the stand of --config has tripped, and nobody has reset it.

    Example: stand status /data/sessions
    """
    try:
        server = find_server(directory, config, url, token_file, anywhere=True)
    except SessionError as error:
        if not url and directory is None and (fault := _read_latch(config)) is not None:
            raise SessionError(f"{error}; the stand has tripped: {fault.text}; {ENDINGS[INTERLOCK]}") from error
        raise
    if plan:
        _show_plan(server)
        return
    _show(server, server.state())


@app.command()
@on_stand(anywhere=True)
def watch(server: Server) -> None:
    """A run's messages as they come, above a panel with step, temperatures, frames, disk and end; without a terminal a
    line a minute. With --json the events, one a line. Ctrl-C ends watching, not the run.

    Example: stand watch
    """
    from thermostand.stand.commands.live import open_view
    from thermostand.stand.commands.status_snapshot import RemoteStand

    remote = RemoteStand(server)
    with suppress(KeyboardInterrupt):
        if get_output().as_json:
            while True:
                for event in remote.events():
                    typer.echo(json.dumps(event))
                threading.Event().wait(_WATCH_S)
        with open_view() as shown:
            while True:
                for event in remote.events():
                    shown.tell(remote.line(event))
                shown.show(remote.take_snapshot(server.state()))
                threading.Event().wait(_WATCH_S)


@app.command()
def reset(
    directory: DirectoryArgument = None,
    config: ConfigOption = "simulated",
    url: UrlOption = "",
    token_file: TokenOption = None,
) -> None:
    """Continue a run that an interlock holds, or free a stand that has tripped, once you have removed the cause.

    Without a daemon: what an earlier run or daemon has left latched of the stand of --config.

    Example: stand reset
    """
    try:
        server = find_server(directory, config, url, token_file)
    except SessionError:
        if url or directory is not None or not _reset_here(config):
            raise
        return
    answer = order(server, "reset")
    again, text = _wait_for_renewed_fault(server), str(answer.get("text") or "reset")
    if again is not None:
        text = f"reset; held again: {again.rule}: {again.text}"
        _say(server, {**answer, "text": text, "reasons": [INTERLOCK]}, f"{text}; {ENDINGS[INTERLOCK]}")
    else:
        held = (
            describe_hold(cast("list[str]", answer["reasons"]))
            if answer.get("reasons")
            else "nothing holds the stand any more"
        )
        _say(server, answer, f"{text}; {held}")


def _wait_for_renewed_fault(server: Server) -> FaultState | None:
    """Return what the guard, or a step that is done again, has met within a moment of a reset."""
    for _ in range(round(_AGAIN_S / _LOOK_S)):
        if (fault := server.state().fault) is not None:
            return fault
        threading.Event().wait(_LOOK_S)
    return None


def _read_latch(config: str) -> LatchedFault | None:
    """Return what an earlier run or daemon has left latched of the stand, which no program has."""
    from thermostand.stand.config.stand_config import find_packaged, load_config
    from thermostand.stand.running.opening.stand_lock import find_latch_file

    return find_latch_file(load_config(find_packaged("", config))).read()


def _reset_here(config: str) -> bool:
    """Return whether the stand, which no program has, was latched, and is so no longer; InUse when one has it."""
    import asyncio

    from thermostand.stand.config.stand_config import find_packaged, load_config
    from thermostand.stand.running.opening.stand_lock import find_latch_file, lock_stand

    async def reset() -> bool:
        stand = load_config(find_packaged("", config))
        async with lock_stand(stand, None, "stand reset"):
            latch = await asyncio.to_thread(find_latch_file, stand)
            fault = await asyncio.to_thread(latch.read)
            if fault is not None:
                await asyncio.to_thread(latch.reset)
                show(fault.model_dump(), [f"reset: {escape_line(fault.text)}"])
            return fault is not None

    return asyncio.run(reset())


def _say(server: Server, answer: Mapping[str, object], text: str) -> None:
    show(dict(answer), [f"{server.name}: {text}"])


def _show(server: Server, state: StandState) -> None:
    run = {} if state.run is None else state.run.model_dump(mode="json")
    data = {**run, "session": run.get("session") or server.name, "stand": state.model_dump(mode="json")}
    lines = (
        format_idle_lines(server.name, state)
        if state.run is None
        else format_status_lines(str(data["session"]), state.run)
    )
    unsafe = (_format_row("not safe yet", text) for text in list_unsafe_parts(state))
    lines = [*unsafe, *lines, *_further_lines(state), *(_format_row("next", text) for text in _describe_endings(state))]
    asked = (
        [] if state.prompt is None else [_format_row("asks", f"{state.prompt.text}; `stand continue` when it is done")]
    )
    show(data, [*lines, *asked])


def _describe_endings(state: StandState) -> Iterator[str]:
    """Return what ends what holds the stand."""
    if state.fault is not None:
        ended = {} if state.run is not None else {"action": "hold"}  # a run that has tripped is over: to be reset
        yield get_next_command(f"guard.{state.fault.rule}", {**state.fault.data, **ended})
    for reason in sorted({*state.reasons, *(() if state.run is None else state.run.reasons)} - {INTERLOCK, STOPPING}):
        yield get_next_command(HELD, {"reason": reason})


def _show_plan(server: Server) -> None:
    steps = cast("list[Answer]", server.request("GET", f"{API}/plan"))
    lines = [
        f"{_get_step_number(step):>5}  {str(step['standing']).replace('_', ' '):<10}  {step['text']}" for step in steps
    ]
    show(steps, map(escape_line, lines))


def _get_step_number(planned: Answer) -> int:
    """The number of a step of the plan, as `stand status` counts: 1 is the first."""
    return cast("int", planned["index"]) + 1


def format_idle_lines(name: str, state: StandState) -> Iterator[str]:
    """`stand status` between runs."""
    yield _format_row("stand", f"{state.stand} ({name})")
    found = state.phase if state.by_hand is None else describe_manual_heat(state)
    yield _format_row("state", found if not state.reasons else f"{found}: {', '.join(state.reasons)}")
    if state.by_hand is not None:
        yield _format_row("next", "`stand stop` ends the heat")
    if state.fault is not None:
        yield _format_row("fault", f"{state.fault.rule}: {state.fault.text}")
    for channel, reading in state.readings.items():
        if reading.unit == "degC":
            known = f"no reading: {reading.reason}" if reading.value is None else f"{reading.value:.2f} degC"
            if (age_ns := state.now_ns - reading.time_ns) > _NEW_NS:
                known += f", {_format_span(age_ns)} ago"
            is_idle = channel == SET_POINT and state.setpoint_degC is None and reading.value is not None
            yield _format_row("temperatures", f"{channel} {'none' if is_idle else known}")
    waiting = sum(run.state in ("waiting", "interrupted") for run in state.queue)
    yield _format_row(
        "queue", f"{waiting} to be run" + (f"; halted: {state.queue_halted}" if state.queue_halted else "")
    )
    if state.disk_free_bytes:  # 0 when nobody records, and it is not known
        yield _format_row("disk", f"{format_size(state.disk_free_bytes)} free")


def _further_lines(state: StandState) -> Iterator[str]:
    """Return what is read besides temperatures, flags and counts, each in its unit."""
    for channel, reading in state.readings.items():
        if reading.unit not in ("degC", "1"):
            known = f"no reading: {reading.reason}" if reading.value is None else f"{reading.value:.6g} {reading.unit}"
            yield _format_row("readings", f"{channel} {known.strip()}")


def format_status_lines(session: Path | str, found: RunStatus) -> Iterator[str]:
    """`stand status`."""
    state = found.state if found.state != "held" else f"held: {', '.join(found.reasons)}"
    yield _format_row("session", str(session))
    yield _format_row("recipe", found.recipe)
    since = format_local(found.since_ns + found.since_utc_offset_ns)
    yield _format_row("state", f"{state}, since {since} ({_format_span(found.now_ns - found.since_ns)})")
    if found.fault:
        yield _format_row("fault", f"{found.fault_rule}: {found.fault}")
    yield _format_row("step", f"{found.step}/{found.steps} {found.doing}")
    yield _format_row("ends", _format_end(found))
    for channel, value_degC in found.temperatures_degC.items():
        yield _format_row("temperatures", f"{channel} {'BAD' if value_degC is None else f'{value_degC:.2f} degC'}")
    yield _format_row("frames", f"{found.frames_saved} saved, {found.frames_lost} lost")
    yield _format_row("disk", f"{format_size(found.disk_free_bytes)} free")
    yield _format_row("last warning", _format_warning(found))


def _format_row(label: str, text: str) -> str:
    return f"{label:<{_LABEL}}{escape_line(text)}"


def _format_span(length_ns: int) -> str:
    return format_duration(max(0, length_ns))


def _format_end(found: RunStatus) -> str:
    if found.end_ns is None:
        return "not known"
    return f"{format_local(found.end_ns + found.utc_offset_ns)} (in {_format_span(found.end_ns - found.now_ns)})"


def _format_warning(found: RunStatus) -> str:
    if found.warning_ns is None:
        return found.warning or "none"
    level = "error, " if found.warning_level == "error" else ""
    return f"{level}{format_local(found.warning_ns + found.warning_utc_offset_ns)}: {found.warning}"
