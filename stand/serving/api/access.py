"""Who may ask: the one check before every route, whatever is behind it.

- Host: the names of this stand only, also on loopback: a page of another site must not reach it under a name of its
  own that leads here (DNS rebinding).
- Origin: what changes something, and the stream, is taken from the stand's own page or from what is no browser.
- Token: for everything that does not come through the Unix socket, which proves who asks. Where the stand's file names
  no tokens, or trusts loopback, this machine needs none: a proxy on it that adds no header makes everybody local.
- Who has the role to look may look: whatever is not asked by GET is refused, but for STOP and for what changes nothing.
  Which other role a command needs, the command says (serving/commands.py).
- A proxy that the stand's file names may say in a header who asks.
- STOP needs no token and is never delayed; it keeps the checks of Host and Origin.
- A token that is taken back ends the streams that it has opened, and the logins that it was for.
- Sizes and times of bodies are limited, and answers carry what a browser needs to be strict with them.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import pwd
import re
import secrets
import socket
import struct
import time
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from typing import Any, Literal, cast
from urllib.parse import urlsplit

from thermostand.stand.config.interface_section import Role, SingleSignOnConfig, TokenFile
from thermostand.stand.serving.api.stream import make_json
from thermostand.stand.serving.api_models import Forbidden, Requester

# The tokens of a stand as they are now: read at the start, and again when that is asked for.


class TokenStore:
    """known: None where no file is named, so that nobody needs a token; with an empty file nobody has one. `renew` may
    be called by any thread."""

    def __init__(self, known: TokenFile | None = None) -> None:
        self.known = known
        self._watchers: list[tuple[asyncio.AbstractEventLoop, Callable[[], None]]] = []

    def watch(self, call: Callable[[], None]) -> None:
        """Call it, in the running loop, whenever tokens have been read again."""
        self._watchers.append((asyncio.get_running_loop(), call))

    def renew(self, known: TokenFile) -> None:
        """Use these tokens from now on."""
        self.known = known
        for loop, call in self._watchers:
            with suppress(RuntimeError):  # it has ended
                loop.call_soon_threadsafe(call)


Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

STOP_PATH = "/api/v1/run/stop"
LOGIN_PATH, INVITE_PATH = "/login", "/api/v1/login"
CHECK_PATH = "/api/v1/run/plan/check"
PREVIEW_PATH = "/api/v1/previews"
_STOP_ELSEWHERE = re.compile(r"/api/v1/overview/[0-9a-f]{16}/stop")
_CHANGES_NOTHING = frozenset({STOP_PATH, INVITE_PATH, CHECK_PATH, PREVIEW_PATH})
COOKIE = "thermostand"
FAILED = "failed ({}); the stand's events say more"  # by what should not happen
CHUNKS = "a request says how long it is (Content-Length); a body in chunks is not read"
BODY_LIMIT_BYTES = 1 << 20  # a recipe has at most a quarter of it
_BODY_LIMIT_S = 10.0  # round number; nothing was measured
_LOGIN_S = 600.0  # a code is typed or opened at once
_SESSION_S = 30 * 86400.0  # round number; nothing was measured
_MOST_LOGINS = 100  # the oldest makes way; round number, nothing was measured
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_READS = frozenset({"GET", "HEAD", "OPTIONS"})
_USER = re.compile(r"[\w.@-]{1,64}")
_PEER = struct.Struct("3i")
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


@dataclass(frozen=True, slots=True)
class _Login:
    """of: the token that has asked for it, None for none: then it was this machine's user."""

    who: Requester
    of: tuple[str, Role] | None = field(repr=False)
    until_s: float


