"""`stand token`: who may operate a stand over the network."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Annotated, cast

import typer

from foundation.command_app import App
from foundation.errors import ConfigError
from foundation.output import output, show
from stand.commands.reached import ConfigOption, DirectoryArgument, reached
from stand.serving.client import API, Answer

app = App(
    no_args_is_help=True,
    help="Tokens for the network: add, list, remove, login.\n\nExample: stand token add rose --config my-stand.yaml",
)

NameArgument = Annotated[str, typer.Argument(help="Who has the token; it is recorded with what they do.")]
_BYTES = 32


@app.command()
def add(name: NameArgument, config: ConfigOption = "simulated") -> None:
    """Make a token and print it, once. A daemon that is already running knows it after its next start.

    Example: stand token add rose --config my-stand.yaml
    """
    from stand.config.interface_section import TokenFile, load_tokens, write_tokens

    path = _file(config)
    tokens = load_tokens(path) if path.expanduser().exists() else {}
    if name in tokens:
        raise ConfigError(f"{path}: {name} has a token already; `stand token remove {name}` first")
    token = secrets.token_urlsafe(_BYTES)
    try:
        TokenFile(tokens={name: token})
    except ValueError:
        raise ConfigError(f"{name!r}: a name has up to 64 letters, digits and . _ @ -") from None
    write_tokens(path, {**tokens, name: token})
    show({"name": name, "token": token}, [token])


@app.command("list")
def list_names(config: ConfigOption = "simulated") -> None:
    """Who has a token.

    Example: stand token list --config my-stand.yaml
    """
    from stand.config.interface_section import load_tokens

    names = sorted(load_tokens(_file(config)))
    show(names, names)


@app.command()
def remove(name: NameArgument, config: ConfigOption = "simulated") -> None:
    """Take a token back; a daemon that runs already knows it until it is started again.

    Example: stand token remove rose --config my-stand.yaml
    """
    from stand.config.interface_section import load_tokens, write_tokens

    path = _file(config)
    tokens = load_tokens(path)
    if name not in tokens:
        raise ConfigError(f"{path}: {name} has no token; `stand token list` shows who has")
    write_tokens(path, {other: token for other, token in tokens.items() if other != name})
    show({"removed": name}, ())


@app.command()
def login(directory: DirectoryArgument = None, config: ConfigOption = "simulated") -> None:
    """An address that opens the page in a browser elsewhere, once, within ten minutes. Asked of the running daemon.

    Example: stand token login
    """
    server = reached(directory, config, anywhere=True)
    answer = cast("Answer", server.request("POST", f"{API}/login"))
    if not answer["url"] and not output().as_json:
        raise ConfigError(f"{server.name}: its daemon does not listen to the network; start it with --port")
    show(answer, [str(answer["url"])])


def _file(config: str) -> Path:
    from stand.config.stand_config import load_config, packaged

    stand = load_config(packaged("", config))
    if stand.interface.secrets is None:
        raise ConfigError(f"{config}: has no interface.secrets; name a file for the tokens there (docs/api.md)")
    return stand.interface.secrets
