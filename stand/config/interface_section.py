"""The configuration's interface section, and the file of tokens that it names."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import make_durable_folder, sync_folder
from thermostand.foundation.private_file import load_private_document

TokenName = Annotated[str, Field(pattern=r"^[\w.@-]{1,64}$")]
HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:-]{1,253}$")]
Token = Annotated[str, Field(pattern=r"^[!-~]{20,200}$")]


class InterfaceConfig(Document):
    """How a stand is reached over the network. port: where `stand serve` and `stand run` have the page and the HTTP
    interface on this machine, as with --port; by the Unix socket only without it. hosts: names under which browsers and
    programs reach it, besides this machine's own, such as that of a proxy. secrets: a YAML file (mode 0600) with
    tokens, by the name of who has them; `stand token add` writes it, and it is never recorded or shown. Where it is
    named, also while nobody is in it, every request over the network needs a token. secop_port: where they
    answer SECoP on this machine, usually 10767, as with --secop; not at all without it. trust_loopback: who asks from
    this machine needs no token all the same, and may do everything (`true`), or only look and press STOP
    (`read-only`, also where no secrets are named); a proxy on this machine that adds no header makes everybody behind
    it one who asks from this machine.
    """

    trust_loopback: bool | Literal["read-only"] = False
    hosts: tuple[HostName, ...] = Field(default=(), max_length=50)
    secrets: Path | None = None
    port: int | None = Field(default=None, ge=1, le=65535)
    secop_port: int | None = Field(default=None, ge=1, le=65535)


class TokenFile(Document):
    """The file that interface.secrets names: tokens, by the name of who has them. read_only: of those who may look and
    press STOP, but order nothing."""

    tokens: dict[TokenName, Token] = Field(default_factory=dict)
    read_only: dict[TokenName, Token] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_unique(self) -> TokenFile:
        if self.tokens.keys() & self.read_only.keys():
            raise ValueError("a name has one token")
        if len({*self.tokens.values(), *self.read_only.values()}) < len(self.tokens) + len(self.read_only):
            raise ValueError("a token has one name")
        return self

    def list_by_name(self) -> dict[str, tuple[str, bool]]:
        """The token of each name, and whether it is read-only."""
        writing = {name: (token, False) for name, token in self.tokens.items()}
        return writing | {name: (token, True) for name, token in self.read_only.items()}

    def drop_token(self, name: str) -> TokenFile:
        """The same but for the token of that name."""
        return TokenFile.model_validate(
            {key: {n: token for n, token in of.items() if n != name} for key, of in self.model_dump().items()}
        )


def load_tokens(path: Path) -> TokenFile:
    """ConfigError as load_private_document."""
    form = "`tokens:` and `read_only:`, with a token of at least 20 characters for each name, each name and token once"
    return load_private_document(path, "interface.secrets", TokenFile, form)


def write_tokens(path: Path, tokens: TokenFile) -> None:
    """Replace the file as a whole; nobody else may read it from its first moment. ConfigError when that is refused."""
    path = path.expanduser()
    part = path.with_name(f".{path.name}.part")
    lines = list[str]()
    for key, of in tokens.model_dump().items():
        lines += [f"{key}:\n" if of else f"{key}: {{}}\n"]
        lines += [f"  {json.dumps(name)}: {json.dumps(token)}\n" for name, token in sorted(of.items())]
    try:
        make_durable_folder(path.parent)
        part.unlink(missing_ok=True)
        fd = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with open(fd, "w", encoding="utf-8") as file:
            file.write("".join(lines))
            file.flush()
            os.fsync(fd)
        part.replace(path)
        sync_folder(path.parent)  # else a token that was taken away may be back after a power cut
    except OSError as error:
        raise ConfigError(f"interface.secrets: {path}: cannot be written ({error.strerror})") from error
