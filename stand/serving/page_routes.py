"""The routes of the page: its files, the history behind its curves, and the last frame."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel

from thermostand.foundation.errors import ConfigError
from thermostand.recording.format.layout import TELEMETRY
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api.session_routes import DiskReader, SessionName, find_session
from thermostand.stand.serving.api.stream import make_json
from thermostand.stand.serving.api_models import Missing
from thermostand.stand.serving.live_history import MOST_POINTS
from thermostand.stand.serving.page_data import PageData
from thermostand.stand.serving.preview_process import load_session_columns, load_session_drift

if TYPE_CHECKING:
    from thermostand.stand.serving.preview import Preview

PAGE = Path(__file__).parent / "page"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
    ".txt": "text/plain; charset=utf-8",
}
_LIMIT_S = 60.0  # to read a recorded session, at the lowest priority
_MOST_CHANNELS_TEXT = 4000
_DRIFT_LIMIT_S = 300.0  # round number; nothing was measured
_KEPT = 8  # sessions' curves and drifts

Ns = Annotated[int, Query(ge=0, le=1 << 62)]
Points = Annotated[int, Query(ge=1, le=MOST_POINTS)]
_JPEG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {}}},
    204: {"description": "No frame was looked at yet"},
}
Camera = Annotated[str, Query(max_length=100)]


class Curves(BaseModel):
    """Column n is width_ns wide and begins at from_ns + n * width_ns. low, high: smallest and largest value in it by
    channel, null without one; a channel that is not in `high` has one value a column. marks: events, steps (level
    "step"; end_ns null while it is under way) and, of level "reference", from when on the drift of the camera `kind`
    counts from another frame: a curve is not to be drawn over that instant."""

    from_ns: int
    width_ns: int
    points: int
    low: dict[str, list[float | None]]
    high: dict[str, list[float | None]]
    units: dict[str, str]
    marks: list[dict[str, Any]]


class DriftOfSession(BaseModel):
    """points: time_ns, mean_px and worst_px, in order of time. trouble: why frames had none."""

    camera: str
    points: list[dict[str, float | int]]
    trouble: str


class FrameFacts(BaseModel):
    """The last frame that was looked at, see stand/serving/preview.py. skipped: frames that were not looked at, as
    others came meanwhile; trouble: why there are no markers."""

    camera: str
    cameras: list[str]
    time_ns: int
    width: int
    height: int
    role: str
    setup: dict[str, Any]
    markers: list[tuple[int, float, float, float | None, float | None]]
    expected: int
    mean_px: float | None
    mean_dx: float | None
    mean_dy: float | None
    worst_px: float | None
    worst: int | None
    reference_ns: int | None
    skipped: int
    trouble: str


class PageRoutes:
    """`Interface.extra_routes` takes it: called in the thread that serves clients, it gives the routes."""

    def __init__(self, viewing: PageData) -> None:
        self._viewing = viewing
        self._disk = DiskReader()
        self._read_already: dict[tuple[object, ...], Any] = {}
        self._running: asyncio.Task[None] | None = None

    def __call__(self, bridge: Bridge) -> APIRouter:
        """The routes. The bridge reports which session is under way; what the routes give is no part of its state."""

        def session() -> str:
            run = bridge.snapshot.state.run
            return "" if run is None else run.session

        self._running = asyncio.get_running_loop().create_task(self._viewing.run(session))
        router = APIRouter()
        self._add_curves(router)
        self._add_frame(router)
        _add_files(router)
        return router

    def _add_curves(self, router: APIRouter) -> None:
        @router.get("/api/v1/history", response_model=Curves)
        async def history(
            from_ns: Ns,
            to_ns: Ns,
            points: Points = 1200,
            channels: Annotated[str, Query(max_length=_MOST_CHANNELS_TEXT)] = "",
        ) -> Response:
            """Curves of the last week, decimated: smallest and largest value of each column. to_ns is after from_ns.
            channels: with commas between them; all without."""
            wanted = set(channels.split(",")) if channels else None
            try:
                found = self._viewing.get_history().columns(from_ns, to_ns, points, wanted)
            except ValueError as error:
                raise ConfigError(str(error)) from None
            return _make_response(found.as_json())

        @router.get("/api/v1/sessions/{name}/history", response_model=Curves)
        async def of_session(name: SessionName, points: Points = 1200) -> Response:
            """The same of a recorded session, from its beginning to its end."""
            return _make_response(
                (await self._read_cached(name, _LIMIT_S, self._viewing.ask, load_session_columns, points)).as_json()
            )

        @router.get("/api/v1/sessions/{name}/drift", response_model=DriftOfSession)
        async def drift(name: SessionName) -> Response:
            """Return how the markers of a recorded session moved, from at most 120 of its frames; the first time this
            takes up to minutes."""
            viewing = self._viewing
            found = await self._read_cached(
                name, _DRIFT_LIMIT_S, viewing.search, load_session_drift, viewing.target_text
            )
            return _make_response(asdict(found))

    async def _read_cached(
        self,
        name: str,
        limit_s: float,
        ask: Callable[..., Awaitable[Any]],
        function: Callable[..., Any],
        argument: object,
    ) -> Any:
        """Return what `function` finds in a session; kept until the session has changed."""
        path, changed_ns = await self._disk.ask(lambda: _get_change_key(find_session(self._viewing.sessions, name)))
        key = (function.__name__, path.name, changed_ns, argument)
        if key not in self._read_already:
            try:
                async with asyncio.timeout(limit_s):
                    found = await ask(function, str(path), argument)
            except TimeoutError:
                raise NoAnswer(f"{path.name} could not be read within {limit_s:g} s") from None
            except OSError as error:
                raise NoAnswer(str(error)) from None
            while len(self._read_already) >= _KEPT:
                self._read_already.pop(next(iter(self._read_already)))
            self._read_already[key] = found
        return self._read_already[key]

    def _add_frame(self, router: APIRouter) -> None:
        viewing = self._viewing

        @router.get("/api/v1/frame", response_model=FrameFacts, responses={204: {"description": "No frame yet"}})
        async def frame(camera: Camera = "") -> Response:
            """Return what the last frame of a camera shows; without a name, of the first that has one."""
            preview = _get_preview(viewing, camera)
            if preview is None:
                return Response(status_code=204)
            facts = asdict(preview)
            del facts["jpeg"]
            more = {"cameras": list(viewing.previews), "skipped": viewing.skipped}
            return _make_response({**facts, **more, "trouble": preview.trouble or viewing.trouble})

        @router.get("/api/v1/frame.jpg", response_class=Response, responses=_JPEG)
        async def picture(camera: Camera = "") -> Response:
            """The last frame at half its size; 204 before there is one."""
            preview = _get_preview(viewing, camera)
            if preview is None:
                return Response(status_code=204)
            return Response(preview.jpeg, media_type="image/jpeg", headers={"x-time-ns": str(preview.time_ns)})


def _get_change_key(session: Path) -> tuple[Path, int]:
    """The session, and when a segment was last added to it."""
    try:
        return session, (session / TELEMETRY).stat().st_mtime_ns
    except OSError as error:
        raise Missing(f"{session.name} has no telemetry ({error.strerror})") from None


def _get_preview(viewing: PageData, camera: str) -> Preview | None:
    """Get the preview of that camera, None when nothing was looked at yet; Missing when there is no such camera."""
    if camera and camera not in viewing.previews and viewing.previews:
        raise Missing("no frame of a camera of that name was looked at")
    return viewing.previews.get(camera) if camera else next(iter(viewing.previews.values()), None)


def _add_files(router: APIRouter) -> None:
    @router.get("/", response_class=Response, include_in_schema=False)
    async def page() -> Response:
        """The page."""
        return _make_file_response("index.html")

    @router.get("/static/{name}", response_class=Response, include_in_schema=False)
    async def static(name: str) -> Response:
        """A file of the page."""
        return _make_file_response(name)


def _make_file_response(name: str) -> Response:
    found = _load_files().get(name)
    if found is None:
        raise Missing("the page has no such file")
    data, kind = found
    return Response(data, media_type=kind)


@cache
def _load_files() -> dict[str, tuple[bytes, str]]:
    """All of them, read once: what is asked for is a key here and never a path."""
    return {path.name: (path.read_bytes(), _TYPES[path.suffix]) for path in PAGE.iterdir() if path.suffix in _TYPES}


def _make_response(value: object) -> Response:
    return Response(make_json(value), media_type="application/json")
