"""All stands at a glance: several daemons on their real sockets and ports, asked by the one that serves the page."""

import asyncio
import json
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.recording.full_session import record
from tests.stand.fake_service import STATUS, FakeService, serve_fake
from tests.stand.test_interface_access import PROXIED, ask, free_port
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.interface_section import RemoteStand, TokenFile
from thermostand.stand.serving.api.access import TokenStore
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api_models import FaultState, StandState
from thermostand.stand.serving.overview import Overview, make_card, sort_cards

LOOKS = "a-read-only-token-of-this-wall"
API = "/api/v1"


class Remote(FakeService):
    """A stand elsewhere, by its name."""

    def __init__(self, name: str, *reasons: str, runs: bool = False) -> None:
        super().__init__(*reasons, run=STATUS if runs else None)
        self.name = name
        self.stops = 0

    def state(self) -> StandState:
        return super().state().model_copy(update={"stand": self.name, "cameras": ("camera",)})

    def stop(self, who: object) -> str:
        self.stops += 1
        return "the stand is made safe"


@asynccontextmanager
async def open_remote(folder: Path, desk: Remote) -> AsyncIterator[RemoteStand]:
    """Served over TCP for a read-only token alone, and not among the daemons of this machine."""
    folder.mkdir()
    port, token_file = free_port(), folder / "token.txt"
    token_file.write_text(f"{LOOKS}\n")
    tokens = TokenStore(TokenFile(read_only={"wall": LOOKS}))
    elsewhere, here = folder / "runtime", os.environ.get("XDG_RUNTIME_DIR", "")
    elsewhere.mkdir(mode=0o700)
    os.environ["XDG_RUNTIME_DIR"] = str(elsewhere)  # as on another machine
    async with serve_fake(desk, folder / "now", Interface(folder, port=port, tokens=tokens)):
        os.environ["XDG_RUNTIME_DIR"] = here
        yield RemoteStand(url=f"http://127.0.0.1:{port}", token_file=token_file)


@pytest.fixture
def own_runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No daemon of anybody else is seen."""
    folder = tmp_path / "runtime"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))


def names_and_standings(cards: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Of the stands of these tests: others may be served on this machine."""
    return [(each["name"], each["standing"]) for each in cards if each["name"] in ("cold", "warm")]


@pytest.mark.usefixtures("own_runtime")
async def test_stands_elsewhere_are_shown_with_a_read_only_token_and_who_needs_somebody_is_first(tmp_path: Path):
    tripped, well = Remote("cold"), Remote("warm", runs=True)
    tripped.tripped = FaultState(rule="over_temperature", text="the air is too warm", since_ns=1)
    async with AsyncExitStack() as stack:
        stands = tuple(
            [await stack.enter_async_context(open_remote(tmp_path / each.name, each)) for each in (well, tripped)]
        )
        lost = RemoteStand(url=f"http://127.0.0.1:{free_port()}")
        port = free_port()
        interface = Interface(tmp_path, port=port, stands=(*stands, lost))
        await stack.enter_async_context(serve_fake(FakeService(), tmp_path / "own", interface))
        status, _, answer = await asyncio.to_thread(ask, port, "GET", f"{API}/overview")
        cards = json.loads(answer)
        assert status == 200
        by_url = {each["page"]: each for each in cards if each["page"]}
        assert names_and_standings(cards)[0] == ("cold", "tripped")
        assert by_url[lost.url]["standing"] == "not reached"
        assert (by_url[stands[1].url]["why"], by_url[stands[0].url]["steps"]) == ("the air is too warm", 87)
        assert by_url[stands[0].url]["air_degC"] == 21.5
        assert LOOKS not in answer.decode()


@pytest.mark.usefixtures("own_runtime")
async def test_stop_is_passed_on_without_any_token_and_nothing_else_is(tmp_path: Path):
    desk = Remote("cold")
    async with open_remote(tmp_path / "cold", desk) as stand:
        port = free_port()
        tokens = TokenStore(TokenFile(tokens={"rose": "correct-horse-battery-staple"}))
        interface = Interface(tmp_path, port=port, tokens=tokens, stands=(stand,))
        async with serve_fake(own := FakeService(), tmp_path / "own", interface):
            overview = Overview((stand,))
            (key,) = (key for key, (_, page) in overview.servers().items() if page == stand.url)
            overview.close()

            async def post(path: str) -> int:
                return (await asyncio.to_thread(ask, port, "POST", path, PROXIED))[0]

            assert await post(f"{API}/overview/{key}/stop") == 200
            assert (desk.stops, own.orders) == (1, [])
            assert [who.how for who, _, _ in desk.orders] == ["token"]
            assert await post(f"{API}/overview/{key}/pause") == 401
            assert await post(f"{API}/overview/{'0' * 16}/stop") == 404
            assert (await asyncio.to_thread(ask, port, "GET", f"{API}/overview", PROXIED))[0] == 401
            evil = {**PROXIED, "Origin": "http://evil.example"}
            assert (await asyncio.to_thread(ask, port, "POST", f"{API}/overview/{key}/stop", evil))[0] == 403
            assert desk.stops == 1


@pytest.mark.usefixtures("own_runtime")
async def test_sessions_of_all_stands_are_found_by_words(tmp_path: Path):
    async with open_remote(tmp_path / "cold", Remote("cold")) as stand:
        name = "20260101T000000Z-demo"
        await record(tmp_path / "cold" / name)
        port = free_port()
        async with serve_fake(FakeService(), tmp_path / "own", Interface(tmp_path, port=port, stands=(stand,))):

            async def find(words: str) -> list[tuple[str, str]]:
                path = f"{API}/overview/sessions?find={words}"
                answer = (await asyncio.to_thread(ask, port, "GET", path))[2]
                return [(each["page"], each["name"]) for each in json.loads(answer)]

            assert (stand.url, name) in await find(name[:8])
            assert await find(f"{name[:8]}%20nothing-has-this") == []


@pytest.mark.usefixtures("own_runtime")
async def test_the_command_shows_the_daemons_of_this_machine(tmp_path: Path):
    async with serve_fake(Remote("cold", runs=True), tmp_path / "one"), serve_fake(Remote("warm"), tmp_path / "two"):
        run = await asyncio.to_thread(CliRunner().invoke, app, ["overview", "--json"])
        cards = json.loads(run.stdout)
        assert run.exit_code == 0, run.stdout + run.stderr
        assert names_and_standings(cards) == [("cold", "running"), ("warm", "idle")]
        shown = await asyncio.to_thread(CliRunner().invoke, app, ["overview"])
        named = [line.split("  ")[0] for line in shown.stdout.splitlines()]
        assert [each for each in named if each in ("cold", "warm")] == ["cold", "warm"]


def test_the_order_is_by_who_needs_somebody():
    desk = FakeService()
    idle = make_card("1", "", desk.state())
    held = idle.model_copy(update={"standing": "held", "name": "z"})
    lost = idle.model_copy(update={"standing": "not reached"})
    assert [each.standing for each in sort_cards([idle, held, lost])] == ["not reached", "held", "idle"]
