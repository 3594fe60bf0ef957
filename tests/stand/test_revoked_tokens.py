"""Tokens that may only look, and tokens that are taken back while a daemon runs: SIGHUP, over real connections."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from websockets.asyncio.client import ClientConnection, connect

from tests.addresses import find_free_port
from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.secop_service import SecopService
from tests.stand.secop_talk import talking
from tests.stand.test_interface_access import LOOKS, PROXIED, TOKEN, ask
from thermostand.foundation.items import Event
from thermostand.stand.commands.serve_cli import TokenReloader
from thermostand.stand.config.interface_section import TokenFile, load_tokens, write_tokens
from thermostand.stand.serving.api.access import COOKIE, STOP_PATH, TokenStore
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.secop import make_secop_listener

OTHER = "another-token-of-rose-that-is-new"
PAUSE = "/api/v1/run/pause"


@dataclass
class Stand:
    """A desk behind a TCP port, and the file of its tokens: rose may order, wall may look."""

    desk: FakeService
    port: int
    file: Path
    events: list[Event]

    def write(self, **kinds: dict[str, str]) -> None:
        write_tokens(self.file, TokenFile(**kinds))

    async def reload(self) -> Event:
        """SIGHUP; what was reported of it."""
        before = len(self.events)
        os.kill(os.getpid(), signal.SIGHUP)
        async with asyncio.timeout(20):
            while len(self.events) == before:
                await asyncio.sleep(0.005)
        return self.events[-1]

    async def ask(self, method: str, path: str, token: str = "", body: object = None, cookie: str = "") -> int:
        """The status."""
        return (await self.answered(method, path, token, body, cookie))[0]

    async def answered(
        self, method: str, path: str, token: str = "", body: object = None, cookie: str = ""
    ) -> tuple[int, dict[str, str], bytes]:
        headers = {**PROXIED, **({"Authorization": f"Bearer {token}"} if token else {})}
        headers |= {"Cookie": f"{COOKIE}={cookie}"} if cookie else {}
        content = None if body is None else json.dumps(body).encode()
        return await asyncio.to_thread(ask, self.port, method, path, headers, content)

    async def logged_in(self, token: str, body: object = None) -> str:
        """A browser's cookie."""
        _, _, invitation = await self.answered("POST", "/api/v1/login", token, body)
        _, headers, _ = await self.answered("GET", json.loads(invitation)["path"])
        return headers["set-cookie"].partition(";")[0].partition("=")[2]

    def viewer(self, token: str) -> "connect":
        headers = {"Authorization": f"Bearer {token}"}
        return connect(f"ws://127.0.0.1:{self.port}/api/v1/stream", additional_headers=headers)


@asynccontextmanager
async def tokened(folder: Path) -> AsyncGenerator[Stand]:
    file, events, port = folder / "tokens.yaml", list[Event](), find_free_port()
    write_tokens(file, TokenFile(tokens={"rose": TOKEN}, read_only={"wall": LOOKS}))
    book, desk = TokenStore(load_tokens(file)), FakeService()
    before = signal.getsignal(signal.SIGHUP)
    async with serve_fake(desk, folder / "cycle", Interface(folder, port=port, tokens=book)):
        TokenReloader(file, book, desk.clock.now_ns, events.append).begin()
        yield Stand(desk, port, file, events)
        asyncio.get_running_loop().remove_signal_handler(signal.SIGHUP)
    signal.signal(signal.SIGHUP, before)


async def leaves(viewer: ClientConnection) -> tuple[int | None, str | None]:
    async with asyncio.timeout(20):
        await viewer.wait_closed()
    return viewer.close_code, viewer.close_reason


async def stays(viewer: ClientConnection, desk: FakeService) -> bool:
    """It is reported what happens from now on."""
    desk.tell("a sign")
    async with asyncio.timeout(20):
        while "a sign" not in await viewer.recv():
            pass
    return True


async def test_a_token_that_may_only_look_says_so_stops_and_is_refused_by_its_name(tmp_path: Path):
    async with tokened(tmp_path) as stand:
        _, _, known = await stand.answered("GET", "/api/v1/who", LOOKS)
        assert json.loads(known) == {"name": "wall", "how": "token", "role": "look"}
        status, _, answer = await stand.answered("POST", PAUSE, LOOKS)
        assert (status, "the token of wall" in json.loads(answer)["error"]) == (403, True)
        assert await stand.ask("POST", STOP_PATH, LOOKS) == 200
        assert await stand.ask("POST", STOP_PATH) == 200
        for cookie in (await stand.logged_in(LOOKS), await stand.logged_in(TOKEN, {"read_only": True})):
            assert await stand.ask("GET", "/api/v1/state", cookie=cookie) == 200
            assert await stand.ask("POST", PAUSE, cookie=cookie) == 403
    assert [(who.name, who.how, verb) for who, verb, _ in stand.desk.orders] == [
        ("wall", "token", "stop"),
        ("", "network", "stop"),
    ]


