"""`stand serve`: the daemon that owns a stand for days."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncGenerator, Callable, Generator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from thermostand.foundation.clock import WallClock
from thermostand.foundation.command_app import App
from thermostand.foundation.documents import read_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import KINDS, LOOPBACK_TRUSTED, OPEN, TOKENS_NOT_READ, TOKENS_READ
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.output import Output, get_output, json_line, say
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.checked_cli import warn_unchecked
from thermostand.stand.commands.endpoint import ConfigArgument, ConfigOrOption, choose_config
from thermostand.stand.commands.live import open_background_output
from thermostand.stand.commands.remedies import get_next_command
from thermostand.stand.config.check_record import ATTACHMENT, load_check_record
from thermostand.stand.config.interface_section import TokenFile, load_tokens
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.order import read_optics_texts
from thermostand.stand.service.daemon import serve as serve_stand
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api.access import TokenStore
from thermostand.stand.serving.interface import HERE, make_interface, serve_interface

# SIGHUP to a daemon: its tokens are read again. From a terminal that is closed it ends the daemon, as SIGTERM does.

Tell = Callable[[Event], None]


class TokenReloader:
    """Reloads tokens from `begin` on; to be used on the control loop. path: of the tokens, None where no file is
    named."""

    def __init__(self, path: Path | None, book: TokenStore, now_ns: Callable[[], int], tell: Tell) -> None:
        self._path, self._book = path, book
        self._now_ns, self._tell = now_ns, tell
        self._reading: asyncio.Task[None] | None = None
        self._is_asked = False
        self._had_terminal = _has_terminal() and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN

    def begin(self) -> None:
        """SIGHUP comes here."""
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._handle_hangup)

    def _handle_hangup(self) -> None:
        if self._had_terminal and not _has_terminal():
            os.kill(os.getpid(), signal.SIGTERM)
            return
        self._is_asked = True
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        while self._is_asked:
            self._is_asked = False
            try:
                event = self._renew(await asyncio.to_thread(self._load))
            except ConfigError as error:
                event = TOKENS_NOT_READ.at(self._now_ns(), str(error))
            self._tell(event)

    def _load(self) -> TokenFile:
        if self._path is None:
            raise ConfigError("SIGHUP reads tokens again, and the stand's file names none (interface.secrets)")
        return load_tokens(self._path)

    def _renew(self, known: TokenFile) -> Event:
        before, now = (self._book.known or TokenFile()).list_by_name(), known.list_by_name()
        self._book.renew(known)
        revoked = sorted(name for name, token in before.items() if now.get(name) != token)
        added = sorted(name for name, token in now.items() if before.get(name) != token)
        changes = [f"{name} is let in" for name in added]
        changes += [f"{name} is not let in any more" for name in revoked if name not in now]
        text = ", ".join(changes) or "nothing has changed"
        return TOKENS_READ.at(self._now_ns(), text, added=added, revoked=revoked)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC))
    except OSError:
        return False
    return True


app = App()


@app.command()
def serve(
    configuration: ConfigArgument = None,
    *,
    by_option: ConfigOrOption = None,
    out: Annotated[Path | None, typer.Option(help="Where the sessions go; else recording.directory.")] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Listen by TCP, too; without it the Unix socket only.")
    ] = None,
    host: Annotated[str, typer.Option(help="The address to listen at, with --port.")] = HERE,
    secop: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Serve SECoP on this machine, usually at 10767.")
    ] = None,
    no_reports: Annotated[bool, typer.Option("--no-reports", help="Write no report when a run is complete.")] = False,
) -> None:
    """Own the stand until it is stopped: status, devices by hand, and a queue whose runs are its guests.

    SIGTERM or Ctrl-C makes the stand safe and ends it; the run under way may be resumed. SIGHUP reads the tokens again,
    unless the terminal is closed: then it is an end, too. With --json what happens as events, one a line.

    Example: stand serve laboratory.yaml --out /data/sessions
    """
    config = choose_config(configuration, by_option)
    path = find_packaged("", config)
    stand = load_config(path)
    if port is None and stand.interface.port is None and host != HERE:
        raise ConfigError(f"--host {host}: give --port, too; without one nothing listens there")
    texts = _collect_attachments(path, stand)
    directory = (out or stand.recording.directory).absolute()
    secrets, trusts = stand.interface.secrets, stand.interface.trust_loopback
    interface = make_interface(stand, directory, host, port, secop)

    @asynccontextmanager
    async def answering(service: StandService, hub: Hub, clock: WallClock) -> AsyncGenerator[None]:
        port, others = interface.port, interface.doors
        async with serve_interface(
            service, directory, stand.name, interface, texts["target.yaml"], service.shutdown_deadline
        ):
            where = f"; http://{host}:{port}/" if port is not None else ""
            where += "".join(f"; SECoP at {each.port}" for each in others)
            event = OPEN.at(clock.now_ns(), where, stand=stand.name, sessions=str(directory), port=port)
            _print_event_json(event) if get_output().as_json else say(event.text)
            with _show_events(hub):
                if secrets is not None and trusts and (port is not None or others):
                    may = "may look at this stand and stop it" if trusts == "read-only" else "operates this stand"
                    hub.publish(LOOPBACK_TRUSTED.at(clock.now_ns(), may))
                TokenReloader(secrets, interface.tokens, clock.now_ns, hub.publish).begin()
                yield

    asyncio.run(serve_stand(stand, config, texts, directory, answering, has_reports=not no_reports))


def _collect_attachments(path: Path, stand: StandConfig) -> dict[str, str]:
    """Return what each session of this stand keeps, by the attachment's name; a stand that was not checked since is
    reported."""
    texts = {"config.yaml": read_document(path), "target.yaml": read_document(find_packaged("targets", stand.target))}
    texts |= read_optics_texts(stand)
    record = load_check_record(path)
    warn_unchecked(path, stand, record)
    return texts if record is None else texts | {ATTACHMENT: record.text}


@contextmanager
def _show_events(hub: Hub) -> Generator[None]:
    """A terminal that is slow, or stopped, delays nothing."""
    with open_background_output() as later:
        wanted = get_output()
        tell = later(_print_event_json if wanted.as_json else _print_event)

        def follow(item: Item) -> None:
            if isinstance(item, Event) and _is_shown(item, wanted):
                tell(item)

        hub.subscribe(follow)
        try:
            yield
        finally:
            hub.unsubscribe(follow)


def _print_event(event: Event) -> None:
    line = event.text if event.level == "info" else f"{event.text}; {get_next_command(event.kind, event.data)}"
    typer.echo(escape_line(line), err=True)


def _print_event_json(event: Event) -> None:
    typer.echo(json_line(event))


def _is_shown(event: Event, wanted: Output) -> bool:
    if wanted.quiet:
        return event.level == "error"
    return wanted.verbose or event.level != "info" or KINDS[event.kind].is_shown
