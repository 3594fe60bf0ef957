"""Who may ask what: every route of the interface, asked by those who must not."""

import asyncio
import http.client
import json
import socket
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from websockets.asyncio.client import connect

from tests.stand.fake_service import FakeService, serve_fake
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.interface_section import TokenFile
from thermostand.stand.serving.api import access
from thermostand.stand.serving.api.access import (
    BODY_LIMIT_BYTES,
    CHECK_PATH,
    COOKIE,
    CSP,
    INVITE_PATH,
    PREVIEW_PATH,
    STOP_PATH,
    Access,
    TokenStore,
    is_exempt_from_token,
)
from thermostand.stand.serving.api.listeners import Interface, ProtocolListener
from thermostand.stand.serving.client import make_server

TOKEN, LOOKS = "correct-horse-battery-staple", "only-looks-and-stops-for-wall"
STOP_ELSEWHERE = f"/api/v1/overview/{16 * '0'}/stop"
CHANGES_NOTHING = (STOP_ELSEWHERE, STOP_PATH, CHECK_PATH, PREVIEW_PATH, INVITE_PATH)
EVIL = "http://evil.example"
# What a proxy adds: such a request is from elsewhere, and needs a token.
PROXIED = {"X-Forwarded-For": "192.0.2.7"}
NAMES = {
    "run": "1",
    "name": "flap",
    "device": "flap",
    "recipe": "demo",
    "session": "cycle",
    "verb": "open",
    "key": "0" * 16,
}
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
HOSTILE = (
    "<script>alert(1)</script>",
    "..%2f..%2fetc%2fpasswd",
    "%00",
    "%ff",
    "a" * 5000,
    "..",
    ".",
    "%0d%0aX:%20y",
    "é",
)


BARE_PROXY = "anybody behind a proxy on this machine that adds no header"


def book(**read_only: str) -> TokenStore:
    """With rose's token, and these."""
    return TokenStore(TokenFile(tokens={"rose": TOKEN}, read_only=read_only))


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@asynccontextmanager
async def open_stand(folder: Path, *, trusts_loopback: bool = True) -> AsyncIterator[tuple[FakeService, int]]:
    port = free_port()
    hosts = ("stand.example",)
    interface = Interface(folder, port=port, tokens=book(wall=LOOKS), hosts=hosts, trusts_loopback=trusts_loopback)
    async with serve_fake(FakeService(), folder / "cycle", interface) as desk:
        yield desk, port


def ask(
    port: int, method: str, path: str, headers: Mapping[str, str] | None = None, body: bytes | None = None
) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        host = {"Host": f"127.0.0.1:{port}"}
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in {**host, **(headers or {})}.items():
            connection.putheader(name, value)
        if body is not None and "Transfer-Encoding" not in (headers or {}):
            connection.putheader("Content-Length", str(len(body)))
            connection.putheader("Content-Type", "application/json")
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()


def routes(port: int) -> list[tuple[str, str]]:
    """All that the published document has, and what it has not."""
    document = json.loads(ask(port, "GET", "/openapi.json", {"Authorization": f"Bearer {TOKEN}"})[2])
    found = [(method.upper(), path.format(**NAMES)) for path, entry in document["paths"].items() for method in entry]
    return [*found, ("GET", "/"), ("GET", "/static/page.js"), ("GET", "/openapi.json"), ("GET", "/login")]


@pytest.mark.parametrize(
    ("attack", "headers", "status"),
    [
        ("a name that was made to lead here", {"Host": "evil.example"}, 403),
        ("no name", {"Host": ""}, 403),
        ("a name with something in it", {"Host": "127.0.0.1@evil.example"}, 403),
        ("a page of another site", {"Origin": EVIL}, 403),
        ("a page without an origin", {"Origin": "null"}, 403),
        ("a page at another port", {"Origin": "http://127.0.0.1:1"}, 403),
        ("a form of another site", {"Sec-Fetch-Site": "cross-site"}, 403),
        ("no token", PROXIED, 401),
        ("a wrong token", {**PROXIED, "Authorization": "Bearer wrong"}, 401),
        ("a wrong token here", {"Authorization": f"Basic {TOKEN}"}, 401),
        ("a name of this stand without a token", {"Host": "stand.example"}, 401),
        ("two tokens", {"Authorization": f"Bearer {TOKEN}", "authorization": "Bearer x"}, 401),
        ("a wrong cookie", {**PROXIED, "Cookie": f"{COOKIE}=x"}, 401),
        ("a token that may only look", {**PROXIED, "Authorization": f"Bearer {LOOKS}"}, 403),
        (BARE_PROXY, {}, 401),
        (BARE_PROXY, {"Host": "127.0.0.1"}, 401),
    ],
)
async def test_every_route_refuses(tmp_path: Path, attack: str, headers: dict[str, str], status: int):
    of_host, looks = "Host" in headers and status == 403, attack == "a token that may only look"
    async with open_stand(tmp_path, trusts_loopback=attack != BARE_PROXY) as (desk, port):
        found, wrong = await asyncio.to_thread(routes, port), []
        assert len(found) > 25
        for method, path in found:
            got, answered, body = await asyncio.to_thread(ask, port, method, path, headers)
            refused = of_host or (method != "GET" if status == 403 else not is_exempt_from_token(path))
            if looks:
                refused = method != "GET" and path not in CHANGES_NOTHING
            if status == 401 and "Authorization" in headers:
                refused = True  # who shows a token shows a right one, wherever
            if refused and (got != status or not json.loads(body)["error"]):
                wrong.append((method, path, got))
            if not refused and got in (401, 403) and path != "/login":
                wrong.append((method, path, got))
            if (
                got >= 500
                or answered["x-content-type-options"] != "nosniff"
                or "default-src 'none'" not in (answered["content-security-policy"])
            ):
                wrong.append((method, path, got))
        viewer = await asyncio.to_thread(ask, port, "GET", "/api/v1/stream", {**UPGRADE, **headers})
    assert wrong == []
    assert looks or (viewer[0], bool(json.loads(viewer[2])["error"])) == (status, True)
    assert not looks or viewer[0] == 101
    stops = [verb for _, verb, _ in desk.orders if verb == "stop"]
    needs_no_token = looks or (status == 401 and "Authorization" not in headers)
    assert (len(stops), len(desk.orders)) == ((1, 1) if needs_no_token else (0, 0))


