"""All stands at a glance: the daemons of this machine, and those that the stand's file names.

Each stand is asked over its own interface, with a read-only token where it is elsewhere; nothing of one is kept by
another. STOP is passed on, and needs no token; everything else is done on that stand's own page.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import Literal, cast

from thermostand.foundation.errors import StandError
from thermostand.stand.config.interface_section import RemoteStand
from thermostand.stand.serving.api_models import Missing, StandState, Value
from thermostand.stand.serving.client import API, Server, make_server
from thermostand.stand.serving.instances import list_daemons

_ASK_S = 3.0  # round number; nothing was measured
_FRESH_S = 2.0  # several viewers ask once
_AT_ONCE = 8
# What needs somebody comes first; in words as people read them.
Standing = Literal[
    "tripped", "not safe", "asks somebody", "not reached", "held", "queue halted", "stopping", "running", "idle"
]
_ORDER: tuple[Standing, ...] = (
    "tripped", "not safe", "asks somebody", "not reached", "held", "queue halted", "stopping", "running", "idle",
)  # fmt: skip
AIR, CAMERA = "thermometers.air", "camera.temperature"


class StandCard(Value):
    """One stand. key: by which it is asked for here. page: where its own page is, "" when that is not known. why: what
    trips, holds or asks, or why it is not reached. set_point_degC, air_degC, camera_degC: None when not known.
    end_ns, utc_offset_ns: as the stand has them."""

    key: str
    name: str
    page: str = ""
    standing: Standing
    why: str = ""
    doing: str = ""
    simulated: bool = False
    set_point_degC: float | None = None
    air_degC: float | None = None
    camera_degC: float | None = None
    step: int = 0
    steps: int = 0
    now_ns: int = 0
    end_ns: int | None = None
    utc_offset_ns: int = 0


class FoundSession(Value):
    """A recorded session of one of the stands. camera: its serial number."""

    stand: str
    page: str
    name: str
    recipe: str
    begin_ns: int | None
    frames: int
    run: str
    camera: str
    tags: tuple[str, ...]


def make_card(key: str, page: str, state: StandState) -> StandCard:
    """What a card shows of a stand."""
    run = state.run
    standing, why = _judge(state)
    values = {name: each.value for name, each in state.readings.items()}
    return StandCard(
        key=key,
        name=state.stand,
        page=page,
        standing=standing,
        why=why,
        doing="" if run is None else f"{run.recipe}: {run.doing}",
        simulated=state.simulated,
        set_point_degC=state.setpoint_degC,
        air_degC=values.get(AIR),
        camera_degC=values.get(CAMERA),
        step=0 if run is None else run.step,
        steps=0 if run is None else run.steps,
        now_ns=state.now_ns,
        end_ns=None if run is None else run.end_ns,
        utc_offset_ns=state.utc_offset_ns,
    )


def _judge(state: StandState) -> tuple[Standing, str]:
    if state.fault is not None:
        return "tripped", state.fault.text
    if failing := [each for each in state.not_confirmed if each.reason]:
        return "not safe", failing[0].reason
    if state.prompt is not None:
        return "asks somebody", state.prompt.text
    if state.phase == "held":
        return "held", ", ".join(state.reasons)
    if state.run is None and state.queue_halted:
        return "queue halted", state.queue_halted
    return state.phase, ""


def sort_cards(cards: Iterable[StandCard]) -> list[StandCard]:
    """Who needs somebody first, then by name."""
    return sorted(cards, key=lambda card: (_ORDER.index(card.standing), card.name))


class Overview:
    """The stands of this machine's user, and `named` ones. Its methods block, and any thread may call them."""

    def __init__(self, named: Sequence[RemoteStand] = ()) -> None:
        self._named = tuple(named)
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="overview")
        self._lock = Lock()
        self._cards: list[StandCard] = []
        self._asked_s = -_FRESH_S

    def servers(self) -> dict[str, tuple[Server, str]]:
        """Every stand by its key, and where its page is. One that is named and runs here is there once."""
        found = [(Server(each.entry.stand, each.socket), each.entry.url) for each in list_daemons()]
        here = {page for _, page in found}
        for each in self._named:
            url = each.url.rstrip("/")
            if url in here:
                continue
            try:
                found.append((make_server(url, each.token_file), url))
            except StandError:  # its token cannot be read: it is asked without one, and says so
                found.append((Server(url, url=url), url))
        return {_make_key(server): (server, page) for server, page in found}

    def cards(self) -> list[StandCard]:
        """A card each, those first that need somebody."""
        with self._lock:
            if time.monotonic() - self._asked_s >= _FRESH_S:
                self._cards = sort_cards(self._pool.map(_look, self.servers().items()))
                self._asked_s = time.monotonic()
            return self._cards

    def find_server(self, key: str) -> Server:
        """Missing when there is none."""
        found = self.servers().get(key)
        if found is None:
            raise Missing("there is no such stand here now")
        return found[0]

    def stop(self, key: str) -> str:
        """Pass STOP on; raises SessionError when that stand does not take it."""
        return str(self.find_server(key).order("stop").get("text", ""))

    def find_sessions(self, words: str) -> list[FoundSession]:
        """The sessions of all stands that have each of these words somewhere (name, which begins with the date, recipe,
        operator, serial number, tags, notes), the latest first. A stand that is not reached has none."""
        wanted = words.lower().split()
        lists = self._pool.map(partial(_list_sessions, wanted), self.servers().values())
        return sorted((each for found in lists for each in found), key=lambda each: each.begin_ns or 0, reverse=True)

    def close(self) -> None:
        """Ask nobody any more."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _make_key(server: Server) -> str:
    return hashlib.sha256((server.url or str(server.socket)).encode()).hexdigest()[:16]


def _look(stand: tuple[str, tuple[Server, str]]) -> StandCard:
    key, (server, page) = stand
    try:
        return make_card(key, page, server.state(_ASK_S))
    except StandError as error:
        return StandCard(key=key, name=server.name, page=page, standing="not reached", why=str(error))


def _list_sessions(wanted: Sequence[str], stand: tuple[Server, str]) -> list[FoundSession]:
    server, page = stand
    try:
        listed = server.request("GET", f"{API}/sessions", None, _ASK_S)
    except StandError:
        return []
    found: list[FoundSession] = []
    for each in cast("list[dict[str, object]]", listed):
        keys = ("name", "recipe", "operator", "camera_serial", "tags", "notes")
        text = " ".join(str(each.get(key, "")) for key in keys).lower()
        if all(word in text for word in wanted):
            shared = {key: each.get(key) for key in ("name", "recipe", "begin_ns", "frames", "run", "tags")}
            found.append(
                FoundSession.model_validate(
                    {"stand": server.name, "page": page, "camera": each.get("camera_serial", ""), **shared}
                )
            )
    return found