@dataclass
class Access:
    """hosts: names under which the stand is reached besides this machine's own. Logins are one-time codes and what
    became of them: both live as long as the daemon, and no longer than the token that asked for them."""

    tokens: TokenStore = field(default_factory=TokenStore)
    hosts: Iterable[str] = ()
    trusts_loopback: bool | Literal["read-only"] = False
    single_sign_on: SingleSignOnConfig | None = None

    def __post_init__(self) -> None:
        names = {socket.gethostname().lower(), *(host.lower() for host in self.hosts)}
        self._names = frozenset(names | _LOOPBACK)
        self._codes: dict[str, _Login] = {}
        self._logins: dict[str, _Login] = {}

    def make_login_code(self, who: Requester, *, read_only: bool = False) -> str:
        """A code that opens the page once, within ten minutes, for who asks for it, or for one who may only look.
        Forbidden for whom a proxy names: the cookie would outlast what the proxy knows."""
        if who.how == "proxy":
            raise Forbidden("who comes by single sign-on opens the page through the proxy; a login is for a token")
        now_s = time.monotonic()
        self._codes = {code: entry for code, entry in self._codes.items() if entry.until_s > now_s}
        while len(self._codes) >= _MOST_LOGINS:
            del self._codes[next(iter(self._codes))]
        code = secrets.token_urlsafe(24)
        holder = Requester(name=who.name, how="token", role="look" if read_only else who.role)
        of = self._find_token(who.name) if who.how == "token" else None
        self._codes[_hash(code)] = _Login(holder, of, now_s + _LOGIN_S)
        return code

    def log_in(self, code: str) -> str:
        """The cookie of who has the code, which is void from now on; "" when it is none."""
        login = self._codes.pop(_hash(code), None)
        if login is None or not self._is_valid(login):
            return ""
        while len(self._logins) >= _MOST_LOGINS:
            del self._logins[next(iter(self._logins))]
        cookie = secrets.token_urlsafe(32)
        self._logins[_hash(cookie)] = replace(login, until_s=time.monotonic() + _SESSION_S)
        return cookie

    def identify(self, scope: Scope) -> Requester | None:
        """Return who asks; None when that has to be proved and is not. Denied when what is given as proof is none."""
        state, headers = cast("dict[str, Any]", scope.get("state") or {}), cast("Headers", scope["headers"])
        if state.get("door") == "socket":
            return Requester(name=get_user_name(state.get("uid")), how="socket")
        is_proxy = self._is_proxy(scope)
        found = self._identify_by_token(headers)
        found = found or (self._identify_by_proxy(headers) if is_proxy else None) or self._identify_by_cookie(headers)
        if found is not None:
            return found
        if is_proxy:  # whoever is behind it is not this machine
            return None
        needs_token = self.tokens.known is not None and not self.trusts_loopback
        if needs_token or not _is_local(scope, headers):
            return None
        return Requester(name="", how="loopback", role="look" if self.trusts_loopback == "read-only" else "commission")

    def admit(self, scope: Scope) -> Requester:
        """Return who asks, if the client may ask anything at all; Denied otherwise."""
        self.check(scope)
        who = self.identify(scope)
        if who is None and not is_exempt_from_token(scope["path"]):
            raise Denied(401, "this needs a token: an Authorization header, or the address of `stand token login`")
        if who is not None and who.role == "look" and _may_change(scope):
            raise Denied(403, f"{who.described} may look and press STOP, but order nothing: its role is look")
        return who or Requester(name="", how="network")

    def check(self, scope: Scope) -> None:
        """Host and Origin; Denied."""
        headers = cast("Headers", scope["headers"])
        host = _get_one(headers, b"host")
        if host is None or not self._is_known_host(scope, host):
            raise Denied(403, "this stand is not reached under that host name; name it in interface.hosts of its file")
        if scope["type"] == "http" and scope["method"] in _READS:
            return
        origins = _get_all(headers, b"origin")
        if any(not _is_same(origin, host) for origin in origins) or "cross-site" in _get_all(
            headers, b"sec-fetch-site"
        ):
            raise Denied(403, "this is not done for the page of another site")

    def _is_known_host(self, scope: Scope, host: str) -> bool:
        name = _parse_host_name(host)
        if name in self._names:
            return True
        try:
            ip = ipaddress.ip_address(name or "")
        except ValueError:
            return False
        server = scope.get("server")
        return bool(server) and str(ip) == str(server[0]).partition("%")[0]  # an address cannot be rebound

    def _identify_by_token(self, headers: Headers) -> Requester | None:
        given = _get_all(headers, b"authorization")
        if not given:
            return None
        kind, _, token = given[0].partition(" ")
        found, known = _hash(token.strip()), self.tokens.known or TokenFile()
        matches = [
            Requester(name=name, how="token", role=role)
            for name, (each, role) in known.list_by_name().items()
            if hmac.compare_digest(_hash(each), found)
        ]
        if len(given) > 1 or kind.lower() != "bearer" or not matches:
            raise Denied(401, "the Authorization header has no token of this stand")
        return matches[0]

    def _identify_by_cookie(self, headers: Headers) -> Requester | None:
        cookie = next((value for name, value in _parse_cookies(headers) if name == COOKIE), None)
        login = self._logins.get(_hash(cookie)) if cookie else None
        return login.who if login is not None and self._is_valid(login) else None

    def _is_valid(self, login: _Login) -> bool:
        return time.monotonic() < login.until_s and login.of in (None, self._find_token(login.who.name))

    def _is_proxy(self, scope: Scope) -> bool:
        """Whether it comes from a proxy that may say who asks."""
        client = scope.get("client")
        return bool(client and self.single_sign_on and str(client[0]) in self.single_sign_on.proxies)

    def _identify_by_proxy(self, headers: Headers) -> Requester | None:
        """The user that the proxy names; None when it names none, or one who has no role. Denied when it names two."""
        settings = self.single_sign_on
        names = [] if settings is None else _get_all(headers, settings.header.lower().encode())
        if settings is None or not names:
            return None
        if len(names) > 1 or not _USER.fullmatch(names[0]):
            raise Denied(401, f"the proxy's {settings.header} does not name one user")
        known: dict[str, Role | None] = {**settings.users}
        role = known.get(names[0], settings.others)
        return None if role is None else Requester(name=names[0], how="proxy", role=role)

    def _find_token(self, name: str) -> tuple[str, Role] | None:
        """That of a name, and its role."""
        return (self.tokens.known or TokenFile()).list_by_name().get(name)