async def test_with_a_token_a_cookie_or_from_here_it_is_served(tmp_path: Path):
    async with open_stand(tmp_path) as (desk, port):
        bearer = {**PROXIED, "Host": "stand.example", "Authorization": f"Bearer {TOKEN}"}
        own = {"Origin": f"http://127.0.0.1:{port}", "Sec-Fetch-Site": "same-origin"}
        assert (await asyncio.to_thread(ask, port, "POST", "/api/v1/run/pause", bearer))[0] == 200
        assert (await asyncio.to_thread(ask, port, "POST", "/api/v1/run/pause", own))[0] == 200
        behind_tls = {**bearer, "Origin": "https://stand.example"}
        assert (await asyncio.to_thread(ask, port, "POST", "/api/v1/run/pause", behind_tls))[0] == 200
        _, _, body = await asyncio.to_thread(ask, port, "POST", "/api/v1/login", bearer)
        path = json.loads(body)["path"]
        status, headers, _ = await asyncio.to_thread(ask, port, "GET", path, PROXIED)
        cookie = headers["set-cookie"]
        assert status == 200
        assert "HttpOnly" in cookie
        assert "samesite=strict" in cookie.lower()
        assert (await asyncio.to_thread(ask, port, "GET", path, PROXIED))[0] == 401  # it was for once
        shown = {**PROXIED, "Cookie": f"a=b; {cookie.partition(';')[0]}"}
        assert (await asyncio.to_thread(ask, port, "POST", "/api/v1/run/pause", shown))[0] == 200
        file = tmp_path / "token"
        file.write_text(TOKEN + "\n")
        assert (await asyncio.to_thread(make_server(f"http://127.0.0.1:{port}", file).order, "stop"))["verb"] == "stop"
    assert [(who.name, who.how) for who, _, _ in desk.orders] == [
        ("rose", "token"),
        ("", "loopback"),
        ("rose", "token"),
        ("rose", "token"),
        ("rose", "token"),
    ]


async def test_an_address_of_this_machine_is_a_name_of_the_stand_and_any_other_is_not(tmp_path: Path):
    known = Access()
    scope = {"type": "http", "method": "GET", "server": ("192.0.2.5", 80), "client": ("192.0.2.9", 1)}

    def is_let_in(host: str) -> bool:
        try:
            known.check({**scope, "headers": [(b"host", host.encode())]})
        except Exception:  # noqa: BLE001
            return False
        return True

    assert [is_let_in(host) for host in ("192.0.2.5", "192.0.2.5:8000", "192.0.2.6", "localhost.", "[::1]:80")] == [
        True,
        True,
        False,
        True,
        True,
    ]
    assert not any(map(is_let_in, ("localhost.evil.example", "evil.example/localhost", "[::1", "localhost:x", "")))


async def test_bodies_are_limited_and_stop_needs_none(tmp_path: Path):
    async with open_stand(tmp_path) as (desk, port):
        large = b'{"when": "now", "x": "' + b"x" * BODY_LIMIT_BYTES + b'"}'
        pause = "/api/v1/run/pause"
        assert (await asyncio.to_thread(ask, port, "POST", pause, {"Content-Length": str(1 << 40)}))[0] == 413
        chunked = b"%x\r\n%s\r\n0\r\n\r\n" % (len(large), large)
        status, _, _ = await asyncio.to_thread(_ask_large, port, pause, chunked)
        assert status in (0, 411)  # 0: cut off while it still sent
        for body in (b"{", b"[]", b'"x"', b'{"when": 3}', b'{"when": "never"}', b'{"else": 1}', b"\xff", b"[" * 10_000):
            status, _, body_text = await asyncio.to_thread(ask, port, "POST", pause, {}, body)
            assert status in (400, 422), body
            assert json.loads(body_text)["error"]
            if body == b"{":
                assert json.loads(body_text)["error"].startswith("the body: ")
        assert desk.orders == []
        for body in (b"", b"\xff", b"x" * 100_000):
            assert (await asyncio.to_thread(ask, port, "POST", STOP_PATH, {}, body))[0] == 200


