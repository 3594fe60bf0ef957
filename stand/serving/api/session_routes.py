"""What lies on the disk: recipes and sessions. Read in threads of their own, one at a time, as a disk may hang."""

from __future__ import annotations

import asyncio
import concurrent.futures
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from fastapi import APIRouter, Response
from fastapi import Path as FromPath
from pydantic import BaseModel

from thermostand.foundation.documents import parse_document, parse_yaml
from thermostand.foundation.errors import NotFound, SessionError
from thermostand.recording.format.inventory import list_segments
from thermostand.recording.reading.catalogue import ListedSession, SessionCache, inspect_session, load_catalogue
from thermostand.stand.config.own_recipes import NamedRecipe, list_recipes, read_recipe
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.serving.api.bridge import Bridge, NoAnswer
from thermostand.stand.serving.api_models import Missing

REPORT = "report.html"
# A report is a page of its own with styles and drawings in it: nothing in it may run, or ask this stand anything.
REPORT_CSP = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
_DISK_LIMIT_S = 20.0  # a disk that slept needs some seconds; round number, nothing was measured

SessionName = Annotated[str, FromPath(max_length=255)]
Result = TypeVar("Result")


class SessionEntry(BaseModel):
    """A recorded session. begin_ns, end_ns: of its first and last message, None when it holds none. run: how it ended;
    files: whether they are sound; camera_serial: of the camera;
    has_report: whether there is one to be read. copies: folders with a verified copy."""

    name: str
    recipe: str
    operator: str
    camera_serial: str
    simulated: bool
    begin_ns: int | None
    end_ns: int | None
    frames: int
    bytes: int
    run: str
    files: str
    troubles: list[str]
    missing: list[str]
    has_report: bool
    tags: list[str]
    notes: list[str]
    copies: list[str]


class DiskReader:
    """One question to the disk at a time, each in a thread that does not keep the process from ending: asyncio's own
    threads would."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()

    async def ask(self, question: Callable[[], Result]) -> Result:
        """Return the disk's answer, or raise what it raises; NoAnswer when the disk does not give it in time."""
        answer: concurrent.futures.Future[Result] = concurrent.futures.Future()

        def ask_it() -> None:
            try:
                answer.set_result(question())
            except BaseException as error:  # noqa: BLE001 - it belongs to who asked
                answer.set_exception(error)

        try:
            async with asyncio.timeout(_DISK_LIMIT_S), self._lock:
                threading.Thread(target=ask_it, name="disk", daemon=True).start()
                return await asyncio.shield(asyncio.wrap_future(answer))
        except TimeoutError:
            raise NoAnswer(f"the disk has not answered within {_DISK_LIMIT_S:g} s") from None


def find_session(folder: Path, name: str) -> Path:
    """The session of this name in the folder of sessions; Missing when there is none, whatever the name tries."""
    path = folder / name
    is_name = (
        bool(name) and name not in (".", "..") and "/" not in name and "\0" not in name and not name.startswith(".")
    )
    try:
        if is_name and not path.is_symlink() and list_segments(path):
            return path
    except (OSError, ValueError):
        pass
    raise Missing("there is no session of that name")


def make_session_routes(_: Bridge, folder: Path) -> APIRouter:
    """The routes."""
    router, disk, memory = APIRouter(prefix="/api/v1"), DiskReader(), SessionCache()

    @router.get("/recipes", response_model=list[NamedRecipe])
    async def recipes() -> list[NamedRecipe]:
        """The installed recipes, then those that were saved here."""
        return await disk.ask(lambda: list(list_recipes(folder)))

    @router.get("/recipes/schema")
    async def schema() -> dict[str, Any]:
        """The JSON Schema of a recipe."""
        return Recipe.model_json_schema()

    @router.get("/recipes/{name}")
    async def recipe(name: SessionName) -> dict[str, Any]:
        """A recipe as a document, to fill a form with."""
        try:
            text = await disk.ask(lambda: read_recipe(folder, name))
        except NotFound as error:
            raise Missing(str(error)) from None
        parse_document(text, Recipe, name)  # a form is made of a recipe only
        return cast("dict[str, Any]", parse_yaml(text, name))

    @router.get("/sessions", response_model=list[SessionEntry])
    async def sessions() -> list[SessionEntry]:
        """The recorded sessions, the oldest first."""
        return await disk.ask(lambda: _list_sessions(folder, memory))

    @router.get("/sessions/{name}", response_model=SessionEntry)
    async def session(name: SessionName) -> SessionEntry:
        """One session."""
        return await disk.ask(lambda: _make_entry(inspect_session(find_session(folder, name))))

    @router.get(
        "/sessions/{name}/report.html", response_class=Response, responses={200: {"content": {"text/html": {}}}}
    )
    async def report(name: SessionName) -> Response:
        """Return the report of the session."""
        text = await disk.ask(lambda: _read_report(find_session(folder, name)))
        headers = {"content-security-policy": REPORT_CSP}
        return Response(text, headers=headers, media_type="text/html; charset=utf-8")

    return router


def _list_sessions(folder: Path, memory: SessionCache) -> list[SessionEntry]:
    """A thread that writes to a disk that hangs would keep the process from ending: nothing is written."""
    try:
        return [_make_entry(seen) for seen in load_catalogue(folder, memory=memory)]
    except (OSError, SessionError):  # no such folder
        return []


def _make_entry(seen: ListedSession) -> SessionEntry:
    return SessionEntry(
        name=seen.name.encode("utf-8", "replace").decode(),
        recipe=seen.metadata.get("recipe", ""),
        operator=seen.metadata.get("operator", ""),
        camera_serial=seen.metadata.get("camera_serial", ""),
        simulated=seen.simulated,
        begin_ns=seen.begin_ns,
        end_ns=seen.end_ns,
        frames=seen.frames,
        bytes=seen.size_bytes,
        run=seen.run,
        files=seen.files,
        troubles=list(seen.troubles),
        missing=list(seen.missing),
        has_report=(seen.path / REPORT).is_file(),
        tags=list(seen.tags),
        notes=[note.text for note in seen.notes],
        copies=[copy.to for copy in seen.copies],
    )


def _read_report(session: Path) -> bytes:
    path = session / REPORT
    if not path.is_file() or path.is_symlink():
        raise Missing("this session has no report; `compensate report` makes one")
    return path.read_bytes()
