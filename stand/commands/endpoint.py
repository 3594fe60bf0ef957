"""Which stand a command is for: the daemon that runs a session here, or one at an address."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from thermostand.foundation.command_app import add_parameters
from thermostand.foundation.errors import ConfigError, NotFound, SessionError
from thermostand.stand.serving.client import Server, find_session_server, list_running_sessions, make_server

DirectoryArgument = Annotated[
    Path | None,
    typer.Argument(metavar="[DIR]", help="A session, or a folder of sessions; else recording.directory of --config."),
]
DirectoryOption = Annotated[
    Path | None, typer.Option("--dir", help="The daemon's folder of sessions; else recording.directory of --config.")
]
RecipeArgument = Annotated[str, typer.Argument(help="A recipe file, or the name of an installed one.")]
ConfigOption = Annotated[str, typer.Option("--config", help="A configuration file, or the name of an installed one.")]
ConfigArgument = Annotated[str | None, typer.Argument(help="A configuration file, or the name of an installed one.")]
ConfigOrOption = Annotated[str | None, typer.Option("--config", help="The same, as other commands take it.")]
UrlOption = Annotated[
    str, typer.Option("--url", help="A stand's address, http://HOST:PORT, instead of its socket here.")
]
TokenOption = Annotated[Path | None, typer.Option("--token-file", help="The file with the token for --url.")]

Command = Callable[..., None]

OPTIONS: dict[str, tuple[Any, object]] = {
    "config": (ConfigOption, "simulated"),
    "url": (UrlOption, ""),
    "token_file": (TokenOption, None),
}


def choose_config(argument: str | None, option: str | None, default: str = "simulated") -> str:
    """The configuration that a command is given as its argument or behind --config; ConfigError when both are and
    differ, or when neither is given and there is no default."""
    if not (argument or option or default):
        raise ConfigError("give the stand's configuration file")
    if argument is not None and option is not None and argument != option:
        raise ConfigError(f"{argument} and --config {option}: which one? give one of them")
    return argument or option or default


def on_stand(*, anywhere: bool = False) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command whose first parameter is the Server it is for: what finds that is taken from the command line instead.
    anywhere: as `reached` has it."""

    def take(function: Command) -> Command:
        @functools.wraps(function)
        def command(
            *arguments: Any, directory: Path | None, config: str, url: str, token_file: Path | None, **options: Any
        ) -> None:
            function(find_server(directory, config, url, token_file, anywhere=anywhere), *arguments, **options)

        added = {"directory": (DirectoryArgument, None), **OPTIONS}
        return add_parameters(command, function, added, without="server")

    return take


def find_server(
    directory: Path | None, config: str, url: str = "", token_file: Path | None = None, *, anywhere: bool = False
) -> Server:
    """The stand at `url`; else the daemon that runs `directory`, when that is a session, else the only running one in
    it; ConfigError when there are several. `anywhere`: without a directory the only one on this machine will do, for
    what can do no harm."""
    if url:
        return make_server(url, token_file)
    return find_session_server(_find_running_session(directory, config, anywhere=anywhere))


def _find_running_session(directory: Path | None, config: str, *, anywhere: bool) -> Path:
    everywhere = list_running_sessions() if anywhere and directory is None else []
    if len(everywhere) == 1:  # no configuration need be read: STOP is quick
        return everywhere[0]
    # Reading a configuration takes longer than all the rest.
    from thermostand.recording.format.inventory import list_segments
    from thermostand.stand.config.stand_config import find_packaged, load_config

    root = directory or load_config(find_packaged("", config)).recording.directory
    sessions = list_running_sessions(root) or everywhere
    if len(sessions) > 1:
        raise ConfigError(f"{root}: several sessions are running, name one: {', '.join(map(str, sessions))}")
    if sessions:
        return sessions[0]
    if list_segments(root):
        raise SessionError(f"{root}: no daemon is running this session")
    others = ", ".join(map(str, list_running_sessions()))
    elsewhere = f" One is running elsewhere, name it: {others}." if others else ""
    if directory is not None and not directory.exists():
        raise NotFound(f"{root}: no such folder.{elsewhere}" if others else f"{root}: no such folder")
    looked_in = root if root.is_absolute() or str(root).startswith(".") else f"./{root}"
    start = "Start one with `stand serve` or `stand run`."
    raise SessionError(f"No stand is running (looked in {looked_in}). {start}{elsewhere}")