Headers = Iterable[tuple[bytes, bytes]]


def get_user_name(uid: object) -> str:
    """The user of that number; the number when it has no name."""
    if not isinstance(uid, int):
        return ""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def get_peer_uid(connection: socket.socket) -> int | None:
    """The user at the other end of a Unix socket."""
    with suppress(OSError):
        return _PEER.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))[1]
    return None


def is_loopback(host: str) -> bool:
    """Return whether an address to listen at is of this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_local(scope: Scope, headers: Headers) -> bool:
    client, host = scope.get("client"), _get_one(headers, b"host")
    if not client or not is_loopback(str(client[0])) or host is None or _parse_host_name(host) not in _LOOPBACK:
        return False
    return not any(name in _PROXIED for name, _ in headers)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _get_all(headers: Headers, name: bytes) -> list[str]:
    return [value.decode("latin-1").strip() for key, value in headers if key == name]


def _get_one(headers: Headers, name: bytes) -> str | None:
    found = _get_all(headers, name)
    return found[0] if len(found) == 1 else None


def _parse_host_name(host: str) -> str | None:
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
        remote = urlsplit(f"//{host}")
        return (
            scheme in ("http", "https")
            and parts.hostname is not None
            and parts.hostname == remote.hostname
            and (port or (443 if scheme == "https" else 80)) == (remote.port or (443 if scheme == "https" else 80))
        )
    except ValueError:
        return False


def _parse_cookies(headers: Headers) -> Iterable[tuple[str, str]]:
    for line in _get_all(headers, b"cookie"):
        for part in line.split(";"):
            name, _, value = part.strip().partition("=")
            yield name, value


def is_exempt_from_token(path: str) -> bool:
    """Return what needs no token: STOP, whether all is well, and the page's own files, which are no secret: it has the
    button for STOP, and gets no data without a token."""
    is_page = path in (LOGIN_PATH, "/healthz", "/") or path.startswith("/static/")
    return is_page or path == STOP_PATH or _STOP_ELSEWHERE.fullmatch(path) is not None


class Gatekeeper:
    """A gatekeeper before an ASGI application: checks, limits, and the headers of every answer. `failed` is called with
    what the application raises, which is answered with 500."""

    def __init__(self, app: App, access: Access, failed: Callable[[Exception], None]) -> None:
        self._app = app
        self._access = access
        self._failed = failed
        self._viewers: dict[asyncio.Task[object], Scope] = {}
        access.tokens.watch(self._check_viewers)

    def _check_viewers(self) -> None:
        """Disconnect the viewers who would not be let in any more."""
        for task, scope in self._viewers.items():
            with suppress(Denied):
                if self._access.identify(scope) is not None:
                    continue
            task.cancel()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request, or one viewer."""
        if scope["type"] not in ("http", "websocket"):
            return
        answering = _HeaderSender(send)
        try:
            who = self._access.admit(scope)
            scope["state"] = {**(scope.get("state") or {}), "who": who}
            if scope.get("method") == "HEAD":  # as GET; uvicorn sends the head of its answer only
                scope = {**scope, "method": "GET"}
            if scope["type"] == "http" and scope["path"] != STOP_PATH:
                receive = await _read_body(scope, receive)
            if scope["type"] == "websocket":
                await self._view(scope, receive, answering)
            else:
                await self._app(scope, receive, answering)
        except Denied as denied:
            await _refuse(scope, answering, denied.status, str(denied))
        except Exception as error:  # noqa: BLE001 - after a request that fails, the next must be answered
            self._failed(error)
            await _refuse(scope, answering, 500, FAILED.format(type(error).__name__))

    async def _view(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a viewer as long as its token is known; Denied when that is taken back."""
        viewing = asyncio.ensure_future(self._app(scope, receive, send))
        self._viewers[viewing] = scope
        try:
            await asyncio.wait([viewing])
        finally:
            del self._viewers[viewing]
            is_over = viewing.done()
            viewing.cancel()
        if is_over and viewing.cancelled():
            raise Denied(401, "the token was taken back")
        viewing.result()


class _HeaderSender:
    """Adds the headers that every answer has, unless the route has given its own. Each ends its connection: STOP is
    looked for in what a connection says first (stop_thread.py), and a browser would send it behind what the page has
    asked for on another one."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.has_begun = False

    async def __call__(self, message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            own = list(message.get("headers", ()))
            given = {name.lower() for name, _ in own}
            added = [each for each in _HEADERS if each[0] not in given]
            if message["type"] == "http.response.start" and b"connection" not in given:
                added.append((b"connection", b"close"))
            message = {**message, "headers": [*own, *added]}
        self.has_begun = self.has_begun or message["type"] != "http.response.body"
        await self._send(message)


def _may_change(scope: Scope) -> bool:
    if scope["type"] != "http" or scope["method"] in _READS:
        return False
    return scope["path"] not in _CHANGES_NOTHING and not _STOP_ELSEWHERE.fullmatch(scope["path"])


def _is_in_chunks(scope: Scope) -> bool:
    return bool(_get_all(scope["headers"], b"transfer-encoding"))


async def _read_body(scope: Scope, receive: Receive) -> Receive:
    """The body, within its limits, before anything is done for it. Denied when it is longer or slower."""
    if (length := _get_one(scope["headers"], b"content-length")) is not None:
        if not length.isdecimal() or int(length) > BODY_LIMIT_BYTES:
            raise Denied(413, f"a request has at most {BODY_LIMIT_BYTES} bytes")
    elif _is_in_chunks(scope):
        raise Denied(411, CHUNKS)
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


async def _refuse(scope: Scope, send: _HeaderSender, status: int, sentence: str) -> None:
    if send.has_begun and scope["type"] == "http":
        return
    prefix = "http" if scope["type"] == "http" else "websocket.http"
    is_refused_by_http = "websocket.http.response" in scope.get("extensions", {}) and not send.has_begun
    if scope["type"] == "websocket" and not is_refused_by_http:
        with suppress(RuntimeError):  # it is closed
            await send({"type": "websocket.close", "code": 1008, "reason": sentence})
        return
    body = make_json({"error": sentence}).encode()
    headers = _make_headers(status, body)
    await send({"type": f"{prefix}.response.start", "status": status, "headers": headers})
    await send({"type": f"{prefix}.response.body", "body": body})


def _make_headers(status: int, body: bytes) -> list[tuple[bytes, bytes]]:
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    return [*headers, (b"www-authenticate", b"Bearer")] if status == 401 else headers


def make_last_answer(status: int, body: bytes) -> bytes:
    """A whole answer with this JSON, after which the connection ends."""
    headers = (*_make_headers(status, body), *_HEADERS, (b"connection", b"close"))
    lines = (f"HTTP/1.1 {status} {HTTPStatus(status).phrase}".encode(), *map(b": ".join, headers), b"", body)
    return b"\r\n".join(lines)


def make_last_refusal(status: int, sentence: str) -> bytes:
    """Make a refusal as `make_last_answer` makes an answer."""
    return make_last_answer(status, make_json({"error": sentence}).encode())