async def test_what_is_taken_back_ends_at_sighup_and_nothing_else_does(tmp_path: Path):
    async with tokened(tmp_path) as stand:
        cookie, looking = await stand.logged_in(TOKEN), await stand.logged_in(LOOKS)
        assert await stand.ask("POST", PAUSE, cookie=cookie) == 200
        async with stand.viewer(TOKEN) as rose, stand.viewer(LOOKS) as wall:
            await rose.recv()
            await wall.recv()
            stand.write(tokens={"rose": OTHER}, read_only={"wall": LOOKS})
            assert await stand.ask("POST", PAUSE, TOKEN) == 200  # it has not been reported yet
            assert (await stand.reload()).data == {"added": ["rose"], "revoked": ["rose"]}
            assert (await leaves(rose))[0] == 1008
            assert await stays(wall, stand.desk)
        assert [await stand.ask("POST", PAUSE, token) for token in (TOKEN, OTHER)] == [401, 200]
        assert await stand.ask("GET", "/api/v1/state", cookie=cookie) == 401
        assert await stand.ask("GET", "/api/v1/state", cookie=looking) == 200


async def test_a_token_that_is_made_read_only_and_the_last_one_that_is_taken_back(tmp_path: Path):
    async with tokened(tmp_path) as stand:
        cookie = await stand.logged_in(TOKEN)
        stand.write(read_only={"rose": TOKEN})
        await stand.reload()
        assert [await stand.ask("POST", PAUSE, TOKEN), await stand.ask("POST", PAUSE, cookie=cookie)] == [403, 401]
        stand.write()
        await stand.reload()
        assert await stand.ask("GET", "/api/v1/state", TOKEN) == 401
        bare = await asyncio.to_thread(ask, stand.port, "GET", "/api/v1/state")  # no token is no permission
        assert bare[0] == 401


@pytest.mark.parametrize(
    "spoil",
    [
        lambda file: file.write_text("tokens: {rose: short}"),
        lambda file: file.chmod(0o644),
        lambda file: file.unlink(),
    ],
)
async def test_a_file_that_cannot_be_used_leaves_the_tokens_as_they_were(tmp_path: Path, spoil: Callable[[Path], None]):
    async with tokened(tmp_path) as stand:
        spoil(stand.file)
        async with stand.viewer(TOKEN) as rose:
            await rose.recv()
            answer = await stand.reload()
            assert (answer.kind, answer.level, TOKEN in answer.text) == ("tokens_not_read", "warning", False)
            assert await stays(rose, stand.desk)
        assert await stand.ask("POST", PAUSE, TOKEN) == 200


@pytest.mark.parametrize("tokens", [TokenStore(TokenFile(tokens={"rose": TOKEN})), TokenStore()])
async def test_this_machine_may_be_trusted_to_look_only_by_secop_too(tmp_path: Path, tokens: TokenStore):
    desk, port, secop = SecopService(), find_free_port(), find_free_port()
    doors = (make_secop_listener(secop, read_only=True),)
    interface = Interface(tmp_path, port=port, tokens=tokens, trusts_loopback="read-only", doors=doors)
    async with serve_fake(desk, tmp_path / "cycle", interface), talking(secop) as talk:
        statuses = [(await asyncio.to_thread(ask, port, *asked))[0] for asked in (("GET", "/metrics"), ("POST", PAUSE))]
        assert statuses == [200, 403]
        described = (await talk.asked("describe"))[2]["modules"]
        assert all(a.get("readonly", True) for each in described.values() for a in each["accessibles"].values())
        assert (await talk.asked("read chamber"))[2][0] == desk.air_degC
        assert (await talk.asked("change chamber:target 30"))[2][0] == "ReadOnly"
        assert (await talk.asked("do linear:_home"))[2][0] == "Disabled"
        assert (await talk.asked("do run:stop"))[0] == "done"
    assert [verb for _, verb, _ in desk.orders] == ["stop"]


ON_A_TERMINAL = """
import asyncio, os, signal, sys
os.setsid()
terminal = os.open(sys.argv[1], os.O_RDWR)  # it is the session's from now on
from thermostand.stand.commands.serve_cli import TokenReloader
from thermostand.stand.serving.api.access import TokenStore

async def main():
    ended = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
    TokenReloader(None, TokenStore(), lambda: 0, lambda event: print(event.kind, flush=True)).begin()
    os.kill(os.getpid(), signal.SIGHUP)
    await ended.wait()
    print("ended", flush=True)

asyncio.run(main())
"""


def test_sighup_of_a_terminal_that_is_closed_is_an_end():
    terminal, device = os.openpty()
    command = [sys.executable, "-c", ON_A_TERMINAL, os.ttyname(device)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "tokens_not_read\n"
        os.close(device)
        os.close(terminal)
        assert process.communicate(timeout=60)[0] == "ended\n"
