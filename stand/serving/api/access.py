"""Who may ask: the one check before every route, whatever is behind it.

- Host: the names of this stand only, also on loopback: a page of another site must not reach it under a name of its
  own that leads here (DNS rebinding).
- Origin: what changes something, and the stream, is taken from the stand's own page or from what is no browser.
- Token: for everything that does not come through the Unix socket, which proves who asks. Where the stand has no
  tokens, or its file trusts loopback, this machine needs none: a proxy on it that adds no header makes everybody local.
- STOP needs no token and is never delayed; it keeps the checks of Host and Origin.
- Sizes and times of bodies are limited, and answers carry what a browser needs to be strict with them.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import pwd
import secrets
import socket
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any, cast
from urllib.parse import urlsplit

from stand.serving.api.pace import Pace
from stand.serving.api.stream import json_of
from stand.serving.desk import Who

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

STOP_PATH = "/api/v1/run/stop"
LOGIN_PATH = "/login"
COOKIE = "thermostand"
BODY_LIMIT_BYTES = 1 << 20
_BODY_LIMIT_S = 10.0
_LOGIN_S = 600.0
_SESSION_S = 30 * 86400.0
_MOST_LOGINS = 100
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_READS = frozenset({"GET", "HEAD", "OPTIONS"})
_PROXIED = frozenset({b"forwarded", b"x-forwarded-for", b"x-forwarded-host", b"x-real-ip", b"via"})

CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "font-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: tuple[tuple[bytes, bytes], ...] = (
    (b"content-security-policy", CSP.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)


class Denied(Exception):
    """A request that goes no further: its status and sentence."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass
class Access:
    """tokens: by name. hosts: names under which the stand is reached besides this machine's own. Logins are one-time
    codes and what became of them: both live as long as the daemon."""

    tokens: Mapping[str, str] = field(default_factory=dict[str, str])
    hosts: Iterable[str] = ()
    trusts_loopback: bool = False

    def __post_init__(self) -> None:
        names = {socket.gethostname().lower(), *(host.lower() for host in self.hosts)}
        self._names = frozenset(names | _LOOPBACK)
        self._hashes = {name: _hash(token) for name, token in self.tokens.items()}
        self._codes: dict[str, tuple[str, float]] = {}
        self._logins: dict[str, tuple[str, float]] = {}

    def login_code(self, name: str) -> str:
        """A code that opens the page once, within ten minutes, for the holder of that name."""
        now_s = time.monotonic()
        self._codes = {code: entry for code, entry in self._codes.items() if entry[1] > now_s}
        while len(self._codes) >= _MOST_LOGINS:
            del self._codes[next(iter(self._codes))]
        code = secrets.token_urlsafe(24)
        self._codes[_hash(code)] = name, now_s + _LOGIN_S
        return code

    def log_in(self, code: str) -> str:
        """The cookie of who has the code, which is worth nothing from now on; "" when it is none."""
        name, until_s = self._codes.pop(_hash(code), ("", 0.0))
        if time.monotonic() > until_s:
            return ""
        while len(self._logins) >= _MOST_LOGINS:
            del self._logins[next(iter(self._logins))]
        cookie = secrets.token_urlsafe(32)
        self._logins[_hash(cookie)] = name, time.monotonic() + _SESSION_S
        return cookie

    def who(self, scope: Scope) -> Who | None:
        """Who asks; None when that has to be proved and is not. Denied when what is given as proof is none."""
        state, headers = cast("dict[str, Any]", scope.get("state") or {}), cast("Headers", scope["headers"])
        if state.get("door") == "socket":
            return Who(name=user_name(state.get("uid")), how="socket")
        name = self._named(headers)
        if name is not None:
            return Who(name=name, how="token")
        needs_token = bool(self._hashes) and not self.trusts_loopback
        return Who(name="", how="loopback") if not needs_token and _is_local(scope, headers) else None

    def check(self, scope: Scope) -> None:
        """Host and Origin; Denied."""
        headers = cast("Headers", scope["headers"])
        host = _one(headers, b"host")
        if host is None or not self._knows(scope, host):
            raise Denied(403, "this stand is not reached under that host name; name it in interface.hosts of its file")
        if scope["type"] == "http" and scope["method"] in _READS:
            return
        origins = _all(headers, b"origin")
        if any(not _is_same(origin, host) for origin in origins) or _one(headers, b"sec-fetch-site") == "cross-site":
            raise Denied(403, "this is not done for the page of another site")

    def _knows(self, scope: Scope, host: str) -> bool:
        name = _name_of(host)
        if name in self._names:
            return True
        try:
            ip = ipaddress.ip_address(name or "")
        except ValueError:
            return False
        server = scope.get("server")
        return bool(server) and str(ip) == str(server[0]).partition("%")[0]  # an address cannot be rebound

    def _named(self, headers: Headers) -> str | None:
        given = _one(headers, b"authorization")
        if given is not None:
            kind, _, token = given.partition(" ")
            found = _hash(token.strip())
            matches = [name for name, known in self._hashes.items() if hmac.compare_digest(known, found)]
            if kind.lower() != "bearer" or not matches:
                raise Denied(401, "the Authorization header has no token of this stand")
            return matches[0]
        cookie = next((value for name, value in _cookies(headers) if name == COOKIE), None)
        name, until_s = self._logins.get(_hash(cookie), ("", 0.0)) if cookie else ("", 0.0)
        return name if time.monotonic() < until_s else None


