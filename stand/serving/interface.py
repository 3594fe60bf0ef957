"""Answers clients of the program that has the stand open: commands, stream, page, SECoP, as the stand's file has it."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.stand.config.interface_section import load_tokens
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.serving.api.access import TokenStore
from thermostand.stand.serving.api.bridge import Bridge
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.server import check_ports, serve
from thermostand.stand.serving.commands import Served
from thermostand.stand.serving.page_data import PageData
from thermostand.stand.serving.secop import make_secop_listener

HERE = "127.0.0.1"


def make_interface(
    config: StandConfig, sessions: Path, host: str = HERE, port: int | None = None, secop: int | None = None
) -> Interface:
    """Make the interface as the stand's file has it, but for the ports that are given. ConfigError when the network
    could operate the stand without a token, or nobody can listen there: before a device is opened."""
    settings = config.interface
    trusts, port = settings.trust_loopback, settings.port if port is None else port
    secop = settings.secop_port if secop is None else secop
    book = TokenStore(None if settings.secrets is None else load_tokens(settings.secrets))
    doors = () if secop is None else (make_secop_listener(secop, read_only=trusts == "read-only"),)
    sign_on = settings.single_sign_on
    found = Interface(
        sessions,
        host,
        port,
        book,
        settings.hosts,
        trusts_loopback=trusts,
        doors=doors,
        single_sign_on=sign_on,
        stands=settings.stands,
    )
    found.check()
    check_ports(found)
    return found


@asynccontextmanager
async def serve_interface(
    service: Served, session: Path, stand: str, interface: Interface, target_text: str, deadline: ShutdownDeadline
) -> AsyncGenerator[PageData]:
    """Answer for who runs `session`, as `serve`, with the page and what it shows of frames."""
    viewing = PageData(service.hub, service.clock, interface.sessions, target_text)
    try:
        async with serve(
            service, session, stand, replace(interface, extra_routes=(_make_page_routes(viewing),)), deadline
        ):
            yield viewing
    finally:
        viewing.close()


def _make_page_routes(viewing: PageData) -> Callable[[Bridge], Any]:
    def make_routes(bridge: Bridge) -> Any:
        from thermostand.stand.serving.page_routes import (
            PageRoutes,  # FastAPI, which the thread loads that serves clients
        )

        return PageRoutes(viewing)(bridge)

    return make_routes
