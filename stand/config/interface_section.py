"""The configuration's interface section, and the file of tokens that it names."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator

from thermostand.foundation.addresses import IpAddress
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.files import make_durable_folder, sync_folder
from thermostand.foundation.private_file import load_private_document

TokenName = Annotated[str, Field(pattern=r"^[\w.@-]{1,64}$")]
HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:-]{1,253}$")]
Token = Annotated[str, Field(pattern=r"^[!-~]{20,200}$")]


Role = Literal["look", "operate", "commission"]
ROLES: tuple[Role, ...] = get_args(Role)
"""What somebody may do, each more than the one before. look: see everything. operate: runs, queue, devices by hand.
commission: clear a trip, heat by hand. STOP needs none."""


def may(role: Role, needed: Role) -> bool:
    """Whether that role is enough."""
    return ROLES.index(role) >= ROLES.index(needed)


UserName = TokenName


class SingleSignOnConfig(Document):
    """A reverse proxy that has already asked who somebody is, and says so in a header. proxies: the addresses from
    which that header counts; from any other it is as if it were not there. users: the role of each, by the name in the
    header; others: of everybody else, none: they are let in by a token only. The proxy must remove the header
    from what it is sent."""

    header: str = Field(default="X-Remote-User", pattern=r"^[A-Za-z0-9-]{1,64}$")
    proxies: tuple[IpAddress, ...] = Field(min_length=1, max_length=50)
    users: dict[UserName, Role] = Field(default_factory=dict)
    others: Role | None = None


class RemoteStand(Document):
    """A stand elsewhere that is shown among all stands. token_file: one line with a token of it, read-only suffices."""

    url: str = Field(pattern=r"^https?://[^\s/@]+/?$", max_length=300)
    token_file: Path | None = None


class InterfaceConfig(Document):
    """How a stand is reached over the network. port: where `stand serve` and `stand run` have the page and the HTTP
    interface on this machine, as with --port; by the Unix socket only without it. hosts: names under which browsers and
    programs reach it, besides this machine's own, such as that of a proxy. secrets: a YAML file (mode 0600) with
    tokens, by the name of who has them; `stand token add` writes it, and it is never recorded or shown. Where it is
    named, also while nobody is in it, every request over the network needs a token. secop_port: where they
    answer SECoP on this machine, usually 10767, as with --secop; not at all without it. trust_loopback: who asks from
    this machine needs no token all the same, and may do everything (`true`), or only look and press STOP
    (`read-only`, also where no secrets are named); a proxy on this machine that adds no header makes everybody behind
    it one who asks from this machine. single_sign_on: a proxy that tells who asks. stands: others, elsewhere,
    that the page shows with those of this machine.
    """

    trust_loopback: bool | Literal["read-only"] = False
    hosts: tuple[HostName, ...] = Field(default=(), max_length=50)
    secrets: Path | None = None
    port: int | None = Field(default=None, ge=1, le=65535)
    secop_port: int | None = Field(default=None, ge=1, le=65535)
    single_sign_on: SingleSignOnConfig | None = None
    stands: tuple[RemoteStand, ...] = Field(default=(), max_length=50)


KEYS: dict[Role, str] = {"commission": "tokens", "operate": "operate", "look": "read_only"}
"""Where the file of tokens has those of a role."""


class TokenFile(Document):
    """The file that interface.secrets names: tokens, by the name of who has them, for each role: tokens (commission),
    operate, read_only (look)."""

    tokens: dict[TokenName, Token] = Field(default_factory=dict)
    operate: dict[TokenName, Token] = Field(default_factory=dict)
    read_only: dict[TokenName, Token] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_unique(self) -> TokenFile:
        pairs = [pair for of in (self.tokens, self.operate, self.read_only) for pair in of.items()]
        if len(dict(pairs)) < len(pairs):
            raise ValueError("a name has one token")
        if len({token for _, token in pairs}) < len(pairs):
            raise ValueError("a token has one name")
        return self

    def list_by_name(self) -> dict[str, tuple[str, Role]]:
        """The token of each name, and its role."""
        return {name: (token, role) for role, key in KEYS.items() for name, token in dict(getattr(self, key)).items()}

    def drop_token(self, name: str) -> TokenFile:
        """The same but for the token of that name."""
        return TokenFile.model_validate(
            {key: {n: token for n, token in of.items() if n != name} for key, of in self.model_dump().items()}
        )


def load_tokens(path: Path) -> TokenFile:
    """ConfigError as load_private_document."""
    form = "`tokens:`, `operate:` and `read_only:`, each name and token once, a token of at least 20 characters"
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