Headers = Iterable[tuple[bytes, bytes]]


def user_name(uid: object) -> str:
    """The user of that number; the number when it has no name."""
    if not isinstance(uid, int):
        return ""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def is_loopback(host: str) -> bool:
    """Whether an address to listen at is of this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_local(scope: Scope, headers: Headers) -> bool:
    client, host = scope.get("client"), _one(headers, b"host")
    if not client or not is_loopback(str(client[0])) or host is None or _name_of(host) not in _LOOPBACK:
        return False
    return not any(name in _PROXIED for name, _ in headers)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _all(headers: Headers, name: bytes) -> list[str]:
    return [value.decode("latin-1").strip() for key, value in headers if key == name]


def _one(headers: Headers, name: bytes) -> str | None:
    found = _all(headers, name)
    return found[0] if len(found) == 1 else None


def _name_of(host: str) -> str | None:
    """The name in `name:port` or `[address]:port`, None when it is neither."""
    if not host or any(character in host for character in "/@?#\\ "):
        return None
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return None
    return None if parts.hostname is None else parts.hostname.lower().rstrip(".")


def _is_same(origin: str, host: str) -> bool:
    try:
        parts = urlsplit(origin)
        port, scheme = parts.port, parts.scheme
        there = urlsplit(f"//{host}")
        return (
            scheme in ("http", "https")
            and parts.hostname is not None
            and parts.hostname == there.hostname
            and (port or (443 if scheme == "https" else 80)) == (there.port or (443 if scheme == "https" else 80))
        )
    except ValueError:
        return False


def _cookies(headers: Headers) -> Iterable[tuple[str, str]]:
    for line in _all(headers, b"cookie"):
        for part in line.split(";"):
            name, _, value = part.strip().partition("=")
            yield name, value


def is_open(path: str) -> bool:
    """What needs no token: STOP, whether all is well, and the page's own files, which are no secret: it has the button
    for STOP, and gets no data without a token."""
    return path in (STOP_PATH, LOGIN_PATH, "/healthz", "/") or path.startswith("/static/")


class Gatekeeper:
    """Before an ASGI application: checks, limits, and the headers of every answer. `failed` is called with what the
    application raises, which is answered with 500."""

    def __init__(self, app: App, access: Access, pace: Pace, failed: Callable[[Exception], None]) -> None:
        self._app = app
        self._access = access
        self._pace = pace
        self._failed = failed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request, or one viewer."""
        if scope["type"] not in ("http", "websocket"):
            return
        answering = _Answering(send, self._pace, is_last=scope["type"] == "http" and _is_in_chunks(scope))
        try:
            self._access.check(scope)
            who = self._access.who(scope)
            if who is None and not is_open(scope["path"]):
                raise Denied(401, "this needs a token: an Authorization header, or the address of `stand token login`")
            scope["state"] = {**(scope.get("state") or {}), "who": who or Who(name="", how="token")}
            if scope.get("method") == "HEAD":  # as GET; uvicorn sends the head of its answer only
                scope = {**scope, "method": "GET"}
            if scope["type"] == "http" and scope["path"] != STOP_PATH:
                await self._pace.turn()
                receive = await _whole_body(scope, receive)
            await self._app(scope, receive, answering)
        except Denied as denied:
            await _refuse(scope, answering, denied.status, str(denied))
        except Exception as error:  # noqa: BLE001 - after a request that fails, the next must be answered
            self._failed(error)
            await _refuse(scope, answering, 500, f"failed ({type(error).__name__}); the stand's events say more")
        finally:
            self._pace.spent()


