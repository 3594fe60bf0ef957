"""How a stand is reached by its clients."""

from __future__ import annotations

import socket
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.interface_section import RemoteStand, SingleSignOnConfig
from thermostand.stand.serving.api.access import TokenStore, is_loopback
from thermostand.stand.serving.api.bridge import Bridge


@dataclass(frozen=True, slots=True)
class ProtocolListener:
    """A TCP port at which another protocol is spoken. option: of the command line, which asks for it. serve: given the
    listening socket in the thread that serves clients, runs until it is cancelled; what should not happen it
    reports."""

    option: str
    host: str
    port: int
    serve: Callable[[socket.socket, Bridge, Callable[[Exception], None]], Coroutine[None, None, None]]


@dataclass(frozen=True, slots=True)
class Interface:
    """How a stand is reached besides its Unix socket.

    host, port: to listen at by TCP; no port, no TCP. hosts: names of this stand besides this machine's own.
    trusts_loopback, single_sign_on, stands: as in the stand's file. doors: other protocols' ports. sessions: the folder
    of recorded sessions. extra_routes: makes what else is served (history, frames, the page) in the thread, as routers,
    by the bridge.
    """

    sessions: Path
    host: str = "127.0.0.1"
    port: int | None = None
    tokens: TokenStore = field(default_factory=TokenStore)
    hosts: tuple[str, ...] = ()
    trusts_loopback: bool | Literal["read-only"] = False
    doors: tuple[ProtocolListener, ...] = ()
    extra_routes: Sequence[Callable[[Bridge], Any]] = ()
    single_sign_on: SingleSignOnConfig | None = None
    stands: tuple[RemoteStand, ...] = ()

    @property
    def url(self) -> str:
        """The address at which it is reached over the network, "" when it is not."""
        if self.port is None:
            return ""
        name = socket.gethostname() if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://[{name}]:{self.port}" if ":" in name else f"http://{name}:{self.port}"

    def check(self) -> None:
        """ConfigError when everybody on the network could operate the stand, or a port asks for no token where others
        do."""
        if self.tokens.known is not None and self.doors and not self.trusts_loopback:
            raise ConfigError(
                f"{self.doors[0].option}: this protocol has no tokens, and this stand asks for one; set "
                "interface.trust_loopback: true in its file if every program of this machine may operate it, "
                "or read-only if it may look"
            )
        if self.port is not None and self.tokens.known is None and not is_loopback(self.host):
            raise ConfigError(
                f"--host {self.host}: others on the network could operate this stand; make a token with "
                "`stand token add NAME`, or listen at 127.0.0.1"
            )
