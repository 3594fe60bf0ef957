"""What a client can do to a daemon to crowd others out: `python floods.py NAME` does it to the ports in PORTS, of HTTP
and of SECoP, until it is killed, and says "begun" when it is at it. Nothing of the program is imported."""

import os
import random
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

HOST = b"Host: 127.0.0.1\r\n"
STATE = b"GET /api/v1/state HTTP/1.1\r\n" + HOST + b"\r\n"
SCHEMA = b"GET /openapi.json HTTP/1.1\r\n" + HOST + b"\r\n"
STOP = b"POST /api/v1/run/stop HTTP/1.1\r\n" + HOST
VIEW = (
    b"GET /api/v1/stream?from=0 HTTP/1.1\r\n" + HOST + b"Connection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)
PING, TEXT = b"\x89\x80\x00\x00\x00\x00", b"\x81\x81\x00\x00\x00\x00x"
MIB = 1 << 20

PORT, SECOP_PORT = map(int, os.environ.get("PORTS", "0 0").split())
BEGUN_S = 0.2


def connect(port: int = PORT) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", port), 5.0)
    client.settimeout(1.0)
    return client


def view(frames: bytes) -> None:
    with connect() as client:
        client.sendall(VIEW)
        client.recv(65536)
        while True:
            client.sendall(frames)


def leave_unread(request: bytes) -> None:
    """What it asks for it never reads."""
    with connect() as client:
        while True:
            client.sendall(request)


def ask_repeatedly(request: bytes) -> None:
    with connect() as client:
        client.sendall(request)
        while client.recv(65536):
            pass


def hold_connections(sent: bytes, count: int = 40) -> None:
    """Many connections that say this and no more, the oldest of which is given up for each new one."""
    clients = [connect() for _ in range(count)]
    for client in clients:
        client.sendall(sent)
    while True:
        clients.pop(0).close()
        clients.append(connect())
        with suppress(OSError):
            clients[-1].sendall(sent)


def crowd(count: int = 200) -> None:
    """Connections without waiting for one of them."""
    clients = [socket.socket() for _ in range(count)]
    for client in clients:
        client.setblocking(False)
        client.connect_ex(("127.0.0.1", PORT))
    threading.Event().wait(0.01)
    for client in clients:
        client.close()


def drip(sent: bytes) -> None:
    """Many connections that say a little now and then."""
    clients = [connect() for _ in range(40)]
    for client in clients:
        client.sendall(sent)
    while True:
        for number, client in enumerate(clients):
            try:
                client.sendall(b"X" if random.random() < 0.9 else b": y\r\nX")
            except OSError:
                client.close()
                clients[number] = connect()
                clients[number].sendall(sent)
        threading.Event().wait(0.001)


def upload(head: bytes) -> None:
    with connect() as client:
        client.sendall(head)
        for _ in range(64):
            client.sendall(bytes(MIB))


def send_chunks(path: bytes) -> None:
    with connect() as client:
        client.sendall(b"POST " + path + b" HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n")
        while True:
            client.sendall(b"1\r\nx\r\n" * 10_000)


def talk_secop() -> None:
    """SECoP, as fast as it goes."""
    with connect(SECOP_PORT) as client:
        client.sendall(b"*IDN?\n")
        while True:
            client.sendall(b"activate\nread chamber\nchange chamber:target 1000\n" * 500)
            with suppress(BlockingIOError):
                client.recv(1 << 20, socket.MSG_DONTWAIT)


FLOODS: dict[str, tuple[int, Callable[[], None]]] = {
    "pings": (4, lambda: view(PING * 1000)),
    "texts": (4, lambda: view(TEXT * 1000)),
    "viewers that read nothing": (16, lambda: leave_unread(VIEW + PING)),
    "answers nobody reads": (16, lambda: leave_unread(SCHEMA * 200)),
    "half heads": (8, lambda: hold_connections(STOP)),
    "silent connections": (8, lambda: hold_connections(b"")),
    "connections by the thousand": (8, crowd),
    "slow loris": (4, lambda: drip(STOP + b"X")),
    "requests": (100, lambda: ask_repeatedly(STATE)),
    "pipelined requests": (16, lambda: ask_repeatedly(STATE * 200)),
    "bodies in chunks": (8, lambda: send_chunks(b"/api/v1/run/pause")),
    "chunks for STOP": (8, lambda: send_chunks(b"/api/v1/run/stop")),
    "uploads": (8, lambda: upload(b"POST /api/v1/queue HTTP/1.1\r\n" + HOST + b"Content-Length: 1048576\r\n\r\n")),
    "uploads to STOP": (8, lambda: upload(STOP + b"Content-Length: 1000000000\r\n\r\n")),
    "stops": (32, lambda: ask_repeatedly(STOP + b"\r\n")),
    "SECoP": (8, talk_secop),
}


def flood(does: Callable[[], None]) -> None:
    while True:
        with suppress(OSError):
            does()


if __name__ == "__main__":
    count, does = FLOODS[sys.argv[1]]
    for _ in range(count):
        threading.Thread(target=flood, args=(does,), daemon=True).start()
    threading.Event().wait(BEGUN_S)
    os.write(1, b"begun\n")
    threading.Event().wait()