class _Answering:
    """Adds the headers that every answer has, unless the route has given its own. is_last: nothing more is read."""

    def __init__(self, send: Send, pace: Pace, *, is_last: bool) -> None:
        self._send = send
        self._is_last = is_last
        self._pace = pace
        self.has_begun = False

    async def __call__(self, message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            own = list(message.get("headers", ()))
            given = {name.lower() for name, _ in own}
            added = [each for each in _HEADERS if each[0] not in given]
            is_last = self._is_last or self._pace.is_crowded
            if is_last and message["type"] == "http.response.start" and b"connection" not in given:
                added.append((b"connection", b"close"))
            message = {**message, "headers": [*own, *added]}
        self.has_begun = self.has_begun or message["type"] != "http.response.body"
        await self._send(message)


def _is_in_chunks(scope: Scope) -> bool:
    return bool(_all(scope["headers"], b"transfer-encoding"))


async def _whole_body(scope: Scope, receive: Receive) -> Receive:
    """The body, within its limits, before anything is done for it. Denied when it is longer or slower."""
    if (length := _one(scope["headers"], b"content-length")) is not None:
        if not length.isdecimal() or int(length) > BODY_LIMIT_BYTES:
            raise Denied(413, f"a request has at most {BODY_LIMIT_BYTES} bytes")
    elif _is_in_chunks(scope):
        raise Denied(411, "a request says how long it is (Content-Length); a body in chunks is not read")
    else:
        return receive
    body = bytearray()
    try:
        async with asyncio.timeout(_BODY_LIMIT_S):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    break
                body += message.get("body", b"")
                if len(body) > BODY_LIMIT_BYTES:
                    raise Denied(413, f"a request has at most {BODY_LIMIT_BYTES} bytes")
                if not message.get("more_body"):
                    break
    except TimeoutError:
        raise Denied(408, f"the request was not there after {_BODY_LIMIT_S:g} s") from None
    is_given = False

    async def given() -> Message:
        nonlocal is_given
        if is_given:
            return await receive()
        is_given = True
        return {"type": "http.request", "body": bytes(body), "more_body": False}

    return given


async def _refuse(scope: Scope, send: _Answering, status: int, sentence: str) -> None:
    if send.has_begun:
        return
    prefix = "http" if scope["type"] == "http" else "websocket.http"
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": sentence})
        return
    body = json_of({"error": sentence}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    if status in (408, 411, 413):
        headers.append((b"connection", b"close"))
    await send({"type": f"{prefix}.response.start", "status": status, "headers": headers})
    await send({"type": f"{prefix}.response.body", "body": body})
