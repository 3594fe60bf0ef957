"""The configuration's interface section, and the file of tokens that it names."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

from pydantic import Field

from foundation.documents import Document
from foundation.errors import ConfigError
from stand.config.private_file import private_document

TokenName = Annotated[str, Field(pattern=r"^[\w.@-]{1,64}$")]
HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:-]{1,253}$")]
Token = Annotated[str, Field(pattern=r"^[!-~]{20,200}$")]


class InterfaceConfig(Document):
    """How a stand is reached over the network, with `stand serve --port`. hosts: names under which browsers and
    programs reach it, besides this machine's own, such as that of a proxy. secrets: a YAML file (mode 0600) with
    `tokens`, by the name of who has them; `stand token add` writes it, and it is never recorded or shown. secop_port:
    where `stand serve` answers SECoP on this machine, usually 10767, as with --secop; not at all without it.
    trust_loopback: where there are tokens, who asks from this machine needs none all the same; a proxy on this machine
    that adds no header then makes everybody behind it an operator.
    """

    trust_loopback: bool = False
    hosts: tuple[HostName, ...] = Field(default=(), max_length=50)
    secrets: Path | None = None
    secop_port: int | None = Field(default=None, ge=1, le=65535)


class TokenFile(Document):
    """The file that interface.secrets names."""

    tokens: dict[TokenName, Token] = Field(default_factory=dict)


def load_tokens(path: Path | None) -> dict[str, str]:
    """By name; none without a file. ConfigError as private_document."""
    if path is None:
        return {}
    form = "`tokens:` with a token of at least 20 characters for each name"
    return dict(private_document(path, "interface.secrets", TokenFile, form).tokens)


def write_tokens(path: Path, tokens: dict[str, str]) -> None:
    """Replace the file as a whole; nobody else may read it from its first moment. ConfigError when that is refused."""
    path = path.expanduser()
    part = path.with_name(f".{path.name}.part")
    lines = [f"  {json.dumps(name)}: {json.dumps(token)}\n" for name, token in sorted(tokens.items())]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        fd = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with open(fd, "w", encoding="utf-8") as file:
            file.write("tokens:\n" + "".join(lines) if lines else "tokens: {}\n")
            file.flush()
            os.fsync(fd)
        part.replace(path)
    except OSError as error:
        raise ConfigError(f"interface.secrets: {path}: cannot be written ({error.strerror})") from error
