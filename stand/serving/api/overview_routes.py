"""The routes of all stands: a card each, their last frames and sessions, and STOP, which is passed on."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from thermostand.stand.config.interface_section import RemoteStand
from thermostand.stand.serving.api_models import CommandAnswer
from thermostand.stand.serving.overview import FoundSession, Overview, StandCard

Key = Annotated[str, Path(max_length=100)]


def make_overview_routes(named: Sequence[RemoteStand]) -> APIRouter:
    """The routes. Each stand is asked by a thread."""
    router, overview = APIRouter(prefix="/api/v1/overview"), Overview(named)

    @router.get("", response_model=list[StandCard])
    async def cards() -> list[StandCard]:
        """A card for each stand of this machine, and each of interface.stands; those first that need somebody."""
        return await asyncio.to_thread(overview.cards)

    @router.get("/sessions", response_model=list[FoundSession])
    async def sessions(find: Annotated[str, Query(max_length=200)] = "") -> list[FoundSession]:
        """The sessions of all that have each of these words: date, recipe, operator, serial number, tag or note."""
        return await asyncio.to_thread(overview.find_sessions, find)

    @router.post("/{key}/stop", response_model=CommandAnswer, openapi_extra={"x-role": "none"})
    async def stop(key: Key) -> CommandAnswer:
        """STOP of that stand, passed on. Needs no token."""
        return CommandAnswer(verb="stop", text=await asyncio.to_thread(overview.stop, key))

    @router.get("/{key}/frame.jpg", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}})
    async def frame(key: Key) -> Response:
        """The last frame of that stand; 204 before there is one."""
        found = await asyncio.to_thread(lambda: overview.find_server(key).fetch_picture())
        return Response(status_code=204) if found is None else Response(found[1], media_type="image/jpeg")

    return router
