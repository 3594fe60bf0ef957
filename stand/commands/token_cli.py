"""`stand token`: who may operate a stand over the network."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Annotated, cast

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.output import get_output, say, show
from thermostand.stand.commands.endpoint import ConfigOption, DirectoryArgument, find_server
from thermostand.stand.serving.client import API, Answer

app = App(
    no_args_is_help=True,
    help="Tokens for the network: add, list, remove, login.\n\nExample: stand token add rose --config my-stand.yaml",
)

NameArgument = Annotated[str, typer.Argument(help="Who has the token; it is recorded with what they do.")]
_BYTES = 32


@app.command()
def add(
    name: NameArgument,
    config: ConfigOption = "simulated",
    read_only: Annotated[bool, typer.Option("--read-only", help="The same as --role look.")] = False,
    role: Annotated[
        str, typer.Option(help="look: sees everything; operate: runs and devices; commission: also clears trips.")
    ] = "commission",
) -> None:
    """Make a token and print it, once. A daemon that is already running knows it after SIGHUP, or its next start.

    Example: stand token add rose --config my-stand.yaml
    """
    from thermostand.stand.config.interface_section import KEYS, ROLES, Role, TokenFile, load_tokens, write_tokens

    path = _get_token_file(config)
    known = load_tokens(path) if path.expanduser().exists() else TokenFile()
    if name in known.list_by_name():
        raise ConfigError(f"{path}: {name} has a token already; `stand token remove {name}` first")
    token = secrets.token_urlsafe(_BYTES)
    given = cast("Role", "look" if read_only else role)
    if given not in ROLES:
        raise ConfigError(f"--role: there is no role {role!r}; there are {', '.join(ROLES)}")
    kind = KEYS[given]
    try:
        added = TokenFile.model_validate({**known.model_dump(), kind: {**getattr(known, kind), name: token}})
    except ValueError:
        raise ConfigError(f"{name!r}: a name has up to 64 letters, digits and . _ @ -") from None
    write_tokens(path, added)
    show({"name": name, "token": token, "role": given}, [token])
    _print_activation("knows it")


@app.command("list")
def list_names(config: ConfigOption = "simulated") -> None:
    """List who has a token, and its role.

    Example: stand token list --config my-stand.yaml
    """
    from thermostand.stand.config.interface_section import load_tokens

    known = load_tokens(_get_token_file(config)).list_by_name()
    found = [(name, role) for name, (_, role) in sorted(known.items())]
    show([{"name": name, "role": role} for name, role in found], [f"{name}  {role}" for name, role in found])


@app.command()
def remove(name: NameArgument, config: ConfigOption = "simulated") -> None:
    """Take a token back. A daemon that is already running forgets it at SIGHUP, with all that it has open.

    Example: stand token remove rose --config my-stand.yaml
    """
    from thermostand.stand.config.interface_section import load_tokens, write_tokens

    path = _get_token_file(config)
    known = load_tokens(path)
    if name not in known.list_by_name():
        raise ConfigError(f"{path}: {name} has no token; `stand token list` shows who has")
    write_tokens(path, known.drop_token(name))
    show({"removed": name}, ())
    _print_activation("forgets it, and disconnects who has it")


@app.command()
def login(
    directory: DirectoryArgument = None,
    config: ConfigOption = "simulated",
    read_only: Annotated[bool, typer.Option("--read-only", help="For who may look and press STOP only.")] = False,
) -> None:
    """An address that opens the page in a browser elsewhere, once, within ten minutes. Asked of the running daemon.

    Example: stand token login
    """
    server = find_server(directory, config, anywhere=True)
    answer = cast("Answer", server.request("POST", f"{API}/login", {"read_only": read_only}))
    if not answer["url"] and not get_output().as_json:
        raise ConfigError(f"{server.name}: its daemon does not listen to the network; start it with --port")
    show(answer, [str(answer["url"])])


def _print_activation(what: str) -> None:
    """Print how a daemon learns of it. No signal is sent from here: for `stand run`, which reads them once, it is an
    end."""
    say(f"a running `stand serve` {what} at SIGHUP (`systemctl reload` of its unit, or kill -HUP), or its next start")


def _get_token_file(config: str) -> Path:
    from thermostand.stand.config.stand_config import find_packaged, load_config

    stand = load_config(find_packaged("", config))
    if stand.interface.secrets is None:
        raise ConfigError(
            f"{config}: has no interface.secrets; name a file for the tokens there (docs/how-to/open-to-the-network.md)"
        )
    return stand.interface.secrets