def _ask_large(port: int, path: str, chunks: bytes) -> tuple[int, dict[str, str], bytes]:
    try:
        return ask(port, "POST", path, {"Transfer-Encoding": "chunked", "Content-Type": "application/json"}, chunks)
    except OSError:
        return 0, {}, b""


async def test_a_slow_client_is_not_waited_for_and_keeps_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(access, "_BODY_LIMIT_S", 0.5)
    async with open_stand(tmp_path) as (_, port):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        head = f"POST /api/v1/run/pause HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: 10\r\n\r\n"
        writer.write(head.encode() + b"{")
        assert (await asyncio.to_thread(ask, port, "POST", STOP_PATH))[0] == 200
        async with asyncio.timeout(20):
            assert b"408" in await reader.readline()
        writer.close()


@pytest.mark.parametrize("name", HOSTILE)
async def test_hostile_names_are_not_found_and_never_echoed_as_a_page(tmp_path: Path, name: str):
    quoted = name.encode("ascii", "ignore").decode() or "x"
    (tmp_path / "secret").write_text("root")
    async with open_stand(tmp_path) as (_, port):
        for path in (f"/api/v1/sessions/{quoted}", f"/api/v1/sessions/{quoted}/report.html", f"/static/{quoted}"):
            for spaced in (path.replace("<", "%3C").replace(">", "%3E"),):
                status, headers, body = await asyncio.to_thread(ask, port, "GET", spaced)
                assert status in (404, 405, 422)
                assert headers["content-type"] == "application/json"
                assert b"root" not in body


async def test_hostile_operators_and_texts_are_data(tmp_path: Path):
    script = "<script>alert(1)</script>"
    async with open_stand(tmp_path) as (desk, port):
        desk.tell(script, operator=script, value=float("nan"))
        body = json.dumps({"text": script, "tags": [script]}).encode()
        assert (await asyncio.to_thread(ask, port, "POST", "/api/v1/sessions/cycle/notes", {}, body))[0] == 200
        _, headers, body_text = await asyncio.to_thread(ask, port, "GET", "/api/v1/events")
        assert headers["content-type"] == "application/json"
        assert headers["content-security-policy"] == CSP
        assert json.loads(body_text)["events"][0]["data"] == {"operator": script, "value": None}


def test_a_wide_bind_without_a_token_is_refused(tmp_path: Path):
    for host in ("0.0.0.0", "::", "192.0.2.1", "stand.example"):
        with pytest.raises(ConfigError, match="others on the network"):
            Interface(tmp_path, host=host, port=1).check()
        Interface(tmp_path, host=host, port=1, tokens=book()).check()
    for host in ("127.0.0.1", "::1", "localhost", "127.1.2.3"):
        Interface(tmp_path, host=host, port=1).check()
    other = ProtocolListener("--secop", "127.0.0.1", 1, lambda *_: asyncio.sleep(0))
    Interface(tmp_path, doors=(other,)).check()
    Interface(tmp_path, tokens=book(), doors=(other,), trusts_loopback=True).check()
    with pytest.raises(ConfigError, match=r"--secop: .* set interface\.trust_loopback: true"):
        Interface(tmp_path, tokens=book(), doors=(other,)).check()
    assert TOKEN not in repr(Interface(tmp_path, tokens=book()))


async def test_a_taken_port_is_reported(tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        interface = Interface(tmp_path, port=taken.getsockname()[1])
        with pytest.raises(ConfigError, match="cannot listen at"):
            async with serve_fake(FakeService(), tmp_path / "cycle", interface):
                pass


async def test_a_viewer_has_nothing_long_to_say(tmp_path: Path):
    async with open_stand(tmp_path) as (_, port), connect(f"ws://127.0.0.1:{port}/api/v1/stream") as viewer:
        await viewer.recv()
        await viewer.send("x" * 10_000)
        async with asyncio.timeout(20):
            await viewer.wait_closed()
        assert viewer.close_code == 1008


async def test_what_can_be_asked_for_answers_to_head_without_a_body(tmp_path: Path):
    async with open_stand(tmp_path) as (_, port):
        for path in ("/healthz", "/openapi.json", "/api/v1/state"):
            whole = await asyncio.to_thread(ask, port, "GET", path)
            head = await asyncio.to_thread(ask, port, "HEAD", path)
            assert (head[0], head[2]) == (200, b"")
            assert head[1]["content-type"] == whole[1]["content-type"]
        assert (await asyncio.to_thread(ask, port, "HEAD", "/api/v1/run/pause"))[0] == 405
