"""`stand foxglove`: a running stand in a viewer of robots' data."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Annotated

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.stand.commands.endpoint import on_stand
from thermostand.stand.serving.client import Server

app = App()
# As often as the daemon makes a snapshot.
_LOOK_S = 0.5


@app.command()
@on_stand(anywhere=True)
def foxglove(
    server: Server,
    port: Annotated[int, typer.Option(help="Of this machine, at which a viewer connects.")] = 8765,
) -> None:
    """Show what happens in Foxglove or Lichtblick, at ws://127.0.0.1:8765, until Ctrl-C. Viewers can only read.

    Example: stand foxglove
    """
    try:
        from thermostand.stand.commands.foxglove_live import HOST, FoxgloveServer
    except ModuleNotFoundError as error:
        raise ConfigError("it needs foxglove-sdk: pip install 'thermostand[foxglove]'") from error
    from thermostand.stand.commands.status_snapshot import RemoteStand

    remote = RemoteStand(server)
    try:
        published = FoxgloveServer(server.state().stand, port)
    except (OSError, RuntimeError) as error:
        raise ConfigError(f"--port {port}: cannot listen at {HOST} ({error})") from error
    typer.echo(f"ws://{HOST}:{port}; Ctrl-C ends it", err=True)
    try:
        with suppress(KeyboardInterrupt):
            while True:
                for event in remote.events():
                    published.event(event)
                published.state(server.state())
                published.publish_picture(server.fetch_picture)
                threading.Event().wait(_LOOK_S)
    finally:
        published.close()
